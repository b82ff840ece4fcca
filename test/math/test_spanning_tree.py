# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Poses along a spanning tree: exact on noise-free graphs, whatever the order of the factors."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import chain_and_loops, chain_of, drive, graph_of

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.spanning_tree import odometry_poses, tree_poses


def assert_same(a, b):
    assert_allclose(se2.local(a, b), 0, atol=1e-9)


def shuffled(pairs, rng):
    """Return the pairs in another order, half of them the other way round."""
    return [tuple(pair)[:: rng.choice([-1, 1])] for pair in rng.permutation(pairs).tolist()]


def test_odometry_is_the_chain_composed_one_by_one(rng):
    n = 300
    noise = 0.3 * rng.standard_normal((n - 1, 3))
    graph = graph_of(drive(n, rng), chain_of(n), noise)
    pose = np.zeros((1, 3))
    poses = odometry_poses(graph)
    for k, z in enumerate(graph.between.measurement, 1):
        pose = se2.compose(pose, z[None])
        assert_same(poses[k : k + 1], pose)


@pytest.mark.parametrize('root', [0, 7, 39])
def test_a_tree_from_any_root_puts_keyframe_0_at_the_identity(root, rng):
    truth = drive(40, rng)
    graph = graph_of(truth, shuffled(chain_and_loops(40, 40, rng), rng))
    poses = tree_poses(graph, root)
    assert_array_equal(poses[0], 0)
    assert_same(poses, truth)


def test_a_tree_takes_the_shortest_way(rng):
    """A chain that slips, and loops to keyframe 0 that do not: the tree uses the loops."""
    n = 50
    truth = drive(n, rng)
    star = [(k, 0) for k in range(1, n)]
    noise = np.zeros((2 * (n - 1), 3))
    noise[1 : n - 1] = 0.5
    graph = graph_of(truth, [*chain_of(n), *star], noise)
    assert_same(tree_poses(graph, 0), truth)
    assert np.abs(se2.local(odometry_poses(graph), truth)).max() > 0.4
