# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`FactorGraph`: append-only, snapshots that stay valid, and what it refuses."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import l1slam_ros as l1

PLANE = l1.Backend().manifold
WORLD = -1
ONE = np.eye(3)


def graph_with(n, pairs):
    """Return a graph of n keyframes whose factors measure their own indices."""
    graph = l1.FactorGraph(PLANE, n)
    for i, j in pairs:
        graph.add_between(i, j, np.array([[i, j, 0.0]]), ONE[None])
    return graph


def pairs_of(graph):
    return np.stack((graph.between.i, graph.between.j), axis=1).tolist()


def test_factors_are_kept_in_the_order_they_came(rng):
    graph = l1.FactorGraph(PLANE, 2)
    graph.add_poses()
    measurement, root = rng.uniform(-3, 3, (6, 3)), rng.standard_normal((6, 3, 3))
    information = root @ root.transpose(0, 2, 1) + 0.5 * ONE
    i, j = np.array([0, 2, WORLD, WORLD, 1, 0]), np.array([1, 0, 2, 0, 2, 1])
    for rows in slice(0, 3), slice(3, 5), slice(5, 6):
        graph.add_between(i[rows], j[rows], measurement[rows], information[rows])
    factors = graph.between
    assert_array_equal((factors.i, factors.j), (i, j))
    assert factors.pairs.tolist() == [[0, 1], [2, 0], [2, 2], [0, 0], [1, 2], [0, 1]]
    assert_array_equal(factors.measurement, measurement)
    root = factors.sqrt_information
    assert_allclose(root, np.triu(root))
    assert_allclose(root.transpose(0, 2, 1) @ root, information)
    # That next to the world is keyframe 0 by its number, and no step of the odometry; the second
    # of two parallel ones is a loop.
    assert factors.is_absolute.tolist() == [False, False, True, True, False, False]
    assert factors.is_odometry.tolist() == [True, False, False, False, True, False]


@pytest.mark.parametrize('pairs, odometry', [
    ([(1, 0), (0, 1), (1, 2)], [True, False, True]),  # either way round
    ([(3, 2), (0, 3), (2, 1), (1, 0), (0, 2)], [True, False, True, True, False]),
    ([(5, 2), (0, 3), (0, 2)], [False, False, False]),
    ([(7, 8), (0, 1), (7, 6), (6, 7), (1, 0)], [True, True, True, False, False])])
def test_odometry_is_the_first_factor_between_consecutive_keyframes(pairs, odometry):
    assert graph_with(9, pairs).between.is_odometry.tolist() == odometry


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
    graph, snapshots = graph_with(100, []), []
    for k in range(99):
        snapshots.append(graph.between)
        graph.add_between(k, k + 1, np.full((1, 3), k), ONE[None])
    graph.say(np.arange(50), trusted=True)
    for k, factors in enumerate(snapshots):
        assert_array_equal(factors.i, np.arange(k))
        assert_array_equal(factors.measurement[:, 0], np.arange(k))
        assert not factors.trusted.any()
    assert graph.between.trusted.sum() == 50


@pytest.mark.parametrize('size', [0, 1, 15, 16, 17, 40])
def test_a_copy_and_its_original_grow_apart(size):
    original = graph_with(size + 2, [(k, k + 1) for k in range(size)])
    copy = original.copy()
    copy.add_poses(5)
    before = original.between
    copy.add_between(size + 5, 0, np.ones((1, 3)), ONE[None], True)
    original.add_between(0, size + 1, np.zeros((1, 3)), 4 * ONE[None])
    assert (original.n_poses, copy.n_poses) == (size + 2, size + 7)
    assert pairs_of(original)[-1] == [0, size + 1] and pairs_of(copy)[-1] == [size + 5, 0]
    assert pairs_of(original)[:-1] == pairs_of(copy)[:-1]
    assert_array_equal(original.between.sqrt_information[-1], 2 * ONE)
    assert_array_equal(copy.between.sqrt_information[-1], ONE)
    assert copy.between.trusted.tolist() == [False] * size + [True]
    assert not original.between.trusted.any() and len(before.trusted) == size


def bad(row, column, value):
    """Return the identity with one other entry."""
    matrix = ONE.copy()
    matrix[row, column] = value
    return matrix


UNKNOWN = 'a factor names keyframe {}, the graph has 0 to 2'


@pytest.mark.parametrize('i, j, value, information, said', [
    (3, 0, 0.0, ONE, UNKNOWN.format(3)),
    (-2, 0, 0.0, ONE, UNKNOWN.format(-2)),
    (0, -1, 0.0, ONE, UNKNOWN.format(-1)),
    (2, 2, 0.0, ONE, 'keyframe 2 has a factor to itself'),
    (1, 2, np.nan, ONE, 'measurement 1 is not finite: [ 0. nan  0.]'),
    (1, 2, 0.0, [[1, 2, 0], [2, 1, 0], [0, 0, 1]],
     'matrix 1 is not positive definite: [1 2 0; 2 1 0; 0 0 1]'),
    (1, 2, 0.0, 0 * ONE, 'matrix 1 is not positive definite: [0 0 0; 0 0 0; 0 0 0]'),
    (1, 2, 0.0, bad(0, 1, 0.5), 'matrix 1 is not symmetric: [1 0.5 0; 0 1 0; 0 0 1]'),
    (1, 2, 0.0, bad(1, 1, np.nan), 'matrix 1 is not finite: [1 0 0; 0 nan 0; 0 0 1]'),
    (1, 2, 0.0, bad(1, 1, 1e31),
     'matrix 1 is not within 1e-30 to 1e+30 on its diagonal: [1 0 0; 0 1e+31 0; 0 0 1]'),
])
def test_a_bad_factor_is_named_and_nothing_is_appended(i, j, value, information, said):
    graph = graph_with(3, [(0, 1)])
    measurement = np.zeros((2, 3))
    measurement[1, 1] = value
    with pytest.raises(l1.L1SlamError) as caught:
        graph.add_between(np.array([0, i]), np.array([1, j]), measurement,
                          np.array([ONE, information]))
    assert str(caught.value) == said
    # Of a matrix as files print it the last digit may differ.
    graph.add_between(1, 2, np.full((1, 3), 0.5), bad(0, 1, 1e-5)[None])
    assert pairs_of(graph) == [[0, 1], [1, 2]]
    assert_array_equal(graph.between.measurement[1], [0.5] * 3)


@pytest.mark.parametrize('shape', [(1, 3), (3, 3), (2, 4)])
def test_arrays_that_do_not_fit_together_are_refused(shape):
    graph = graph_with(3, [])
    with pytest.raises(l1.L1SlamError, match=r'have the shapes .*, expected \[\(2,\), \(2,\)'):
        graph.add_between(np.array([0, 1]), np.array([1, 2]), np.zeros(shape),
                          np.array([ONE, ONE]))
    assert not len(graph.between)
