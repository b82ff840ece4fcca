# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Runs of loops that noisier odometry explains are in, on logs whose wheels lose a sign."""

import numpy as np
import pytest
from worlds import between, position_error

import l1slam_ros as l1


@pytest.mark.parametrize(('name', 'most', 'norm', 'lost'), [
    ('fr079_wheel', 0.95, 'l2', 0.1), ('fr079_match', 0.5, 'l1', 0.05)])
def test_true_loops_of_a_log_are_in_and_its_map_is_right(datasets, name, most, norm, lost):
    graph, _ = l1.read_graph(datasets / 'lidar' / f'{name}.g2o')
    known = np.loadtxt(datasets / 'lidar' / 'fr079.truth.txt')
    truth = np.full((graph.n_poses, 3), np.nan)
    truth[known[:, 0].astype(int)] = known[:, 1:4]
    factors = graph.between
    off = between(between(truth[factors.i], truth[factors.j]), factors.measurement)
    true = ~factors.is_odometry & (np.hypot(off[:, 0], off[:, 1]) < 0.5) & (abs(off[:, 2]) < 0.2)
    solution = l1.solve(graph, norm=norm)
    there = np.isfinite(truth[:, 0])
    assert position_error(solution.poses[there, :2], truth[there, :2]) < most
    assert np.count_nonzero(true & ~solution.inliers) <= lost * true.sum()


def test_a_dozen_loops_are_in_whose_odometry_is_noisier_than_stated(datasets):
    graph, _ = l1.read_graph(datasets / 'real' / 'kitti_00.g2o')
    factors = graph.between
    first = factors.is_odometry | (np.maximum(factors.i, factors.j) < graph.n_poses // 2)
    assert np.count_nonzero(first & ~factors.is_odometry) == 12
    assert l1.solve(graph.subset(first), norm='l2').inliers.all()
