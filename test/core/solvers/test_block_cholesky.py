# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The block Cholesky factorisation against dense NumPy, on graphs of every shape."""

from threading import Thread

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from systems import (
    PLENTY,
    SHAPES,
    chain,
    cholesky_of_system,
    grid,
    parallel,
    random_loops,
    random_system,
    star,
)

from l1slam_ros.core import kernels
from l1slam_ros.core.errors import FillError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import linearise
from l1slam_ros.core.kernels.prediction import SAMPLES
from l1slam_ros.core.solvers import block_cholesky, gauss_newton
from l1slam_ros.core.solvers.block_cholesky import (
    BlockCholesky,
    cholesky_of,
    find_pattern,
    with_pattern,
)
from l1slam_ros.core.solvers.gauss_newton import ChangingOrder
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

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


@pytest.mark.parametrize('n', [1, 2, 3])
def test_the_smallest_graphs(n, rng):
    system = random_system(2 * chain(n), n, 3, rng)
    cholesky = cholesky_of_system(system)
    assert cholesky.factorise(system, np.ones(len(system.b)))
    check_solution(cholesky, normal(system, np.ones(len(system.b))), rng)


def test_a_graph_without_free_keyframes():
    graph = FactorGraph(se2)
    graph.add_poses(1)
    cholesky = cholesky_of(graph)
    assert cholesky.factorise(linearise(graph, np.zeros((1, 3))), np.zeros(0))
    assert cholesky.solve(np.zeros(0)).shape == (0,)


def test_dense_panels_of_many_columns(rng):
    """All keyframes joined with all: one panel, wider than any tile."""
    pairs = [(i, j) for i in range(23) for j in range(i)] + [(0, 23)]
    for k in (2, 3):
        system = random_system(pairs, 23, k, rng)
        cholesky = cholesky_of_system(system)
        assert cholesky.factorise(system, np.ones(len(system.b)))
        check_solution(cholesky, normal(system, np.ones(len(system.b))), rng)
        assert cholesky.pattern.first.tolist() == [0, 23]


def test_rows_of_wide_panels_are_whole_lines_of_the_cache(rng):
    """Their end is padding, which no solution knows of."""
    pairs = [(i, j) for i in range(23) for j in range(i)] + [(0, 23)]
    system = random_system(pairs, 23, 3, rng)
    cholesky = cholesky_of_system(system)
    assert cholesky.factorise(system, np.ones(len(system.b)))
    layout = cholesky._factored
    assert layout.shape[-1].tolist() == [72] and layout.panels.ctypes.data % 64 == 0
    layout.panels.reshape(69, 72)[:, 69:] = np.nan
    H = normal(system, np.ones(len(system.b)))
    check_solution(cholesky, H, rng)
    none = np.array([-1, -1])
    found, _ = cholesky.covariances(cholesky.pattern.position[:2].astype(np.int64), none,
                                    np.zeros((2, 3, 3)), np.zeros(0), none)
    assert_allclose(found, np.linalg.inv(H)[:6, 3:6].reshape(2, 3, 3), atol=1e-9)
    many = rng.standard_normal((23, 3, SAMPLES))
    expected = np.linalg.solve(H, many.reshape(69, -1))
    cholesky.solve_many(many)
    assert_allclose(many.reshape(69, -1), expected, atol=1e-9)


@pytest.fixture(scope='module')
def large():
    """Large enough for a second thread; k = 6."""
    system = random_system(2 * grid(1800), 1800, 6, np.random.default_rng(5))
    pattern = find_pattern(system.keyframe, 1800, PLENTY, 6)
    assert pattern.work * 6**3 > block_cholesky._SHARED
    return system, pattern


def test_halves_have_nothing_to_do_with_each_other(large):
    pattern = large[1]
    halves = pattern.halves
    for s, half in enumerate(halves):
        above = halves[pattern.owner[pattern.rows[pattern.start[s]:pattern.start[s + 1]]]]
        assert set(above.tolist()) <= {half, 2}
    work = np.bincount(halves, np.diff(pattern.first) * np.diff(pattern.start) ** 2.0, 3)
    assert work.all() and work.max() < 0.5 * work.sum()


@pytest.mark.parametrize('cores', [1, 2])
def test_the_factor_does_not_depend_on_the_cores(cores, large, monkeypatch, rng):
    monkeypatch.setattr('os.sched_getaffinity', lambda _: range(cores), raising=False)
    started = []
    monkeypatch.setattr(Thread, 'start', lambda self, start=Thread.start: (
        started.append(self), start(self)))
    system, pattern = large
    right, found = rng.standard_normal(6 * 1800), []
    for add in (0.1, 0.1, -1e3):
        cholesky = BlockCholesky(pattern, system.keyframe)
        assert cholesky.factorise(system, np.ones(len(system.b)), add) == (add > 0)
        found.append(cholesky.solve(right))
    left = system.transposed_times(system.times(found[0])) + 0.1 * found[0]
    assert_allclose(left, right, atol=1e-9)
    assert_array_equal(found[0], found[1])
    assert len(started) == 3 * (cores - 1)


@pytest.mark.parametrize('keyframe', [0, 900, 1799])
def test_a_bad_pivot_is_found_in_either_half(keyframe, large):
    system, pattern = large
    added = np.zeros((1800, 6))
    added[keyframe] = -1e6
    assert not BlockCholesky(pattern, system.keyframe).factorise(
        system, np.ones(len(system.b)), added.ravel())


def test_one_serves_blocks_of_every_size(rng):
    """Rotations, translations, poses: the last factorisation is the one that solves."""
    whole = random_system(3 * random_loops(N), N, 3, rng)
    cholesky = cholesky_of_system(whole)
    rotations, translations = whole.part(slice(2, 3)), whole.part(slice(0, 2))
    for system in (rotations, translations, whole, rotations, whole):
        weights = rng.uniform(0.1, 3, len(system.b))
        assert cholesky.factorise(system, weights, 0.1)
        check_solution(cholesky, normal(system, weights, 0.1), rng)


def test_a_factorisation_leaves_nothing_behind(rng):
    """Also not one that failed."""
    system = random_system(3 * grid(N), N, 3, rng)
    ones, cholesky = np.ones(len(system.b)), cholesky_of_system(system)
    assert cholesky.factorise(system, 5 * ones)
    assert not cholesky.factorise(system, ones, -1e3)
    assert cholesky.factorise(system, ones)
    check_solution(cholesky, normal(system, ones), rng)


def test_a_pattern_of_more_factors_serves_fewer(rng):
    pairs = random_loops(N)
    pattern = find_pattern(np.array(3 * pairs), N, PLENTY)
    system = random_system(3 * chain(N), N, 2, rng)
    cholesky = BlockCholesky(pattern, system.keyframe)
    assert cholesky.factorise(system, np.ones(len(system.b)))
    check_solution(cholesky, normal(system, np.ones(len(system.b))), rng)


# What may be added to the matrix


@pytest.mark.parametrize('k', [3, 6])
@pytest.mark.parametrize('share', [0.0, 0.3, 1.0])
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


def test_rounding_seldom_passes_for_a_pivot(rng):
    """Without an anchor the last pivot is rounding, as often positive as negative."""
    pairs = [pair for pair in grid(N) if max(pair) < N]
    system = random_system(pairs, N, 3, rng)
    system.blocks[:, 0], system.blocks[:, 1] = -np.eye(3), np.eye(3)
    cholesky = cholesky_of_system(system)
    taken = [cholesky.factorise(system, rng.uniform(0.1, 10, len(system.b))) for _ in range(300)]
    assert sum(taken) < 10


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


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(value, rng):
    system = random_system(3 * chain(N), N, 3, rng)
    weights, cholesky = np.ones(len(system.b)), cholesky_of_system(system)
    weights[40] = value
    with np.errstate(invalid='ignore'):
        assert not cholesky.factorise(system, weights)


def test_units_do_not_matter(rng):
    """Steps in nanometres and in gigaradians: a scaled diagonal is no singularity."""
    system = random_system(3 * grid(N), N, 3, rng)
    scale = np.array([1e-8, 1.0, 1e8])
    blocks = system.blocks * scale
    scaled = type(system)(system.keyframe, blocks, system.b, N)
    cholesky, ones = cholesky_of_system(system), np.ones(len(system.b))
    right = rng.standard_normal(3 * N)
    assert cholesky.factorise(system, ones)
    expected = cholesky.solve(right) / np.tile(scale, N)
    assert cholesky.factorise(scaled, ones)
    assert_allclose(cholesky.solve(right * np.tile(scale, N)), expected, rtol=1e-9)


# The pattern


def filled(pairs, n, position):
    """Return the lower triangle (n, n) bool of the factor in an order, by dense elimination."""
    matrix = np.eye(n, dtype=bool)
    for i, j in pairs:
        if max(i, j) < n:
            matrix[position[i], position[j]] = matrix[position[j], position[i]] = True
    for k in range(n):
        below = k + 1 + np.flatnonzero(matrix[k + 1:, k])
        matrix[np.ix_(below, below)] = True
    return np.tril(matrix)


@pytest.fixture(params=SHAPES, ids=lambda shape: shape.__name__)
def pairs(request):
    return request.param(N)


def test_the_panels_and_the_work_are_those_of_dense_elimination(pairs):
    pattern = find_pattern(np.array(pairs), N, PLENTY)
    assert_array_equal(np.sort(pattern.position), np.arange(N))
    assert (pattern.first[0], pattern.first[-1]) == (0, N)
    assert pattern.start[-1] == len(pattern.rows)
    expected = filled(pairs, N, pattern.position)
    stored = np.zeros((N, N), bool)
    for s, first in enumerate(pattern.first[:-1]):
        rows = pattern.rows[pattern.start[s]:pattern.start[s + 1]]
        stored[np.ix_(rows, range(first, pattern.first[s + 1]))] = True
    stored = np.tril(stored)
    assert not (expected & ~stored).any()
    # Panels hold some zeros for the sake of being large: no more than is said.
    assert stored.sum() <= expected.sum() / (1 - 0.2)
    # Half of the square of each column: its products with itself below the diagonal.
    assert pattern.work == (expected.sum(axis=0).astype(float) ** 2).sum() / 2


def test_a_chain_and_a_star_do_not_fill_in():
    for shape in (chain, star, parallel):
        pattern = find_pattern(np.array(shape(N)), N, PLENTY)
        assert filled(shape(N), N, pattern.position).sum() == N + N - 1


def test_large_blocks_are_worth_the_search_for_a_better_order():
    """On a torus, which is alike everywhere, halves first fill in less than minimum degree."""
    k = np.arange(2500).reshape(50, 50)
    pairs = np.concatenate([np.stack((k.ravel(), np.roll(k, 1, axis).ravel()), axis=1)
                            for axis in range(2)])
    by_degree, better = (find_pattern(pairs, 2500, PLENTY, size) for size in (1, 6))
    assert better.work < 0.8 * by_degree.work
    assert_array_equal(np.sort(better.position), np.arange(2500))


def test_only_what_takes_very_long_is_ordered_by_separators(monkeypatch):
    """Their loops are not compiled before: of a small graph levels alone are the better order."""
    asked = []
    monkeypatch.setattr(kernels.dissection, 'dissect', lambda start, adjacent: (
        asked.append(len(start) - 1) or np.zeros(len(start) - 1, np.int32)))
    for side in (40, 100):
        k = np.arange(side**2).reshape(side, side)
        pairs = np.concatenate([np.stack((k.ravel(), np.roll(k, 1, axis).ravel()), axis=1)
                                for axis in range(2)])
        assert len(find_pattern(pairs, side**2, PLENTY, 6).position) == side**2
    assert asked == [10_000]


def test_of_a_crowded_graph_nothing_but_minimum_degree_is_tried(monkeypatch):
    """Levels and separators save nothing where each keyframe has many neighbours."""
    asked = []
    for kernel in kernels.ordering, kernels.dissection:
        monkeypatch.setattr(kernel, 'dissect', lambda start, adjacent: (
            asked.append(len(start) - 1) or np.zeros(len(start) - 1, np.int32)))
    for size in (20, 40):
        pairs = np.stack(np.triu_indices(size, 1), axis=1)
        assert find_pattern(pairs, size, PLENTY, 24).work * 24**3 > 8000 * size
    assert asked == [20]


def test_a_graph_that_grows_keeps_its_order_for_a_while(rng):
    """Until it has a tenth more keyframes, or if all that is kept would be too much."""
    pairs = np.array(random_loops(N))
    first = find_pattern(pairs[(pairs < 20).all(axis=1)], 20, PLENTY)
    for n, kept in ((21, True), (22, False), (19, False)):
        system = random_system(pairs[(pairs < n).all(axis=1)].tolist(), n, 3, rng)
        pattern = find_pattern(system.keyframe, n, PLENTY, 3, first)
        assert (pattern.found, len(pattern.position)) == (20 if kept else n, n)
        cholesky, right = BlockCholesky(pattern, system.keyframe), rng.standard_normal(3 * n)
        assert cholesky.factorise(system, np.ones(len(system.b)), 0.1)
        x = cholesky.solve(right)
        assert_allclose(system.transposed_times(system.times(x)) + 0.1 * x, right, atol=1e-9)
    least = len(first.columns[-1]) - 1
    assert len(find_pattern(np.array([(0, 1)]), 20, least, 3, first).columns[-1]) == 1


@pytest.mark.parametrize('vast, passed_on', [(0.0, [False, True, True, False]),
                                             (np.inf, [False] * 4)])
def test_while_most_factors_stay_an_order_is_passed_on(vast, passed_on, rng, monkeypatch):
    """Where finding one takes long; solutions are those by an order of their own."""
    asked = []
    find = block_cholesky.find_pattern

    def noted(*arguments):
        *_, before, uses = arguments
        if uses == gauss_newton._FEW:
            asked.append(before is not None)
        return find(*arguments)

    monkeypatch.setattr(block_cholesky, 'find_pattern', noted)
    monkeypatch.setattr(gauss_newton, 'VAST', vast)
    world = simulate_world(300, 900, WorldOptions(), rng)
    odometry = np.flatnonzero(world.graph.between.is_odometry)
    loops = np.flatnonzero(~world.graph.between.is_odometry)
    order = None
    for count in (500, 520, 520, 510, 600):
        rows = np.sort(np.concatenate((odometry, loops[:count])))
        part = world.graph.subset(rows)
        system = linearise(part, world.odometry)
        steps = []
        order = ChangingOrder.of(part, rows, order)
        for cholesky in (with_pattern(order.pattern, part), cholesky_of(part)):
            assert cholesky.factorise(system, np.ones_like(system.b))
            steps.append(cholesky.solve(system.transposed_times(system.b)))
        assert_allclose(*steps, atol=1e-7)
    assert asked == passed_on


def test_too_much_fill_is_refused():
    keyframe = np.array([(i, j) for i in range(20) for j in range(i)])
    below = 20 * 19 // 2
    assert find_pattern(keyframe, 20, 20**2).first.tolist() == [0, 20]
    # Found, but too large; and given up on the way, which is a bound from below.
    for most, least in (20**2 - 1, 20**2), (below - 1, below):
        with pytest.raises(FillError, match=f'20 keyframes and {below} factors .* {least} blocks '
                           'or more') as refusal:
            find_pattern(keyframe, 20, most)
        assert refusal.value.blocks == least
