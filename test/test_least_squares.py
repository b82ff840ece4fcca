# SPDX-License-Identifier: Apache-2.0
"""Weighted least squares against dense NumPy, and the start it gives to L1 against HiGHS."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import HAND_SOLVED, consistent, linprog_l1, noisy_graph, random_system
from scipy.sparse import csr_array

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.least_squares import (
    reweighted_start,
    reweighted_step,
    smoothing,
    weighted_least_squares,
)
from l1slam_ros.core.linearise import linearise
from l1slam_ros.core.optimality import duality_gap, l1_cost


@pytest.mark.parametrize('weighted', [False, True])
@pytest.mark.parametrize('damping', [0.0, 0.3])
@pytest.mark.parametrize('kind', ['dense', 'sparse', 'scaled rows'])
def test_it_is_the_least_squares_solution(kind, weighted, damping, rng):
    A, b = random_system(kind, rng)
    weights = rng.uniform(0.1, 5, len(b)) if weighted else None
    x = weighted_least_squares(A, b, weights, damping)
    root = np.sqrt(weights) if weighted else np.ones(len(b))
    dense = root[:, None] * A.toarray()
    marquardt = np.diag(np.sqrt(damping * (dense**2).sum(axis=0)))
    expected = np.linalg.lstsq(np.concatenate((dense, marquardt)),
                               np.concatenate((root * b, np.zeros(A.shape[1]))), rcond=None)[0]
    assert_allclose(x, expected, rtol=1e-7, atol=1e-9)


def test_a_step_by_hand():
    """
    Minimise |x| + |x - 1| + |x - 5| from the mean, x = 2.

    Residuals (2, 1, -3), weights (1/2, 1, 1/3): the weighted mean is 16/11 and the dual
    (8/11, 5/11, -13/11), of which the last is clipped.
    """
    A, b = csr_array(np.ones((3, 1))), np.array([0.0, 1.0, 5.0])
    assert_allclose(weighted_least_squares(A, b), [2.0])
    x, y = reweighted_step(A, b, A @ [2.0] - b, mu=0.0)
    assert_allclose(x, [16 / 11])
    assert_allclose(y, [8 / 11, 5 / 11, -1.0])


def test_a_part_that_is_not_tied_to_the_anchor_is_named():
    A = csr_array(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, -1.0]]))
    with pytest.raises(GraphError, match='not tied to the anchor'):
        weighted_least_squares(A, np.ones(3))


def test_smoothing_is_the_mean_and_never_zero():
    assert smoothing(np.array([1.0, -3.0])) == 2.0
    mu = smoothing(np.zeros(5))
    assert mu > 0 and np.isfinite(1 / (mu / 1024) ** 2)


@pytest.mark.parametrize('kind', ['dense', 'sparse', 'scaled rows'])
def test_the_start_is_within_two_percent_of_the_optimum(kind, rng):
    for _ in range(10):
        A, b = random_system(kind, rng)
        x, y = reweighted_start(A, b)
        best, _ = linprog_l1(A, b)
        assert l1_cost(A @ x - b) <= 1.02 * best
        assert np.abs(y).max() <= 1
        assert duality_gap(A, b, x, y, np.abs(x)) <= 0.05 * best


def test_the_start_is_near_the_optimum_of_a_pose_graph(rng):
    graph, truth = noisy_graph(30, 30, rng)
    system = linearise(graph, truth)
    x, y = reweighted_start(system.A, system.b)
    best, _ = linprog_l1(system.A, system.b)
    assert l1_cost(system.A @ x - system.b) <= 1.01 * best
    assert duality_gap(system.A, system.b, x, y, np.abs(x)) <= 0.05 * best


@pytest.mark.parametrize('make', HAND_SOLVED[:-1], ids=lambda make: make.__name__)
def test_the_start_of_hand_solved_problems(make):
    problem = make()
    x, y = reweighted_start(problem.A, problem.b)
    assert l1_cost(problem.A @ x - problem.b) <= 1.05 * problem.optimum
    assert np.abs(y).max() <= 1


def test_the_start_of_a_problem_that_fits_exactly():
    problem = consistent()
    x, y = reweighted_start(problem.A, problem.b)
    assert_allclose(x, problem.x, atol=1e-9)
    assert np.abs(y).max() <= 1
