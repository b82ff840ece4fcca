# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Parts of a map that nothing joins stand where their weak ties say."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.graph.factor_graph import WORLD, FactorGraph
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.running.problem import Problem, as_one, on_ties

# Robot 0 has keyframes 0 to 3, robot 1 a part of 4 to 6 and one of 7 to 9.
ROBOTS, FIRSTS = np.repeat([0, 1], [4, 6]), (4, 7)


def problem(manifold, *others):
    """Return the problem of a random map; others : factors besides odometry, (i, j) each."""
    rng, n = np.random.default_rng(0), len(ROBOTS)
    poses = manifold.retract(manifold.identity(n), rng.standard_normal((
        n, manifold.TANGENT_SIZE)))
    graph = FactorGraph(manifold, 0)
    for k, robot in enumerate(ROBOTS.tolist()):
        graph.add_poses(1, robot, begins_part=k in FIRSTS)
    pairs = [(k - 1, k) for k in range(1, n) if k not in FIRSTS] + list(others)
    i, j = np.array(pairs).T
    from_world = np.concatenate((poses, manifold.identity(1)))
    d = manifold.TANGENT_SIZE
    graph.append_between(i, j, manifold.between(from_world[i], poses[j]),
                         np.broadcast_to(np.eye(d), (len(i), d, d)))
    judgement = Judgement.nothing().extended(graph, False)
    return as_one(Problem(0, graph, [poses], np.zeros(len(i) * d), judgement, False, 0.0, poses))


def moved(manifold, poses, keyframes):
    """Return poses where some have moved as a whole."""
    far = manifold.retract(manifold.identity(1), np.full((1, manifold.TANGENT_SIZE), 0.7))
    poses = poses.copy()
    poses[keyframes] = manifold.compose(far, poses[keyframes])
    return poses


@pytest.mark.parametrize('manifold', [se2, se3])
@pytest.mark.parametrize(('others', 'moves', 'follow'), [
    # Nothing joins the robots: each part stands behind what its tie names.
    ([], [4, 5, 6], []),
    ([], [7, 8, 9], []),
    # What joins the later part moves the earlier one, though that is tied to robot 0, too.
    ([(2, 8)], [7, 8, 9], [4, 5, 6]),
    # The world joins it.
    ([(WORLD, 8)], [7, 8, 9], [4, 5, 6, 0, 1, 2, 3]),
    ([(WORLD, 5), (WORLD, 1)], [4, 5, 6], [7, 8, 9])])
def test_a_component_is_moved_onto_its_tie(manifold, others, moves, follow):
    of = problem(manifold, *others)
    solved = moved(manifold, of.poses, moves)
    expected = moved(manifold, of.poses, moves + follow) if others else of.poses
    assert_allclose(on_ties(of, of.judgement, solved), expected, atol=1e-12)


def test_where_odometry_is_refused_that_alone_joins_nothing_is_moved():
    of = problem(se2)
    of.judgement.accepted[1] = False
    solved = moved(se2, of.poses, [7, 8, 9])
    assert on_ties(of, of.judgement, solved) is solved


def test_a_map_of_one_part_has_no_ties():
    graph = FactorGraph(se2, 2)
    graph.append_between(np.array([0]), np.array([1]), se2.identity(1), np.eye(3)[None])
    judgement, poses = Judgement.nothing().extended(graph, False), se2.identity(2)
    of = as_one(Problem(0, graph, [poses], np.zeros(3), judgement, False, 0.0, poses))
    assert of.ties == 0 and on_ties(of, judgement, poses) is poses
