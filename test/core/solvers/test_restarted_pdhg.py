# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The fast primal-dual method: kernel against NumPy, answers against HiGHS, starts, deadlines."""

import time

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import linprog_l1, noisy_graph

from l1slam_ros.core.graph.linear_system import LinearSystem, linearise
from l1slam_ros.core.graph.tiles import Tiles
from l1slam_ros.core.kernels import halpern as kernels
from l1slam_ros.core.solvers.optimality import Status, l1_cost
from l1slam_ros.core.solvers.primal_dual import CHECK_EVERY, PrimalDualOptions, minimise_l1
from l1slam_ros.core.solvers.restarted_pdhg import minimise_l1_halpern, scaled_system

BLOCK_SIZES = [1, 2, 3, 6]


def halpern_step(A, b, x, y, y0, weight, k):
    """Return the next (x, y), k iterations after the restart, as the solver's page has it."""
    d = A.T @ y / weight
    y_bar = np.clip(y + weight * (A @ (x - 2 * d) - b), -1, 1)
    a = (k + 1) / (k + 2)
    return a * (x - 2 * d), a * (2 * y_bar - y) + (1 - a) * y0


def chain_with_loops(k, rng, size=12, loops=20, absolute=2):
    """Return a system with a keyframe held fixed, loops, and the world; blocks differ in scale."""
    i = np.concatenate((np.arange(-1, size - 1), rng.integers(0, size, loops)))
    j = np.concatenate((np.arange(size), (i[size:] + rng.integers(1, size, loops)) % size))
    i[0] = size
    keyframe = np.stack((i, j), axis=1)
    keyframe = np.concatenate((keyframe, np.stack((rng.integers(0, size, absolute),
                                                   np.full(absolute, size)), axis=1)))
    m = len(keyframe)
    blocks = rng.standard_normal((m, 2, k, k)) * 10 ** rng.uniform(-1, 1, (m, 1, 1, 1))
    blocks[len(i):, 1] = 0
    return LinearSystem(keyframe, blocks, rng.standard_normal(m * k), size)


def zeros(system):
    return np.zeros(system.size * system.block_size), np.zeros(len(system.b))


def laid_out(system, y, y0, dtype):
    """Return tiles (flat), keyframes and their order, written out anew."""
    k = system.block_size
    tiles = Tiles(system.keyframe, system.size, kernels.LANES)
    rows = np.concatenate((system.blocks.reshape(-1, 2 * k * k),
                           *(v.reshape(-1, k) for v in (system.b, y, y0))), axis=1)
    packed = tiles.pack(rows).astype(dtype)
    return tiles, packed, packed.reshape(len(packed), -1)


# Scaling


@pytest.mark.parametrize('k', BLOCK_SIZES)
def test_the_scaled_operator_is_within_1_and_close_to_it(k, rng):
    scaled, _ = scaled_system(chain_with_loops(k, rng))
    assert 0.5 < np.linalg.norm(scaled.A.toarray(), 2) <= 1 + 1e-12


@pytest.mark.parametrize('k', BLOCK_SIZES)
def test_scaling_changes_the_unknowns_alone(k, rng):
    system = chain_with_loops(k, rng)
    scaled, inverse = scaled_system(system)
    z = rng.standard_normal((system.size, k))
    x = np.einsum('nij,nj->ni', inverse, z).ravel()
    assert_allclose(scaled.A @ z.ravel(), system.A @ x, atol=1e-9)


def test_a_keyframe_without_factors_is_no_trouble(rng):
    system = chain_with_loops(3, rng)
    lonely = LinearSystem(np.where(system.keyframe == 12, 13, system.keyframe), system.blocks,
                          system.b, 13)
    solution = minimise_l1_halpern(lonely, *zeros(lonely), PrimalDualOptions(iterations=400))
    assert_array_equal(solution.x[-3:], 0)
    assert np.isfinite(solution.x).all()


# The kernel


@pytest.mark.parametrize('dtype, within', [(np.float32, 2e-4), (np.float64, 1e-6)])
@pytest.mark.parametrize('k', BLOCK_SIZES)
def test_the_kernel_takes_the_steps_of_the_page(k, dtype, within, rng):
    """One and some at a time; tiles are packed in single precision, so A itself is rounded."""
    system, _ = scaled_system(chain_with_loops(k, rng))
    y0 = rng.uniform(-1, 1, len(system.b))
    y = y0.copy()
    weight = 0.7
    K = (0,) * k
    layout, packed, flat = laid_out(system, y, y0, dtype)
    x, z, g = np.zeros((3, system.size + 1, k), dtype)
    g[:-1] = (system.A.T @ y).reshape(-1, k)
    expected = np.zeros(system.size * k)
    done = 0
    for count in (*[1] * 12, 5, 12):
        kernels.iterate(flat, layout.keyframes, x, z, g, weight, done, count, K)
        for iteration in range(done, done + count):
            expected, y = halpern_step(system.A, system.b, expected, y, y0, weight, iteration)
        done += count
        found_y = layout.unpack(packed[:, 2 * k * k + k: 2 * k * k + 2 * k]).ravel()
        assert_allclose(x[:-1].ravel(), expected, atol=within * max(1, np.abs(expected).max()))
        assert_allclose(found_y, y, atol=within)
        assert_allclose(g[:-1].ravel(), system.A.T @ y, atol=10 * within)
        assert_array_equal(x[-1], 0)


@pytest.mark.parametrize('k', BLOCK_SIZES)
def test_a_look_finds_the_next_point_and_its_residual(k, rng):
    system, _ = scaled_system(chain_with_loops(k, rng))
    A = system.A
    b = system.b
    weight = 0.4
    K = (0,) * k
    y = rng.uniform(-1, 1, len(b))
    layout, _, flat = laid_out(system, y, y, np.float32)
    x, g, x_bar, g_bar = np.zeros((4, system.size + 1, k), np.float32)
    x[:-1] = rng.standard_normal((system.size, k))
    g[:-1] = (A.T @ y).reshape(-1, k)
    y_bar = np.zeros((len(flat), k * kernels.LANES), np.float32)
    residual, cost, dual = kernels.look(flat, layout.keyframes, x, g, weight, x_bar, g_bar,
                                        y_bar, K)
    d = A.T @ y / weight
    at = x[:-1].ravel().astype(float)
    new = np.clip(y + weight * (A @ (at - 2 * d) - b), -1, 1)
    dy = new - y
    assert_allclose(x_bar[:-1].ravel(), at - d, atol=1e-4)
    assert_allclose(layout.unpack(y_bar.reshape(-1, k, kernels.LANES)).ravel(), new, atol=1e-4)
    assert_allclose(g_bar[:-1].ravel(), A.T @ new, atol=1e-3)
    assert residual == pytest.approx(weight * d @ d + dy @ dy / weight + 2 * dy @ (A @ d),
                                     rel=1e-3)
    assert cost == pytest.approx(l1_cost(A @ (at - d) - b), rel=1e-4)
    assert dual == pytest.approx(-b @ new, rel=1e-3, abs=1e-3)


# The solver


@pytest.mark.parametrize('k', BLOCK_SIZES)
def test_the_first_step_is_from_the_dual_that_is_given(k, rng):
    system, weight = chain_with_loops(k, rng), 0.4
    scaled, inverse = scaled_system(system)
    y = rng.uniform(-1, 1, len(system.b))
    found = minimise_l1_halpern(system, zeros(system)[0], y, PrimalDualOptions(1, 0.0), weight)
    x, y = halpern_step(scaled.A, system.b, zeros(system)[0], y, y, weight, 0)
    expected = inverse @ (x - scaled.A.T @ y / weight).reshape(-1, k, 1)
    assert_allclose(found.x, expected.ravel(), atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize('k', BLOCK_SIZES)
def test_it_agrees_with_highs(k, rng):
    for _ in range(3):
        system = chain_with_loops(k, rng)
        options = PrimalDualOptions(iterations=200_000, tolerance=1e-4)
        solution = minimise_l1_halpern(system, *zeros(system), options)
        best, _ = linprog_l1(system.A, system.b)
        assert solution.status is Status.CONVERGED
        assert (1 - 1e-9) * best <= solution.objective <= (1 + 1e-4) * best
        assert solution.objective == pytest.approx(l1_cost(system.A @ solution.x - system.b))
        assert np.abs(solution.y).max() <= 1


def test_it_agrees_with_highs_on_a_pose_graph_in_far_fewer_iterations_than_algorithm_2(rng):
    graph, truth = noisy_graph(200, 300, rng)
    system = linearise(graph, truth)
    best, _ = linprog_l1(system.A, system.b)
    fast = minimise_l1_halpern(system, *zeros(system), PrimalDualOptions(
        iterations=100_000, tolerance=1e-4))
    plain = minimise_l1(system.A, system.b, *zeros(system), PrimalDualOptions(
        iterations=2 * fast.iterations, tolerance=0.0))
    assert fast.objective == pytest.approx(best, rel=1e-4)
    assert plain.objective - best > 2 * (fast.objective - best)


@pytest.mark.parametrize('offset', [0.0, 1e4])
def test_single_precision_is_refined(offset, rng):
    """A start far away: in single precision alone A x would lose what b holds."""
    system = chain_with_loops(3, rng)
    x, y = zeros(system)
    moved = LinearSystem(system.keyframe, system.blocks,
                         system.b + system.A @ np.full(len(x), offset), system.size)
    solution = minimise_l1_halpern(moved, x + offset, y, PrimalDualOptions(
        iterations=100_000, tolerance=1e-5))
    best, _ = linprog_l1(system.A, system.b)
    assert solution.status is Status.CONVERGED
    assert solution.objective == pytest.approx(best, rel=2e-5)


@pytest.mark.parametrize('k', [1, 3])
def test_the_gap_bounds_the_error_within_its_box(k, rng):
    """Early and late, against HiGHS inside the box that the docstring names."""
    system = chain_with_loops(k, rng)
    scaled, inverse = scaled_system(system)
    for iterations in (40, 400, 4000):
        solution = minimise_l1_halpern(system, *zeros(system), PrimalDualOptions(
            iterations=iterations, tolerance=0.0))
        z = np.linalg.solve(inverse, solution.x.reshape(-1, k, 1)).ravel()
        best, _ = linprog_l1(scaled.A, scaled.b, np.abs(z) + 1 / solution.weight)
        assert solution.objective - solution.gap <= best * (1 + 1e-5)


@pytest.mark.parametrize('left', [0.0, 0.05])
def test_a_deadline_is_kept(left, rng):
    system, start = chain_with_loops(3, rng), time.monotonic()
    found = minimise_l1_halpern(system, *zeros(system), PrimalDualOptions(10**7, 0.0),
                                deadline=start + left)
    assert found.status is Status.OUT_OF_TIME
    assert left <= time.monotonic() - start < 1
    assert left or found.iterations == CHECK_EVERY


def test_a_system_without_factors_or_without_keyframes():
    empty = LinearSystem(np.zeros((0, 2), np.int64), np.zeros((0, 2, 3, 3)), np.zeros(0), 4)
    solution = minimise_l1_halpern(empty, np.ones(12), np.zeros(0), PrimalDualOptions())
    assert solution.status is Status.CONVERGED and solution.objective == 0
    assert_array_equal(solution.x, 1)
    fixed = LinearSystem(np.zeros((1, 2), np.int64), np.zeros((1, 2, 3, 3)), np.ones(3), 0)
    solution = minimise_l1_halpern(fixed, np.zeros(0), np.zeros(3), PrimalDualOptions())
    assert solution.objective == 3 and solution.gap == 0


def test_an_exact_fit_stays_finite(rng):
    system = chain_with_loops(3, rng)
    x = rng.standard_normal(36)
    exact = LinearSystem(system.keyframe, system.blocks, system.A @ x, system.size)
    solution = minimise_l1_halpern(exact, x, np.zeros(len(exact.b)), PrimalDualOptions())
    assert_allclose(solution.x, x, atol=1e-5)
    cold = minimise_l1_halpern(exact, *zeros(exact), PrimalDualOptions(
        iterations=20_000, tolerance=1e-6))
    assert cold.objective < 1e-6 * l1_cost(exact.b)
