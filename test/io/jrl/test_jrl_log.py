# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What a JRL file knows beside the graph: which factors are false, and true poses."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.io.graphs.left_out import left_out_of
from l1slam_ros.io.jrl.reading import read_jrl_file, read_truth
from l1slam_ros.io.jrl.writing import write_jrl_file

A, B = ord('a') << 56, ord('b') << 56
SECOND = 10**9


def pose2(x, y, theta):
    return {'type': 'Pose2', 'x': x, 'y': y, 'theta': theta}


def pose3(x, yaw):
    return {'type': 'Pose3', 'translation': [x, 0.5, 0.25],
            'rotation': [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]}


def between(i, j, pose, covariance):
    return {'type': f'BetweenFactor{pose["type"]}', 'key1': i, 'key2': j, 'measurement': pose,
            'covariance': covariance}


def plane(i, j, x):
    return between(i, j, pose2(x, 0.0, 0.1), [0.04, 0.01, 0, 0.01, 0.05, 0, 0, 0, 0.01])


def team():
    """Two robots in the plane as the library writes them: null where there is nothing."""
    prior = {'type': 'PriorFactorPose2', 'key': A, 'prior': pose2(1, 2, 0.5),
             'covariance': [0.01, 0, 0, 0, 0.01, 0, 0, 0, 0.01]}
    distance = {'type': 'RangeFactorPose2', 'key1': A, 'key2': B, 'measurement': 3.0,
                'covariance': [0.1]}
    t = 1_700_000_000 * SECOND
    return {
        'name': 'team', 'robots': [97, 98],
        'measurements': {
            'a': [{'stamp': t, 'measurements': [prior]},
                  {'stamp': t + 2 * SECOND, 'measurements': [plane(A, A + 1, 1.0), distance]},
                  {'stamp': t + 4 * SECOND, 'measurements': [
                      plane(A + 1, A + 2, 1.0), plane(A, A + 2, 2.0), plane(A + 2, B, 0.5)]}],
            'b': [{'stamp': t + SECOND},
                  {'stamp': t + 3 * SECOND, 'measurements': [plane(B, B + 1, 1.0)]}]},
        'groundtruth': {'a': [{'key': A + k, **pose2(k, 0, 0)} for k in range(3)],
                        'b': [{'key': B + k, **pose2(3 + k, 0, 0)} for k in range(2)]},
        'initialization': {
            'a': [{'key': A + k, **pose2(k + 0.125, 0, 0)} for k in range(3)]
            + [{'key': B, **pose2(99, 0, 0)}],
            'b': [{'key': B + k, **pose2(3 + k, 0, 0.5)} for k in range(2)]},
        'potential_outlier_factors': {'a': [[2, 1], [2, 2]], 'b': None},
        'outlier_factors': {'a': [[2, 2]], 'b': []}}


def space():
    covariance = np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.03])
    covariance[0, 4] = covariance[4, 0] = 5e-4
    listed = covariance.ravel().tolist()
    return {'name': 'space', 'robots': [97], 'measurements': {'a': [
        {'stamp': k, 'measurements': [between(A + k, A + k + 1, pose3(1.0, 0.25), listed)]}
        for k in range(4)]}}


@pytest.fixture
def put(tmp_path):
    def file(document, name='team.jrl'):
        path = tmp_path / name
        if name.endswith('.cbor'):
            path.write_bytes(pytest.importorskip('cbor2').dumps(document))
        else:
            path.write_text(document if isinstance(document, str) else json.dumps(document))
        return path
    return file


@pytest.mark.parametrize('name', ['team.jrl', 'team.jrl.cbor'])
def test_a_team_is_read(put, name):
    record = read_jrl_file(put(team(), name))
    assert_array_equal(record.log.known_false, [False, False, False, False, True, False])


def test_what_was_left_out_is_an_outlier_and_comes_back(put, tmp_path):
    record, out = read_jrl_file(put(team())), tmp_path / 'out.jrl'
    inliers = np.array([True, True, True, False, True, True])
    left_out = left_out_of(inliers, record.graph.between)
    write_jrl_file(out, replace(record, left_out=left_out))
    back = read_jrl_file(out)
    assert_array_equal(back.left_out, left_out)
    # What the first file knew to be false is still known.
    assert_array_equal(back.log.known_false, record.log.known_false)


def test_truth(put):
    ids, poses = read_truth(put(team()), se3)
    assert_array_equal(ids, [A, A + 1, A + 2, B, B + 1])
    assert poses.shape == (5, 7)
    with pytest.raises(FileError, match='has no groundtruth'):
        read_truth(put(space(), 'b.jrl'), se2)
