# SPDX-License-Identifier: Apache-2.0
"""The factor graph: append-only, snapshots that stay valid, and what it refuses."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import add_absolute, random_information, random_poses

from l1slam_ros.core.errors import GraphError, L1SlamError, NoiseError
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.graph.factor_graph import (
    WORLD,
    BetweenFactors,
    FactorGraph,
    component_labels,
    turned,
)
from l1slam_ros.core.graph.linear_system import whitened_residual


def between(i, j):
    """Return factors between the given keyframes that measure nothing in particular."""
    m = len(i)
    return BetweenFactors(np.array(i), np.array(j), np.zeros((m, 3)), np.zeros((m, 3, 3)),
                          *np.zeros((2, m), bool))


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
    columns = vars(graph.between).values()
    assert {len(column) for column in columns} == {0}


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
