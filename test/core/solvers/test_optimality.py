# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Objectives and the duality gap, held against hand-solved problems and HiGHS."""

import numpy as np
import pytest
from problems import HAND_SOLVED, RANDOM_SYSTEMS, linprog_l1, random_system

from l1slam_ros.core.solvers.optimality import (
    SENTENCES,
    Status,
    duality_gap,
    l1_cost,
    l2_cost,
    smoothing,
)


def test_costs_by_hand():
    residual = np.array([3.0, -4.0, 0.0])
    assert l1_cost(residual) == 7.0
    assert l2_cost(residual) == 25.0
    assert l1_cost(np.zeros(0)) == l2_cost(np.zeros(0)) == 0.0


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
        best, _ = linprog_l1(A, b, box)
        above = l1_cost(A @ x - b) - best
        assert duality_gap(A, b, x, y, box) >= above - 1e-9


def test_every_status_has_its_sentence():
    assert set(SENTENCES) == set(Status)
    assert {status.value for status in Status} >= {'converged', 'iteration_limit', 'stalled'}


def test_smoothing_is_the_mean_and_never_zero():
    assert smoothing(np.array([1.0, -3.0])) == 2.0
    for rows in (0, 5):
        mu = smoothing(np.zeros(rows))
        assert mu > 0 and np.isfinite(1 / (mu / 1024) ** 2)
