# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The block Cholesky factorisation against dense NumPy, on graphs of every shape."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from systems import (
    PLENTY,
    SHAPES,
    chain,
    cholesky_of_system,
    grid,
    random_system,
)

from l1slam_ros.core import native
from l1slam_ros.core.errors import FillError
from l1slam_ros.core.graph.linear_system import neighbours
from l1slam_ros.core.robust.innovation import SAMPLES
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky, find_pattern

pytestmark = pytest.mark.usefixtures('level')
N = 26


def normal(system, weights, diagonal=0.0):
    A = system.A.toarray()
    return A.T @ (weights[:, None] * A) + np.diag(np.broadcast_to(diagonal, A.shape[1]))


def check_solution(cholesky, matrix, rng):
    """Two right hand sides, to 1e-10 of what the matrix allows, and the determinant."""
    assert_allclose(cholesky.log_det(), np.linalg.slogdet(matrix)[1], rtol=1e-10, atol=1e-8)
    for _ in range(2):
        right = rng.standard_normal(len(matrix))
        expected = np.linalg.solve(matrix, right)
        assert_allclose(cholesky.solve(right), expected, rtol=1e-10,
                        atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize('k', [1, 2, 3, 6])
@pytest.mark.parametrize('shape', SHAPES, ids=lambda shape: shape.__name__)
def test_it_solves_as_numpy_does(shape, k, rng):
    # Twice each pair: random blocks alone are nearly singular now and then.
    system = random_system(3 * shape(N), N, k, rng)
    weights = rng.uniform(0.1, 3, len(system.b))
    cholesky = cholesky_of_system(system)
    for added in 0.1, rng.uniform(0.1, 2, k * N):
        assert cholesky.factorise(system, weights, added)
        check_solution(cholesky, normal(system, weights, added), rng)


@pytest.mark.parametrize('pairs, n', [
    (2 * chain(1), 1), (2 * chain(2), 2), (2 * chain(3), 3),
    ([(i, j) for i in range(23) for j in range(i)] + [(0, 23)], 23)],
    ids=['one keyframe', 'two', 'three', 'all joined with all'])
def test_the_smallest_graphs_and_the_densest_with_many_right_hand_sides(pairs, n, rng):
    """The last is one dense panel, wider than any tile, its rows padded to lines of the cache."""
    system = random_system(pairs, n, 3, rng)
    cholesky, H = cholesky_of_system(system), normal(system, np.ones(3 * len(pairs)))
    assert cholesky.factorise(system, np.ones(len(system.b)))
    check_solution(cholesky, H, rng)
    many = rng.standard_normal((n, 3, SAMPLES))
    expected = np.linalg.solve(H, many.reshape(3 * n, -1))
    cholesky.solve_many(many)
    assert_allclose(many.reshape(3 * n, -1), expected, rtol=1e-8,
                    atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize('cores', [1, 2])
def test_a_large_matrix_is_factored_alike_by_any_number_of_cores(cores, monkeypatch, rng):
    """Halves at the same time; a bad pivot is found in either, and where they meet."""
    monkeypatch.setattr('os.sched_getaffinity', lambda _: range(cores), raising=False)
    system = random_system(2 * grid(1800), 1800, 6, rng)
    ones, right, added = np.ones(len(system.b)), rng.standard_normal(6 * 1800), np.full(10800, 0.1)
    cholesky = BlockCholesky(find_pattern(system.keyframe, 1800, PLENTY, 6), system.keyframe)
    assert cholesky.factorise(system, ones, added)
    x = cholesky.solve(right)
    assert_allclose(system.transposed_times(system.times(x)) + 0.1 * x, right, atol=1e-9)
    for keyframe in 0, 900, 1799:
        bad = added.copy()
        bad[6 * keyframe] = -1e6
        assert not cholesky.factorise(system, ones, bad)
    assert cholesky.factorise(system, ones, added)
    assert_array_equal(cholesky.solve(right), x)


# What may be added to the matrix


@pytest.mark.parametrize('k', [3, 6])
@pytest.mark.parametrize('share', [0.3, 1.0])
@pytest.mark.parametrize('shape', SHAPES, ids=lambda shape: shape.__name__)
def test_a_share_of_the_curvature_is_added(shape, share, k, rng):
    """Of the first factors alone, by turns; the last ones are priors, which have none."""
    system = random_system(3 * shape(N), N, k, rng)
    m = len(system.keyframe) - 3
    turns = np.arange(2 * k).reshape(2, k)[:, k - k // 2:]
    curvature = 0.1 * rng.standard_normal((m, 2 * k, 2 * k))
    curvature += curvature.transpose(0, 2, 1)
    straight = np.delete(np.arange(2 * k), turns.ravel())
    curvature[:, straight[:, None], straight] = 0
    C = np.zeros(((N + 1) * k,) * 2)
    for f, pair in enumerate(system.keyframe[:m]):
        rows = (pair[:, None] * k + np.arange(k)).ravel()
        C[np.ix_(rows, rows)] += curvature[f]
    matrix = normal(system, np.ones(len(system.b)), 3.0) + share * C[:-k, :-k]
    cholesky = cholesky_of_system(system)
    assert np.linalg.eigvalsh(matrix)[0] > 0
    assert cholesky.factorise(system, np.ones(len(system.b)), 3.0,
                              np.ascontiguousarray(curvature[:, turns]), share)
    check_solution(cholesky, matrix, rng)


# Matrices that have no factor


@pytest.mark.parametrize('k', [1, 2, 3, 6])
@pytest.mark.parametrize('shape', SHAPES, ids=lambda shape: shape.__name__)
def test_it_tells_which_matrices_are_positive_definite(shape, k, rng):
    """Just above and just below the smallest eigenvalue."""
    system = random_system(3 * shape(N), N, k, rng)
    ones, cholesky = np.ones(len(system.b)), cholesky_of_system(system)
    smallest = np.linalg.eigvalsh(normal(system, ones))[0]
    assert cholesky.factorise(system, ones, -smallest + 1e-6) is True
    assert cholesky.factorise(system, ones, -smallest - 1e-6) is False


@pytest.mark.parametrize('pairs', [
    chain(N)[1:], [pair for pair in chain(N) if pair != (9, 10)], [(k, N) for k in range(N - 1)]],
    ids=['no anchor', 'two parts', 'a loose keyframe'])
def test_a_part_that_is_not_tied_down_is_singular(pairs, rng):
    """Relative measurements alone, as exact as a graph's Jacobians are."""
    system = random_system(pairs, N, 3, rng)
    system.blocks[:, 0], system.blocks[:, 1] = -np.eye(3), np.eye(3)
    cholesky = cholesky_of_system(system)
    assert not cholesky.factorise(system, rng.uniform(0.5, 2, len(system.b)))


@pytest.mark.parametrize('stiff', [1e6, 1e9, 1e12])
def test_small_pivots_are_not_taken_for_rounding(stiff):
    """A stiff chain held by a soft anchor: x of its end is the force over the anchor's weight."""
    system = random_system(chain(N), N, 1, np.random.default_rng(0))
    system.blocks[:, 0], system.blocks[:, 1] = -1.0, 1.0
    system.blocks[0, 0] = 0.0
    weights = np.append(1.0, np.full(N - 1, stiff))
    cholesky = cholesky_of_system(system)
    assert cholesky.factorise(system, weights)
    x = cholesky.solve(np.append(np.zeros(N - 1), 1.0))
    assert_allclose(x, 1 + np.arange(N) / stiff, rtol=1e-14 * stiff)


# The pattern


def test_the_order_of_least_work_is_taken_where_factorisations_take_long():
    """By levels, which suit what is alike everywhere; by minimum degree for one in the plane."""
    n = 3600
    keyframe = np.array([(k, k + step) for step in (1, 60) for k in range(n - step)])
    graph = neighbours(keyframe, n)
    works = [native.ordering.minimum_degree(*graph, stage)[1] for stage in (
        native.ordering.levels(*graph), native.dissection.dissect(*graph), np.zeros(n, np.int32))]
    assert works == sorted(works)
    assert find_pattern(keyframe, n, 10 * PLENTY, 6).work == works[0]
    assert find_pattern(keyframe, n, 10 * PLENTY, 2, uses=1).work == works[-1]


def test_too_much_fill_is_refused():
    keyframe = np.array([(i, j) for i in range(20) for j in range(i)])
    assert find_pattern(keyframe, 20, 20**2).blocks == 20**2
    with pytest.raises(FillError, match='20 keyframes and 190 factors has 400 blocks'):
        find_pattern(keyframe, 20, 20**2 - 1)


@pytest.mark.parametrize('shape', SHAPES, ids=lambda shape: shape.__name__)
def test_the_panels_and_the_work_are_those_of_dense_elimination(shape):
    pattern = find_pattern(np.array(shape(N)), N, PLENTY)
    expected, stored = np.eye(N, dtype=bool), np.zeros((N, N), bool)
    for i, j in shape(N):
        if max(i, j) < N:
            one, other = pattern.position[[i, j]]
            expected[one, other] = expected[other, one] = True
    for k in range(N):
        below = k + 1 + np.flatnonzero(expected[k + 1:, k])
        expected[np.ix_(below, below)] = True
    expected = np.tril(expected)
    for s, first in enumerate(pattern.first[:-1]):
        rows = pattern.rows[pattern.start[s]:pattern.start[s + 1]]
        stored[np.ix_(rows, range(first, pattern.first[s + 1]))] = True
    stored = np.tril(stored)
    assert not (expected & ~stored).any()
    # Panels hold some zeros for the sake of being large: no more than is said.
    assert stored.sum() <= expected.sum() / (1 - 0.2)
    # Half of the square of each column: its products with itself below the diagonal.
    assert pattern.work == (expected.sum(axis=0).astype(float) ** 2).sum() / 2
