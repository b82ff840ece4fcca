# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The interior-point method: linear problems against HiGHS, graphs near their map, its account."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import chain_and_loops, drive, graph_of, linprog_l1, noisy_graph
from systems import SHAPES, cholesky_of_system, random_system

from l1slam_ros.core.graph.l1_problem import GraphProblem, LinearProblem
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.kernels import interior_point as kernels
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.exact import prove
from l1slam_ros.core.solvers.interior_point import _Direction, _Iterate, interior_point
from l1slam_ros.core.solvers.optimality import Status, l1_cost

TOLERANCE = 1e-8


@dataclass
class Proved:
    """What a run ended with, and the proof of it."""

    poses: np.ndarray
    costs: list
    y: np.ndarray
    gap: float
    status: Status


def proved(problem, poses, cholesky, *limits):
    optimum = interior_point(problem, poses, cholesky, *limits)
    return Proved(optimum.poses, optimum.costs, *prove(optimum, cholesky))


def solve_linear(system, x, iterations=60, tolerance=TOLERANCE):
    return proved(LinearProblem(system), x, cholesky_of_system(system), iterations, tolerance)


def solve_graph(graph, poses, iterations=100, tolerance=TOLERANCE):
    return proved(GraphProblem(graph), poses, cholesky_of(graph), iterations, tolerance)


def cost_of(graph, poses):
    return l1_cost(whitened_residual(graph, poses))


@pytest.fixture
def world(rng):
    return noisy_graph(60, 50, rng)


# Linear problems


@pytest.mark.parametrize('k', [1, 2, 3])
@pytest.mark.parametrize('shape', SHAPES, ids=lambda shape: shape.__name__)
@pytest.mark.parametrize('scale', [0.0, 1.5])
def test_linear_problems_are_solved_as_by_highs(shape, k, scale, rng):
    # Twice each pair, or a chain has as many rows as columns and fits exactly.
    system = random_system(2 * shape(12), 12, k, rng, scale)
    optimum = solve_linear(system, np.zeros(12 * k))
    best, _ = linprog_l1(system.A, system.b)
    assert optimum.status is Status.CONVERGED
    assert l1_cost(system.A @ optimum.poses - system.b) == pytest.approx(best, rel=1e-7)


@pytest.mark.parametrize('iterations', [0, 1, 3, 60])
def test_the_dual_is_feasible_and_the_gap_bounds_the_error(iterations, rng):
    for shape in SHAPES:
        system = random_system(2 * shape(12), 12, 2, rng)
        optimum = solve_linear(system, np.zeros(24), iterations)
        assert np.abs(optimum.y).max() <= 1
        assert_allclose(system.A.T @ optimum.y, 0, atol=1e-9 * np.abs(system.blocks).max())
        best, _ = linprog_l1(system.A, system.b)
        assert optimum.costs[-1] - optimum.gap <= best * (1 + 1e-9)
        assert optimum.gap <= (1e-6 if iterations == 60 else 1) * optimum.costs[-1]


def test_a_start_far_away_is_no_trouble_to_a_linear_problem(rng):
    system = random_system(2 * SHAPES[0](12), 12, 3, rng)
    optimum = solve_linear(system, 1e6 * rng.standard_normal(36))
    assert optimum.costs[-1] == pytest.approx(linprog_l1(system.A, system.b)[0], rel=1e-6)


# Graphs


def test_converged_means_that_little_is_left(world):
    """A hundred times as loose, a hundred times as far from the best, but for luck."""
    graph, truth = world
    best = solve_graph(graph, truth, tolerance=1e-10).costs[-1]
    for tolerance in (1e-2, 1e-4, 1e-6):
        optimum = solve_graph(graph, truth, tolerance=tolerance)
        assert optimum.status is Status.CONVERGED
        assert 0 <= optimum.costs[-1] / best - 1 <= tolerance + 1e-10


@pytest.mark.parametrize('iterations', [0, 60])
def test_an_exact_start_is_the_end(iterations, rng):
    truth = drive(20, rng)
    graph = graph_of(truth, chain_and_loops(20, 10, rng))
    optimum = solve_graph(graph, truth, iterations)
    assert optimum.status is Status.CONVERGED and len(optimum.costs) == 1
    assert_array_equal(optimum.poses, truth)
    assert optimum.gap <= optimum.costs[0]


def test_where_there_is_no_direction_it_stalls_at_its_start(world):
    """A pose that is not finite: nothing can be factored."""
    graph, truth = world
    truth[7, 0] = np.nan
    optimum = solve_graph(graph, truth)
    assert optimum.status is Status.STALLED and optimum.poses is truth
    assert len(optimum.costs) == 1


# The compiled row-wise work


@pytest.fixture
def rows(rng):
    """Return e, (u, v, s, t), y, q, c1, c2 of a point inside its bounds."""
    e, c1, c2 = rng.standard_normal((3, 50))
    u, v = rng.uniform(0.1, 2, (2, 50))
    y = rng.uniform(-0.9, 0.9, 50)
    s, t = 1 - y, 1 + y
    return e, (u, v, s, t), y, 1 / (u / s + v / t), c1, c2


@pytest.mark.parametrize('size', [1e-3, 1.0, 1e12])
def test_a_run_begins_on_the_central_path(size, rng):
    e = np.append(size * rng.standard_normal(50), 0.0)
    u, v, s, t, y = kernels.begin(e, 0.3)
    assert_allclose(u - v, e, atol=1e-15)
    assert_allclose((u * s, v * t), np.full((2, 51), 0.3))
    assert_allclose((s, t), (1 - y, 1 + y), atol=1e-15)
    assert min(u.min(), v.min(), s.min(), t.min()) > 0


def test_the_step_solves_the_newton_equations(rows, rng):
    """u s = c1 and v t = c2 to first order, e + J dx = u - v, and bounds met as said."""
    e, (u, v, s, t), y, q, c1, c2 = rows
    moved = rng.standard_normal(50)
    g = e - (u - v) - (c1 / s - u) + (c2 / t - v)
    state = (u, v, s, t, q, e, y)
    assert_allclose(kernels.aim(*state, c1, c2), -(y + q * g))
    dy, primal, dual, _ = kernels.complete(*state, c1, c2, moved, 1.0)
    assert_allclose(dy, q * (moved + g))
    du, dv = (c1 + u * dy) / s - u, (c2 - v * dy) / t - v
    assert_allclose(u * s + s * du - u * dy, c1)
    assert_allclose(v * t + t * dv + v * dy, c2)
    assert_allclose((u + du) - (v + dv), e + moved, atol=1e-12)
    # At these lengths the first bound is met, and none is passed.
    assert primal < 1 and dual < 1
    assert min((u + primal * du).min(), (v + primal * dv).min()) == pytest.approx(0, abs=1e-12)
    assert min((s - dual * dy).min(), (t + dual * dy).min()) == pytest.approx(0, abs=1e-12)
    _, part_primal, part_dual, gap = kernels.complete(*state, c1, c2, moved, 0.9)
    primal, dual = 0.9 * primal, 0.9 * dual
    assert (part_primal, part_dual) == pytest.approx((primal, dual))
    assert gap == pytest.approx((u + primal * du) @ (s - dual * dy)
                                + (v + primal * dv) @ (t + dual * dy))
    # Small steps meet no bound: they are taken whole.
    fits = (u, v, s, t, q, u - v + 1e-3 * g, y)
    assert kernels.complete(*fits, u * s, v * t, 1e-3 * moved, 0.9)[1:3] == (1, 1)


def test_a_step_is_taken_and_slacks_stay_positive(rows):
    _, (u, v, s, t), y, *_ = rows
    dy = np.where(y > 0, 9.0, -9.0)
    # What u and v move by: themselves.
    products = 2 * u * s - u * dy, 2 * v * t + v * dy
    at = _Iterate(np.zeros(0), None, *(x.copy() for x in (u, v, s, t, y)))
    at.advance(_Direction(np.zeros(0), np.zeros(50), dy, products, 1.0, 0.2, 0.0), 0.3)
    assert_allclose((at.u, at.v, at.y), (1.3 * u, 1.3 * v, y + 0.2 * dy))
    assert (s - 0.2 * dy < 0).any() and (t + 0.2 * dy < 0).any()
    assert (np.minimum(at.s, at.t) > 0).all()
