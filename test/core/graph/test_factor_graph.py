# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The factor graph: append-only, snapshots that stay valid, and what it refuses."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import add_absolute, random_information, random_poses

from l1slam_ros.core.errors import GraphError, L1SlamError, NoiseError
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.graph.factor_graph import (
    NO_PREDECESSOR,
    WORLD,
    BetweenFactors,
    FactorGraph,
    component_labels,
    turned,
)
from l1slam_ros.core.graph.l1_problem import GraphProblem
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.parts import bridged, odometry_gaps
from l1slam_ros.core.graph.recording import recorded
from l1slam_ros.core.graph.spanning_tree import odometry_poses


def between(i, j):
    """Return factors between the given keyframes that measure nothing in particular."""
    m = len(i)
    return BetweenFactors(np.array(i), np.array(j), np.zeros((m, 3)), np.zeros((m, 3, 3)),
                          *np.zeros((2, m), bool), np.arange(-1, 8))


def graph_with(n, pairs):
    graph = FactorGraph(se2, n)
    for i, j in pairs:
        graph.add_between(i, j, np.array([[i, j, 0.0]]), np.eye(3)[None])
    return graph


def pairs_of(graph):
    return np.stack((graph.between.i, graph.between.j), axis=1).tolist()


def test_factors_are_kept_in_the_order_they_came(rng):
    graph = FactorGraph(se2, 2)
    graph.add_poses()
    measurement, information = random_poses(4, rng), random_information(4, rng)
    graph.add_between(np.array([0, 2, 1]), np.array([1, 0, 2]), measurement[:3], information[:3])
    graph.add_between(np.array([2]), np.array([1]), measurement[3:], information[3:])
    factors = graph.between
    assert pairs_of(graph) == [[0, 1], [2, 0], [1, 2], [2, 1]]
    assert_array_equal(factors.measurement, measurement)
    root = factors.sqrt_information
    assert_allclose(root.transpose(0, 2, 1) @ root, information)


def test_the_world_is_an_end_like_any_keyframe(rng):
    graph = graph_with(3, [(0, 1)])
    measurement, information = random_poses(2, rng), random_information(2, rng)
    add_absolute(graph, np.array([2, 0]), measurement, information)
    graph.add_between(1, 2, np.zeros((1, 3)), np.eye(3)[None])
    factors = graph.between
    assert pairs_of(graph) == [[0, 1], [WORLD, 2], [WORLD, 0], [1, 2]]
    assert factors.pairs.tolist() == [[0, 1], [2, 2], [0, 0], [1, 2]]
    # That next to the world is keyframe 0 by its number, and no step of the odometry.
    assert factors.is_odometry.tolist() == [True, False, False, True]
    assert_array_equal(factors.measurement[1:3], measurement)
    root = factors.sqrt_information[1:3]
    assert_allclose(root.transpose(0, 2, 1) @ root, information)


def test_what_only_the_world_ties_together_is_one_part():
    graph = graph_with(7, [(0, 1), (2, 3), (5, 6)])
    assert component_labels(graph).tolist() == [0, 0, 1, 1, 2, 3, 3]
    add_absolute(graph, np.array([3, 6]), np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)))
    assert component_labels(graph).tolist() == [0, 0, 1, 1, 2, 1, 1]
    assert component_labels(graph_with(5, [(0, 4), (3, 1), (4, 2)])).tolist() == [0, 1, 0, 1, 0]


def test_rows_of_zeros_say_nothing():
    graph = graph_with(2, [(0, 1)])
    information = np.array([[[4.0, 0, 2], [0, 0, 0], [2, 0, 5]], np.diag([0, 0, 9.0])])
    graph.add_between(np.array([WORLD, 0]), np.array([0, 1]), np.zeros((2, 3)), information)
    factors = graph.between
    assert factors.freedom.tolist() == [3, 2, 1]
    assert factors.speaks[1:].tolist() == [[True, False, True], [False, False, True]]
    assert_array_equal(factors.sqrt_information[1:], [
        [[2, 0, 1], [0, 0, 0], [0, 0, 2]], np.diag([0, 0, 3])])


def test_a_snapshot_stays_as_it_was_while_the_graph_grows():
    graph = graph_with(100, [])
    snapshots = []
    for k in range(99):
        snapshots.append(graph.between)
        graph.add_between(k, k + 1, np.full((1, 3), k), np.eye(3)[None])
    for k, factors in enumerate(snapshots):
        assert len(factors) == k
        assert_array_equal(factors.i, np.arange(k))
        assert_array_equal(factors.measurement[:, 0], np.arange(k))


@pytest.mark.parametrize('size', [0, 1, 15, 16, 17, 40])
def test_a_copy_and_its_original_grow_apart(size):
    original = graph_with(size + 2, [(k, k + 1) for k in range(size)])
    copy = original.copy()
    copy.add_poses(5)
    before = original.between
    copy.add_between(size + 5, 0, np.ones((1, 3)), np.eye(3)[None], True)
    original.add_between(0, size + 1, np.zeros((1, 3)), 4 * np.eye(3)[None])
    assert (original.n_poses, copy.n_poses) == (size + 2, size + 7)
    assert pairs_of(original)[-1] == [0, size + 1] and pairs_of(copy)[-1] == [size + 5, 0]
    assert pairs_of(original)[:-1] == pairs_of(copy)[:-1]
    assert_array_equal(original.between.sqrt_information[-1], 2 * np.eye(3))
    assert_array_equal(copy.between.sqrt_information[-1], np.eye(3))
    assert copy.between.trusted.tolist() == [False] * size + [True]
    assert not original.between.trusted.any() and len(before.trusted) == size


@pytest.mark.parametrize('i, j, odometry', [
    ([0, 1, 2], [1, 2, 3], [True, True, True]),
    ([0, 0, 1], [1, 1, 2], [True, False, True]),  # the second of two parallel ones is a loop
    ([1, 0, 1], [0, 1, 2], [True, False, True]),  # either way round
    ([3, 0, 2, 1, 0], [2, 3, 1, 0, 2], [True, False, True, True, False]),
    ([5, 0, 0], [2, 3, 2], [False, False, False]),
    ([7, 0, 7, 6, 1], [8, 1, 6, 7, 0], [True, True, True, False, False]),
])
def test_odometry_is_the_first_factor_between_consecutive_keyframes(i, j, odometry):
    assert between(i, j).is_odometry.tolist() == odometry


GOOD = np.eye(3)
BAD_FACTORS = [
    ([0, 3], [1, 0], 0.0, GOOD, GraphError, 'a factor names keyframe 3, the graph has 0 to 2'),
    ([0, -2], [1, 0], 0.0, GOOD, GraphError, 'a factor names keyframe -2, the graph has 0 to 2'),
    ([0, -1], [1, 3], 0.0, GOOD, GraphError, 'a factor names keyframe 3, the graph has 0 to 2'),
    ([0, -1], [1, -1], 0.0, GOOD, GraphError, 'keyframe -1 has a factor to itself'),
    ([0, 0], [1, -1], 0.0, GOOD, GraphError, 'a factor names keyframe -1, the graph has 0 to 2'),
    ([0, 2], [1, 2], 0.0, GOOD, GraphError, 'keyframe 2 has a factor to itself'),
    ([0, 1], [1, 2], np.nan, GOOD, GraphError, 'measurement 1 is not finite: [ 0. nan  0.]'),
    ([0, 1], [1, 2], np.inf, GOOD, GraphError, 'measurement 1 is not finite: [ 0. inf  0.]'),
    ([0, -1], [1, 2], 0.0, np.array([[1.0, 0.1, 0], [0.1, 0, 0], [0, 0, 1]]), NoiseError,
     'matrix 1 is not positive definite: [1 0.1 0; 0.1 0 0; 0 0 1]'),
]


@pytest.mark.parametrize('i, j, value, information, error, said', BAD_FACTORS)
def test_a_bad_factor_is_named_and_nothing_is_appended(i, j, value, information, error, said):
    graph = graph_with(3, [(0, 1)])
    measurement = np.zeros((2, 3))
    measurement[1, 1] = value
    with pytest.raises(error) as caught:
        graph.add_between(np.array(i), np.array(j), measurement, np.array([GOOD, information]))
    assert str(caught.value) == said
    assert isinstance(caught.value, L1SlamError)
    graph.add_between(1, 2, np.full((1, 3), 0.5), GOOD[None])
    assert pairs_of(graph) == [[0, 1], [1, 2]]
    assert_array_equal(graph.between.measurement[1], [0.5] * 3)
    assert len(graph.between.sqrt_information) == 2


@pytest.mark.parametrize('shape', [(1, 3), (3, 3), (2, 4)])
def test_arrays_that_do_not_fit_together_are_refused(shape):
    graph = graph_with(3, [])
    with pytest.raises((GraphError, ValueError)):
        graph.add_between(np.array([0, 1]), np.array([1, 2]), np.zeros(shape),
                          np.array([GOOD, GOOD]))
    columns = vars(graph.between) | {'predecessor': ()}  # that is of the keyframes
    assert {len(column) for column in columns.values()} == {0}


@pytest.mark.parametrize('manifold', [se2, se3])
def test_a_factor_that_is_turned_says_the_same_to_first_order(rng, manifold):
    d = manifold.TANGENT_SIZE
    graph, start = FactorGraph(manifold), manifold.identity(20)
    poses = manifold.retract(start, rng.normal(size=(20, d)))
    graph.add_poses(20)
    i, j = rng.permutation(20).reshape(2, -1)
    off = manifold.retract(manifold.between(poses[i], poses[j]), 1e-6 * rng.normal(size=(10, d)))
    A = rng.normal(size=(10, d, d))
    graph.add_between(i, j, off, A @ A.transpose(0, 2, 1) + 0.1 * np.eye(d))
    squares = [(whitened_residual(g, poses).reshape(-1, d)**2).sum(axis=1)
               for g in (graph, turned(graph, np.arange(5)))]
    assert_allclose(squares[1], squares[0], rtol=1e-4)


def two_robots(rng):
    """Return a graph of two robots whose keyframes come in turns, and poses it measures."""
    graph = FactorGraph(se2)
    truth = random_poses(6, rng)
    root = 2 * np.eye(3)[None]
    for robot in 0, 1:
        graph.add_poses(1, robot, begins_part=True)
    for k, robot in (2, 0), (3, 1), (4, 1), (5, 0):
        before = np.flatnonzero(graph.robot == robot)[-1]
        graph.append_step(se2.between(truth[before:before + 1], truth[k:k + 1]), root, robot)
    i, j = np.array([1, 3]), np.array([2, 5])
    graph.append_between(i, j, se2.between(truth[i], truth[j]), np.tile(root, (2, 1, 1)))
    return graph, truth


def test_keyframes_of_several_robots_come_in_any_order(rng):
    graph, truth = two_robots(rng)
    assert graph.robot.tolist() == [0, 1, 0, 1, 1, 0]
    assert graph.predecessor.tolist() == [NO_PREDECESSOR, NO_PREDECESSOR, 0, 1, 3, 2]
    factors = graph.between
    # One loop joins neighbours in the order of their indices.
    assert factors.is_odometry.tolist() == 4 * [True] + 2 * [False]
    assert factors.step_to.tolist() == [-1, -1, 0, 1, 2, 3]
    assert odometry_gaps(graph).tolist() == [0]
    assert graph.subset(np.array([3, 4])).between.is_odometry.tolist() == [True, False]
    turned_round = turned(graph, np.arange(6)).between
    assert_array_equal(turned_round.is_odometry, factors.is_odometry)
    stamps = list(range(1, 7))
    poses = se2.from_pose3(np.stack([sample.pose3 for sample, _ in recorded(graph, stamps)]))
    for own in [0, 2, 5], [1, 3, 4]:
        way = se2.between(truth[own[:1] * 3], truth[own])
        assert_allclose(se2.local(poses[own], way), 0, atol=1e-12)
    with pytest.raises(GraphError, match='keyframe 1 has no predecessor'):
        odometry_poses(graph)
    # For a judge of chains one is made of them; the graph stays as it is.
    assert odometry_poses(bridged(graph)).shape == (6, 3)
    assert graph.predecessor[1] == NO_PREDECESSOR


def test_a_step_along_is_one_along_predecessors(rng):
    graph, truth = two_robots(rng)
    x, problem = 1e-5 * rng.standard_normal(15), GraphProblem(graph)
    apart = se2.local(problem.step(truth, x), problem.step_along(truth, x))
    assert np.abs(apart).max() < 1e-8
    # What leads to a keyframe is changed by its own step and that of its predecessor alone.
    x[:12] = 0.0
    moved = problem.step_along(truth, x)
    assert_allclose(moved[:5], truth[:5], atol=1e-12)


def test_what_was_seen_of_predecessors_stays():
    graph = graph_with(4, [(0, 1), (1, 2), (2, 3)])
    before, copy = graph.predecessor, graph.copy()
    graph.follow(np.array([2]), NO_PREDECESSOR)
    graph.add_poses()
    assert before.tolist() == copy.predecessor.tolist() == [-1, 0, 1, 2]
    assert graph.predecessor.tolist() == [-1, 0, -1, 2, 3]
    assert graph.between.is_odometry.tolist() == [True, False, True]
    assert copy.between.is_odometry.all()
