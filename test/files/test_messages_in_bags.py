# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Messages of a bag: what they say is taken exactly, garbage is refused under its cause."""

import math

import numpy as np
import pytest
from messages import TYPES, header, odometry, of_rosbags, pose_with_covariance
from records import information_of, read

from bags import NOTED, mcap_file

NS = 10**9
NONE = np.zeros(36)
ODOMETRY, LOOP = 'nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseWithCovarianceStamped'


def driven(k, nanosec=5, frame='odom', **fields):
    """Return the odometry of a robot at 10 + k s that goes a metre a second."""
    numbers = {'position': (float(k), 0.0, 0.0), 'quaternion': (0.0, 0.0, 0.0, 1.0),
               'covariance': NONE, **fields}
    return odometry(of_rosbags, header(of_rosbags, 10 + k, nanosec, frame), **numbers)


def loop(frame='base_link@10.000000005', sec=14, nanosec=5, **fields):
    return of_rosbags(LOOP, header=header(of_rosbags, sec, nanosec, frame),
                      pose=pose_with_covariance(of_rosbags, **fields))


def graph_of(path, messages):
    """Return the record of a bag in which every message of odometry is a keyframe."""
    recording = []
    for k, message in enumerate(messages):
        kind = message.__msgtype__
        topic = '/odom' if kind == ODOMETRY else '/loop_closures'
        recording.append((topic, kind, NS + k, bytes(TYPES.serialize_cdr(message, kind))))
    return read(mcap_file(path / 'a.mcap', recording, note=NOTED))


GOOD = [driven(k) for k in range(5)]


def broken(axis, value):
    """Return fields of a pose with one number that is another."""
    numbers = [1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    numbers[axis] = value
    return {'position': numbers[:3], 'quaternion': numbers[3:]}


POSES = [broken(axis, value) for axis in range(7) for value in (math.nan, math.inf, -math.inf)]
QUATERNIONS = [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.8), (1.0, 1.0, 1.0, 1.0),
               (0.0, 0.0, 1e200, 1e200)]


@pytest.mark.parametrize('messages, said', [
    ([driven(6, **fields) for fields in POSES], 'pose ('),
    ([loop(**fields) for fields in POSES], 'pose ('),
    ([driven(6, position=at) for at in ((1e308, 0.0, 0.0), (0.0, -2e9, 0.0))], 'position ('),
    ([driven(6, quaternion=q) for q in QUATERNIONS], 'quaternion '),
    ([driven(*stamp) for stamp in ((-10, 0), (-11, 5), (6, NS), (6, 2**32 - 1))], 'stamp '),
    ([loop(frame) for frame in (
        '', 'map', 'odom', 'base_link', 'base_link@', 'base_link@10', 'base_link@10.5',
        'base_link@10.0000000050', 'base_link@-1.000000000', 'base_link@1e1.000000000',
        'base_link@10.000000005 ', '@10.000000005', 'base_link@10,000000005', 'b@10.000000005',
        'base_link@9999999999.000000000', 'base_link@\u0661\u0660.000000005')], 'frame '),
    ([loop(f'base_link@{stamp}') for stamp in (
        '14.000000005', '14.000000006', '2000000000.000000000')], 'reference ')],
    ids=['odometry', 'loop', 'range', 'quaternion', 'stamp', 'frame', 'order'])
def test_what_cannot_be_used_is_refused_under_its_cause_and_changes_nothing(
        tmp_path, messages, said):
    record = graph_of(tmp_path, [*GOOD, *messages])
    sentence, = (one for one in record.skipped if 'refused' in one)
    assert sentence.startswith(f'{len(messages)} messages refused: {said}'), sentence
    assert 'expected' in sentence and '\n' not in sentence
    np.testing.assert_array_equal(record.graph.between.measurement, [(1, 0, 0)] * 4)


def test_a_loop_names_its_times_to_the_nanosecond_and_states_its_covariance(tmp_path):
    """Between the keyframes of these stamps, though others are a nanosecond away."""
    covariance = np.diag([0.04, 0.09, 1, 1, 1, 0.01]).ravel()
    record = graph_of(tmp_path, [
        driven(0, 7), driven(0, 8), *(driven(k) for k in range(1, 5)),
        loop('base_link@10.000000008', covariance=covariance, position=(4.5, 0.25, 0.0),
             quaternion=(0.0, 0.0, 0.7, 0.7))])
    row, = np.flatnonzero(~record.graph.between.is_odometry)
    assert record.graph.between.pairs[row].tolist() == [1, 5]
    assert record.stamps.tolist()[:2] == [10 * NS + 7, 10 * NS + 8]
    # A quaternion of few digits is normalised.
    np.testing.assert_allclose(record.graph.between.measurement[row], (4.5, 0.25, np.pi / 2))
    np.testing.assert_allclose(information_of(record.graph)[row], np.diag([25, 1 / 0.09, 100]),
                               atol=1e-12)
