# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Algorithms 1 and 2 against closed forms, hand-solved LPs, HiGHS and bounded least squares."""

from itertools import islice

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import HAND_SOLVED, RANDOM_SYSTEMS, linprog_l1, random_system
from scipy.sparse import csr_array

from l1slam_ros.core.solvers.optimality import duality_gap, l1_cost
from l1slam_ros.core.solvers.primal_dual import (
    PrimalDualOptions,
    diagonal_step_sizes,
    minimise_l1,
    primal_dual,
    primal_weight,
)

LONG = PrimalDualOptions(iterations=8000, tolerance=1e-5)


def nth(iterates, n):
    return next(islice(iterates, n - 1, None))


def zeros(A):
    return np.zeros(A.shape[1]), np.zeros(A.shape[0])


# Algorithm 1


@pytest.mark.parametrize('theta', [0.0, 0.5, 1.0])
def test_algorithm_1_takes_the_steps_of_the_paper(theta, rng):
    """Three iterations written out, with resolvents that are no identities."""
    K = csr_array(rng.standard_normal((4, 3)))
    tau, sigma = rng.uniform(0.1, 0.5, 3), rng.uniform(0.1, 0.5, 4)
    x, y = rng.standard_normal(3), rng.standard_normal(4)
    iterates = primal_dual(K, np.tanh, lambda v: v / 2, x, y, tau, sigma, theta)
    x_bar = x
    for _ in range(3):
        y = np.tanh(y + sigma * (K @ x_bar))
        x_new = (x - tau * (K.T @ y)) / 2
        x, x_bar = x_new, x_new + theta * (x_new - x)
        found_x, found_y = next(iterates)
        assert_allclose(found_x, x)
        assert_allclose(found_y, y)


@pytest.mark.parametrize('kind', RANDOM_SYSTEMS)
def test_algorithm_1_stays_in_a_box_and_finds_its_best(kind, rng):
    """F = |. - b|_1 and G the indicator of |x_j| <= .1, against HiGHS."""
    A, b = random_system(kind, rng)
    tau, sigma = diagonal_step_sizes(A)
    x, _ = nth(primal_dual(A, lambda v: np.clip(v - sigma * b, -1, 1),
                           lambda v: np.clip(v, -0.1, 0.1), *zeros(A), tau, sigma), 4000)
    best, _ = linprog_l1(A, b, 0.1)
    assert np.abs(x).max() <= 0.1
    assert l1_cost(A @ x - b) == pytest.approx(best, rel=1e-3)
    assert best > 1.01 * linprog_l1(A, b)[0]


# Step sizes


def test_step_sizes_are_the_inverse_column_and_row_sums():
    A = csr_array(np.array([[1.0, -2.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.0]]))
    tau, sigma = diagonal_step_sizes(A)
    assert_array_equal(tau, [1.0, 0.4, 0.0])
    assert_array_equal(sigma, [1 / 3, 2.0, 1 / np.finfo(float).eps])


def test_the_primal_weight_by_hand():
    """At x = (1, -1): residuals 6, -8, -5, over the largest entries 2, 4, none: 3, 2, 0."""
    A = csr_array(np.array([[2.0, 1.0], [0.0, -4.0], [0.0, 0.0]]))
    weight = primal_weight(A, np.array([-5.0, 12.0, 5.0]), np.array([1.0, -1.0]))
    assert weight == pytest.approx(1 / ((3 + 2 + 0) / 3))
    assert np.isfinite(primal_weight(csr_array(np.eye(2)), np.ones(2), np.ones(2)))


# What is minimised, and the proof


@pytest.mark.parametrize('make', HAND_SOLVED, ids=lambda make: make.__name__)
def test_the_gap_is_zero_at_the_optimum_and_only_there(make):
    problem = make()
    box = np.full(len(problem.x), 100.0)
    gap = duality_gap(problem.A, problem.b, problem.x, problem.y, box)
    assert gap == pytest.approx(0, abs=1e-12)
    assert l1_cost(problem.A @ problem.x - problem.b) == pytest.approx(problem.optimum)
    for x in problem.x + 0.1, problem.x - 0.1:
        assert duality_gap(problem.A, problem.b, x, problem.y, box) > 1e-3


@pytest.mark.parametrize('kind', RANDOM_SYSTEMS)
def test_the_gap_bounds_the_distance_to_the_best_in_the_box(kind, rng):
    """For any x and any y in the unit box, feasible or not."""
    for _ in range(10):
        A, b = random_system(kind, rng)
        x, y = rng.standard_normal(A.shape[1]), rng.uniform(-1, 1, len(b))
        box = rng.uniform(0, 3, len(x))
        above = l1_cost(A @ x - b) - linprog_l1(A, b, box)[0]
        assert duality_gap(A, b, x, y, box) >= above - 1e-9


# Algorithm 2


@pytest.mark.parametrize('make', HAND_SOLVED, ids=lambda make: make.__name__)
def test_algorithm_2_solves_what_was_solved_by_hand(make):
    problem = make()
    solution = minimise_l1(problem.A, problem.b, *zeros(problem.A), LONG)
    assert_allclose(solution.x, problem.x, atol=2e-4)
    assert solution.objective == pytest.approx(problem.optimum, rel=1e-4, abs=1e-6)
    assert np.abs(solution.y).max() <= 1
    if problem.optimum:
        assert_allclose(problem.A.T @ solution.y, 0, atol=1e-3)
        assert -problem.b @ solution.y == pytest.approx(problem.optimum, rel=1e-3)


@pytest.mark.parametrize('kind, within', [
    ('dense', 1e-3), ('sparse', 1e-3), ('empty row and column', 1e-3), ('scaled rows', 1e-2)])
def test_algorithm_2_agrees_with_highs(kind, within, rng):
    for _ in range(3):
        A, b = random_system(kind, rng)
        solution = minimise_l1(A, b, *zeros(A), LONG)
        best, _ = linprog_l1(A, b)
        assert (1 - 1e-9) * best <= solution.objective <= (1 + within) * best
        assert solution.objective == l1_cost(A @ solution.x - b)


@pytest.mark.parametrize('kind', RANDOM_SYSTEMS)
def test_converged_means_that_the_gap_is_below_the_tolerance(kind, rng):
    """The gap is for steps as long as x; an empty row does not keep it open."""
    A, b = random_system(kind, rng)
    solution = minimise_l1(A, b, *zeros(A), PrimalDualOptions(100_000, 1e-2))
    assert solution.status == 'converged' and solution.iterations < 100_000
    assert solution.gap == duality_gap(A, b, solution.x, solution.y, np.abs(solution.x))
    assert solution.gap <= 1e-2 * solution.objective
    early = minimise_l1(A, b, *zeros(A), PrimalDualOptions(41, 0.0))
    assert early.status == 'iteration_limit' and early.iterations == 41
