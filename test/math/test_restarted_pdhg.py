# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The fast primal-dual method: its steps against NumPy, its answers against HiGHS, deadlines."""

import time

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import linprog_l1

from l1slam_ros.core.graph.linear_system import LinearSystem
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.solvers.primal_dual import PrimalDualOptions
from l1slam_ros.core.solvers.restarted_pdhg import minimise_l1_halpern, scaled_system

pytestmark = pytest.mark.usefixtures('level')
SIZES = pytest.mark.parametrize('k', [1, 2, 3, 6])


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


def solve(system, start, iterations, tolerance=0.0, **more):
    return minimise_l1_halpern(system, *start, PrimalDualOptions(iterations, tolerance), **more)


@SIZES
def test_scaling_changes_the_unknowns_alone_to_a_norm_close_to_1(k, rng):
    system = chain_with_loops(k, rng)
    scaled, inverse = scaled_system(system)
    assert 0.5 < np.linalg.norm(scaled.A.toarray(), 2) <= 1 + 1e-12
    z = rng.standard_normal((system.size, k))
    x = np.einsum('nij,nj->ni', inverse, z).ravel()
    assert_allclose(scaled.A @ z.ravel(), system.A @ x, atol=1e-9)


@pytest.mark.parametrize('iterations', [1, 2, 7, 40])
@SIZES
def test_it_takes_the_steps_of_the_page_from_the_dual_that_is_given(k, iterations, rng):
    """In single precision; what it returns is one half step further."""
    system, weight = chain_with_loops(k, rng), 0.4
    scaled, inverse = scaled_system(system)
    start, (x, _) = rng.uniform(-1, 1, len(system.b)), zeros(system)
    y = start.copy()
    found = solve(system, (x, y), iterations, weight=weight)
    assert (found.status, found.iterations) == ('iteration_limit', iterations)
    assert_array_equal(y, start)
    for iteration in range(iterations):
        x, y = halpern_step(scaled.A, system.b, x, y, start, weight, iteration)
    d = scaled.A.T @ y / weight
    expected = (inverse @ (x - d).reshape(-1, k, 1)).ravel()
    assert_allclose(found.x, expected, atol=2e-4 * np.abs(expected).max())
    assert_allclose(found.y, np.clip(y + weight * (scaled.A @ (x - 2 * d) - system.b), -1, 1),
                    atol=2e-4)
    assert found.objective == pytest.approx(l1_cost(system.A @ found.x - system.b))


@SIZES
def test_it_agrees_with_highs(k, rng):
    for _ in range(3):
        system = chain_with_loops(k, rng)
        found = solve(system, zeros(system), 200_000, 1e-4)
        best, _ = linprog_l1(system.A, system.b)
        assert found.status == 'converged' and np.abs(found.y).max() <= 1
        assert (1 - 1e-9) * best <= found.objective <= (1 + 1e-4) * best
        again = solve(system, (found.x, found.y), 200_000, 1e-4)
        assert again.iterations < found.iterations / 2


@pytest.mark.parametrize('offset', [0.0, 1e4])
def test_single_precision_is_refined(offset, rng):
    """A start far away: in single precision alone A x would lose what b holds."""
    system = chain_with_loops(3, rng)
    x, y = zeros(system)
    moved = LinearSystem(system.keyframe, system.blocks,
                         system.b + system.A @ np.full(len(x), offset), system.size)
    found = solve(moved, (x + offset, y), 100_000, 1e-5)
    best, _ = linprog_l1(system.A, system.b)
    assert (found.status, found.objective) == ('converged', pytest.approx(best, rel=2e-5))


@pytest.mark.parametrize('k', [1, 3])
def test_the_gap_bounds_the_error_within_its_box(k, rng):
    """Early and late, against HiGHS inside the box that the docstring names."""
    system = chain_with_loops(k, rng)
    scaled, inverse = scaled_system(system)
    for iterations in (40, 400, 4000):
        found = solve(system, zeros(system), iterations)
        z = np.linalg.solve(inverse, found.x.reshape(-1, k, 1)).ravel()
        best, _ = linprog_l1(scaled.A, scaled.b, np.abs(z) + 1 / found.weight)
        assert found.objective - found.gap <= best * (1 + 1e-5)


@pytest.mark.parametrize('left', [0.0, 0.05])
def test_a_deadline_is_kept(left, rng):
    system, start = chain_with_loops(3, rng), time.monotonic()
    found = solve(system, zeros(system), 10**7, deadline=start + left)
    assert found.status == 'out_of_time' and found.iterations > 0
    assert left <= time.monotonic() - start < 1


def test_systems_without_factors_without_keyframes_or_with_a_lonely_one(rng):
    empty = LinearSystem(np.zeros((0, 2), np.int64), np.zeros((0, 2, 3, 3)), np.zeros(0), 4)
    found = solve(empty, (np.ones(12), np.zeros(0)), 100, 1e-3)
    assert (found.status, found.objective) == ('converged', 0)
    assert_array_equal(found.x, 1)
    fixed = LinearSystem(np.zeros((1, 2), np.int64), np.zeros((1, 2, 3, 3)), np.ones(3), 0)
    found = solve(fixed, zeros(fixed), 100, 1e-3)
    assert (found.objective, found.gap) == (3, 0)
    system = chain_with_loops(3, rng)
    lonely = LinearSystem(np.where(system.keyframe == 12, 13, system.keyframe), system.blocks,
                          system.b, 13)
    found = solve(lonely, zeros(lonely), 400)
    assert_array_equal(found.x[-3:], 0)
    assert np.isfinite(found.x).all()
