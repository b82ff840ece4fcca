# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What a driver did to its odometry is told from a recording as it is while driving."""

import numpy as np
import pytest
from heard import hear
from laps import LAP, Laps, late
from messages import TYPES, header, odometry, of_rosbags, pose_with_covariance
from numpy.testing import assert_array_equal
from records import read
from rosbags.rosbag2 import StoragePlugin

import l1slam_ros as l1
from bags import rosbag2_directory


def write(path, found):
    """Write samples and loops in the order they come, by a writer that is not ours."""
    recording = []
    for k, one in enumerate(found):
        stamp, pose3 = divmod(one.stamp, 10**9), one.pose3.tolist()
        covariance = one.covariance.ravel()
        if isinstance(one, l1.LoopClosure):
            name, kind = '/loop_closures', 'geometry_msgs/msg/PoseWithCovarianceStamped'
            frame = 'base_link@{}.{:09}'.format(*divmod(one.reference_stamp, 10**9))
            pose = pose_with_covariance(of_rosbags, pose3[:3], pose3[3:], covariance=covariance)
            message = of_rosbags(kind, header=header(of_rosbags, *stamp, frame), pose=pose)
        else:
            name, kind = '/odom', 'nav_msgs/msg/Odometry'
            message = odometry(of_rosbags, header(of_rosbags, *stamp), position=pose3[:3],
                               quaternion=pose3[3:], covariance=covariance)
        recording.append((name, kind, 10**18 + k, bytes(TYPES.serialize_cdr(message, kind))))
    rosbag2_directory(path, recording, StoragePlugin.MCAP, note=None)


@pytest.mark.parametrize('fault', ['restart', 'silence', 'disorder'])
def test_a_recording_makes_the_graph_that_the_node_makes(tmp_path, fault):
    laps = Laps(laps=2.0)
    samples = {'restart': lambda: laps.restarted(LAP + 14.4, 2.0, (0.02, 0.0, 0.0)),
               'silence': lambda: laps.silent(LAP + 7.0, LAP + 11.0),
               'disorder': lambda: late(laps.samples(), 0.2, 1.0, np.random.default_rng(0)),
               }[fault]()
    found, live = laps.heard(samples), l1.Backend()
    refused = hear(live, found)
    now = live.snapshot()
    write(tmp_path / 'bag', found)
    record = read(tmp_path / 'bag')
    assert_array_equal(record.stamps, now.stamps)
    ours, theirs = now.graph.between, record.graph.between
    order = [np.lexsort(factors.pairs.T) for factors in (ours, theirs)]
    assert_array_equal(theirs.pairs[order[1]], ours.pairs[order[0]])
    np.testing.assert_allclose(theirs.sqrt_information[order[1]],
                               ours.sqrt_information[order[0]], rtol=1e-6)
    news = live.news()
    assert (len(news), bool(refused)) == {
        'restart': (1, False), 'silence': (0, False), 'disorder': (0, True)}[fault]
    assert record.skipped == (*news, *(
        f'{len(refused)} messages refused: {one}' for one in refused[:1]))
