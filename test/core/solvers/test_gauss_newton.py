# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton and Huber against SciPy, closed forms and each other."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import drive, graph_of, noisy_graph
from scipy.optimize import least_squares

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import linearise, step_poses, whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import (
    LeastSquaresOptions,
    gauss_newton,
    l2_map,
    minimise_l2,
)
from l1slam_ros.core.solvers.optimality import Huber, Status, l2_cost
from l1slam_ros.core.solvers.reweighting import weighted_least_squares

DEFAULTS = LeastSquaresOptions()


def minimise_huber(graph, poses, options, cholesky):
    norm = Huber(graph.manifold.TANGENT_SIZE, options.huber_delta)
    return gauss_newton(graph, poses, norm, options, cholesky)


BOTH = pytest.mark.parametrize('minimise', [minimise_l2, minimise_huber])


@pytest.fixture
def world(rng):
    return noisy_graph(25, 20, rng)


def solve(minimise, graph, start, options=DEFAULTS):
    return minimise(graph, start, options, cholesky_of(graph))


def chi2(graph, poses):
    return l2_cost(whitened_residual(graph, poses))


def test_l2_agrees_with_scipy(world):
    graph, truth = world
    solution = solve(minimise_l2, graph, odometry_poses(graph))

    def residual(x):
        return whitened_residual(graph, step_poses(graph, truth, x))

    expected = least_squares(residual, np.zeros(3 * (len(truth) - 1)), xtol=1e-12, ftol=1e-12,
                             gtol=1e-12)
    assert solution.status is Status.CONVERGED
    assert solution.cost == pytest.approx(2 * expected.cost, rel=1e-8)
    assert_allclose(se2.local(solution.poses, step_poses(graph, truth, expected.x)), 0, atol=1e-4)


def test_huber_cost_by_hand():
    """Lengths 5 (beyond 2: 2 2 5 - 2^2 = 16), 1 (1^2) and 2 (2^2, either way)."""
    residual = np.array([3.0, 4.0, 0.0, 0.6, 0.0, -0.8, 0.0, 2.0, 0.0])
    assert Huber(3, 2.0).cost(residual) == pytest.approx(16 + 1 + 4)
    assert Huber(3, 1e9).cost(residual) == pytest.approx(l2_cost(residual))
    assert Huber(3, 1.0).cost(np.zeros(0)) == 0.0


@pytest.fixture
def exact(rng):
    """A graph that its poses fit to rounding, and a start nearby."""
    truth = drive(20, rng)
    graph = graph_of(truth, [(k, k + 1) for k in range(19)] + [(0, 10), (5, 19)])
    return graph, truth, step_poses(graph, truth, 0.05 * rng.standard_normal(57))


@BOTH
def test_a_graph_without_noise_is_solved_exactly(minimise, exact):
    graph, truth, start = exact
    solution = solve(minimise, graph, start)
    assert solution.cost < 1e-20
    assert solution.status in (Status.CONVERGED, Status.STALLED)
    assert_allclose(se2.local(solution.poses, truth), 0, atol=1e-10)


def after_a_plain_step(graph, poses):
    system = linearise(graph, poses)
    step = weighted_least_squares(system, cholesky_of(graph), np.ones_like(system.b))
    return step_poses(graph, poses, step)


@BOTH
@pytest.mark.parametrize('seed', [0, 1, 3, 4])
def test_where_a_plain_step_fails_another_one_is_found(minimise, seed):
    """From poses anywhere Gauss-Newton leaps too far: it is shortened, bent or damped."""
    rng = np.random.default_rng(seed)
    graph, truth = noisy_graph(25, 20, rng)
    start = np.concatenate((truth[:1], 3 * rng.standard_normal((24, 3))))
    solution = solve(minimise, graph, start, LeastSquaresOptions(iterations=1000))
    assert (np.diff(solution.history) <= 0).all()
    assert solution.cost < 0.1 * solution.history[0]
    assert solution.status in (Status.CONVERGED, Status.STALLED)


@pytest.mark.parametrize('turn', [0.5, -1.5])
def test_a_long_chain_that_a_loop_bends_takes_few_steps(turn):
    """Its keyframes go along the tangent of their arc, which tears them apart."""
    n = 300
    step, heading = np.array([[1.0, 0.0, 0.0]]), turn * np.arange(n) / n
    straight = np.arange(n)[:, None] * step
    arc = np.column_stack((np.cumsum(np.cos(heading)), np.cumsum(np.sin(heading)), heading))
    graph = FactorGraph(se2)
    graph.add_poses(n)
    for k in range(n - 1):
        graph.add_between(k, k + 1, step, np.diag((1e6, 1e6, 1e4))[None])
    graph.add_between(0, n - 1, se2.between(arc[:1], arc[-1:]), np.eye(3)[None])
    solution = solve(minimise_l2, graph, straight)
    assert chi2(graph, after_a_plain_step(graph, straight)) > chi2(graph, straight)
    assert solution.status is Status.CONVERGED and solution.outer_iterations <= 8
    assert (np.diff(solution.history) <= 0).all()


@BOTH
def test_the_dual_begins_anew_and_there_is_no_gap(minimise, world):
    graph, truth = world
    solution = solve(minimise, graph, truth)
    rows = len(graph.between) * graph.manifold.TANGENT_SIZE
    assert solution.dual.shape == (rows,) and not solution.dual.any() and np.isinf(solution.gap)
    assert solution.inner_iterations == 0


@BOTH
def test_a_loose_keyframe_is_refused(minimise):
    graph = FactorGraph(se2)
    graph.add_poses(3)
    graph.add_between(0, 1, np.ones((1, 3)), np.eye(3)[None])
    with pytest.raises(GraphError, match='not tied to the anchor'):
        solve(minimise, graph, np.zeros((3, 3)))


def test_a_step_that_does_what_it_promised_ends_the_map_within_its_noise(world):
    graph, truth = world
    steps = []
    best = solve(minimise_l2, graph, truth)
    for start in (truth, best.poses):
        poses = l2_map(graph, start, cholesky_of(graph), lambda k, cost: steps.append(k))
        assert chi2(graph, poses) < best.cost + 1
    assert steps == [1, 1] and best.outer_iterations > 2


def test_no_step_is_spent_on_finding_out_that_little_is_left(world):
    graph, _ = world
    start = odometry_poses(graph)
    to_the_end = solve(minimise_l2, graph, start, LeastSquaresOptions(tolerance=1e-3))
    surprise = 1e-3
    sooner = solve(minimise_l2, graph, start,
                   LeastSquaresOptions(tolerance=1e-3, surprise=surprise))
    assert sooner.status is Status.CONVERGED
    assert sooner.outer_iterations == to_the_end.outer_iterations - 1
    assert sooner.cost <= (1 + surprise) * to_the_end.cost
