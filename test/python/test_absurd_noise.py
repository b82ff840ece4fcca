# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Whatever variances drivers and simulators state, the map goes on."""

import heard
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import between, edge, edges_of, false_of, graph_file, made, truth_of

import l1slam_ros as l1

VARIANCES = [1e-300, 1e-30, 1e-20, 1e-12, 1e-8, 1e-4, 1.0, 1e4, 1e12, 1e30, 1e300]
SOUND = np.diag([0.02, 0.02, 0.002])


@pytest.mark.parametrize('component', [[0], [2], [0, 1, 2]])
@pytest.mark.parametrize('source, period', [('increment', 0.0), ('twist', 0.4), ('loop', 0.0)])
def test_no_variance_bends_the_map(source, component, period):
    """Any at all, a message in ten, and each loop five times."""
    poses = heard.curve(300)
    backend = heard.begun(**{'keyframe.period': period, 'odometry.covariance_source': (
        'model' if source == 'loop' else source)})

    def stated(k, mine):
        covariance = SOUND.copy()
        if mine and k % 10 == 5:
            covariance[component, component] = VARIANCES[k // 10 % len(VARIANCES)]
        return heard.covariance6(covariance)

    with np.errstate(all='raise', under='ignore'):
        for k, pose in enumerate(poses):
            backend.add_odometry(heard.odometry(
                k * heard.PERIOD, pose, stated(k, source == 'increment'),
                stated(k, source == 'twist') / heard.PERIOD**2))
            heard.hear(backend, 5 * [heard.true_loop(
                poses, k - 200, k, stated(k, source == 'loop'))] * (k >= 200))
        backend.snapshot()  # with the loops as factors
    backend.update(0.1)
    backend.settle()
    assert backend.counts().sizes['accepted_loops'] >= 75
    assert heard.refused(backend) == {'repeated': 400} and backend.news()
    assert_allclose(backend.poses, poses[:: 4 if period else 1], atol=1e-6)


@pytest.mark.parametrize('lies', [0, 2001])
def test_loops_without_noise_are_believed(tmp_path, lies):
    """A simulator's: the noise that is learnt of them does not run to nothing."""
    path = made(tmp_path / 'world.g2o', 1000, 3000, *(('--false-loops', lies) if lies else ()))
    truth, false = truth_of(path), {tuple(pair) for pair in (false_of(path) if lies else ())}
    lines = [edge(i, j, between(truth[i], truth[j]) if (i, j) not in false and j > i + 1 else Z,
                  information) for i, j, Z, information in edges_of(path)]
    graph, _ = l1.read_graph(graph_file(tmp_path, lines))
    inliers, factors = l1.solve(graph).inliers, graph.between
    is_false = np.array([tuple(pair) in false for pair in factors.pairs.tolist()])
    loops = ~factors.is_odometry & ~is_false
    assert loops.sum() == 2001 and is_false.sum() == lies
    assert inliers[loops].mean() > 0.99 and not inliers[is_false].any()
