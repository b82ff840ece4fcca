# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Weighted least squares against dense NumPy, and the start it gives to L1 against HiGHS."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import consistent, linprog_l1, median
from scipy.sparse import csr_array
from systems import cholesky_of_system, grid, random_loops, random_system, system_of

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.solvers.optimality import duality_gap, l1_cost
from l1slam_ros.core.solvers.reweighting import (
    reweighted_start,
    reweighted_step,
    warm_step,
    weighted_least_squares,
)

KINDS = {
    'dense': lambda rng: random_system([(0, 2), (1, 0)] * 3 + [(2, 1)], 2, 3, rng),
    'sparse': lambda rng: random_system(grid(10) + random_loops(10), 10, 2, rng),
    'scaled rows': lambda rng: random_system(grid(10) + random_loops(10), 10, 2, rng, scale=1.5),
}


@pytest.mark.parametrize('weighted', [False, True])
@pytest.mark.parametrize('damping', [0.0, 0.3])
@pytest.mark.parametrize('kind', KINDS)
def test_it_is_the_least_squares_solution(kind, weighted, damping, rng):
    system = KINDS[kind](rng)
    weights = rng.uniform(0.1, 5, len(system.b)) if weighted else np.ones_like(system.b)
    x = weighted_least_squares(system, cholesky_of_system(system), weights, damping)
    root = np.sqrt(weights)
    dense = root[:, None] * system.A.toarray()
    marquardt = np.diag(np.sqrt(damping * (dense**2).sum(axis=0)))
    expected = np.linalg.lstsq(np.concatenate((dense, marquardt)),
                               np.concatenate((root * system.b, np.zeros(dense.shape[1]))),
                               rcond=None)[0]
    assert_allclose(x, expected, rtol=1e-7, atol=1e-9)


def test_a_step_by_hand():
    """
    Minimise |x| + |x - 1| + |x - 5| from the mean, x = 2.

    Residuals (2, 1, -3), weights (1/2, 1, 1/3): the weighted mean is 16/11 and the dual
    (8/11, 5/11, -13/11), of which the last is clipped.
    """
    system = system_of(median().A, median().b)
    cholesky = cholesky_of_system(system)
    assert_allclose(weighted_least_squares(system, cholesky, np.ones(3)), [2.0])
    x, y = reweighted_step(system, cholesky, system.times(np.array([2.0])) - system.b, mu=0.0)
    assert_allclose(x, [16 / 11])
    assert_allclose(y, [8 / 11, 5 / 11, -1.0])


def test_a_warm_step_by_hand():
    """
    The same, x = 2 being the origin, from the dual (1, 0, -1) that keeps what is off a corner.

    Of the weights (1/2, 1, 1/3) the first and last count 3/10: (.15, 1, .1). The signs of the
    residuals add up to 1, so the step is -1 / 1.25. It ends at 1.2, and the optimum is 1, where
    weights alone end at 16/11. Without a dual it is theirs.
    """
    system = system_of(median().A, median().b - 2 * median().A.toarray()[:, 0])
    cholesky = cholesky_of_system(system)
    assert_allclose(warm_step(system, cholesky, np.array([1.0, 0.0, -1.0]), 0.0), [-0.8])
    assert_allclose(warm_step(system, cholesky, np.zeros(3), 0.0), [16 / 11 - 2])


@pytest.mark.parametrize('kind', KINDS)
def test_the_start_is_within_two_percent_of_the_optimum(kind, rng):
    for _ in range(10):
        system = KINDS[kind](rng)
        x, y = reweighted_start(system, cholesky_of_system(system))
        best, _ = linprog_l1(system.A, system.b)
        assert l1_cost(system.A @ x - system.b) <= 1.02 * best
        assert np.abs(y).max() <= 1
        assert duality_gap(system.A, system.b, x, y, np.abs(x)) <= 0.05 * best
    problem = consistent()
    system = system_of(problem.A, problem.b)
    assert_allclose(reweighted_start(system, cholesky_of_system(system))[0], problem.x, atol=1e-9)


def test_weights_are_sharpened_no_further_than_double_precision_bears():
    """Two keyframes stiffly joined, that two weak factors which contradict each other tie."""
    A = csr_array(np.array([[1e-6, 0.0], [1e-6, 0.0], [1.0, -1.0], [1.0, -1.0]]))
    system = system_of(A, np.array([1.0, -1.0, 0.0, 0.0]))
    cholesky = cholesky_of_system(system)
    with pytest.raises(GraphError, match='beyond double precision'):
        reweighted_step(system, cholesky, -system.b, mu=1e-3)
    x, y = reweighted_start(system, cholesky)
    assert l1_cost(A @ x - system.b) == pytest.approx(2.0)
    assert np.abs(y).max() <= 1
