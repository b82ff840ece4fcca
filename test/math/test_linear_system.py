# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Graph and poses to A and b: A x - b is the whitened residual after a small step x."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import add_absolute, chain_and_loops, graph_of, random_information, random_poses

from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.graph.factor_graph import WORLD, FactorGraph, turned
from l1slam_ros.core.graph.linear_system import (
    anchor,
    linearise,
    loose_keyframes,
    step_poses,
    whitened_residual,
)

N, LOOPS = 12, 9
M = N - 1 + LOOPS


@pytest.fixture(params=[0, 1, 3], ids=lambda count: f'{count} absolute')
def case(request, rng):
    """A graph with full information matrices and poses that do not fit it; edges both ways."""
    truth = random_poses(N, rng)
    pairs = [pair[::-1] if k % 3 == 0 else pair
             for k, pair in enumerate(chain_and_loops(N, LOOPS, rng))]
    graph = graph_of(truth, pairs, 0.4 * rng.uniform(-1, 1, (M, 3)), random_information(M, rng))
    i = rng.choice(N, request.param, replace=False)
    add_absolute(graph, i, se2.retract(truth[i], 0.2 * rng.standard_normal((len(i), 3))),
                 random_information(len(i), rng))
    return graph, truth


def test_rows_are_the_whitened_residuals_of_the_factors_in_order(case):
    graph, poses = case
    expected, factors = [], graph.between
    for k, (i, j) in enumerate(zip(factors.i, factors.j, strict=True)):
        z, end = factors.measurement[k : k + 1], poses[j : j + 1]
        seen = end if i == WORLD else se2.between(poses[i : i + 1], end)
        expected.append(factors.sqrt_information[k] @ se2.local(z, seen)[0])
    assert_allclose(whitened_residual(graph, poses), np.concatenate(expected))
    assert_array_equal(linearise(graph, poses).b, -whitened_residual(graph, poses))


def test_a_equals_differences_through_step_poses(case):
    graph, poses = case
    A = linearise(graph, poses).A.toarray()
    h = 1e-6
    for column, unit in enumerate(np.eye(A.shape[1])):
        change = [whitened_residual(graph, step_poses(graph, poses, s * h * unit))
                  for s in (1, -1)]
        assert_allclose(A[:, column], (change[0] - change[1]) / (2 * h), atol=1e-7)


def test_the_gauge_is_fixed_by_keyframe_0_or_by_the_world(case, rng):
    graph, poses = case
    fixed = 0 if graph.between.is_absolute.any() else 1
    A = linearise(graph, poses).A
    assert anchor(graph) == fixed
    assert A.shape == (3 * len(graph.between), 3 * (N - fixed))
    assert np.linalg.matrix_rank(A.toarray()) == A.shape[1]
    moved = step_poses(graph, poses, rng.standard_normal(A.shape[1]))
    assert np.array_equal(moved[0], poses[0]) == bool(fixed)
    assert (moved[fixed:] != poses[fixed:]).any(axis=1).all()


# What nothing determines


@pytest.mark.parametrize('absolute, whole, loose', [
    ([], [], [3 - 1]), ([2], [], [0, 3]), ([1, 2, 4, 5], [], [0, 3]), ([1], [2], [3]),
    ([1], [4], [0]), ([1], [0], [3])])
def test_a_part_that_no_whole_factor_ties_to_the_world_may_move(rng, absolute, whole, loose):
    """Of two parts; absolute factors say but x and y, or all; none: the first part is rigid."""
    truth = random_poses(6, rng)
    graph = graph_of(truth, [(0, 1), (1, 2), (3, 4), (4, 5)])
    for k, information in (absolute, np.diag([1.0, 1, 0])), (whole, np.eye(3)):
        k = np.array(k, np.int64)
        add_absolute(graph, k, truth[k], np.tile(information, (len(k), 1, 1)))
    if not absolute:
        graph.add_between(2, 3, np.zeros((1, 3)), np.diag([1.0, 1, 0])[None])
    assert loose_keyframes(graph).tolist() == loose


@pytest.mark.parametrize('manifold', [se2, se3], ids=lambda manifold: manifold.NAME)
def test_a_factor_that_is_turned_says_the_same_to_first_order(rng, manifold):
    d = manifold.TANGENT_SIZE
    graph, start = FactorGraph(manifold, 20), manifold.identity(20)
    poses = manifold.retract(start, rng.normal(size=(20, d)))
    i, j = rng.permutation(20).reshape(2, -1)
    off = manifold.retract(manifold.between(poses[i], poses[j]), 1e-6 * rng.normal(size=(10, d)))
    A = rng.normal(size=(10, d, d))
    graph.add_between(i, j, off, A @ A.transpose(0, 2, 1) + 0.1 * np.eye(d))
    squares = [(whitened_residual(g, poses).reshape(-1, d)**2).sum(axis=1)
               for g in (graph, turned(graph, np.arange(5)))]
    assert_allclose(squares[1], squares[0], rtol=1e-4)
