# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Algorithm 4: it descends, ends at a point that HiGHS cannot improve, and says how it ended."""

import time

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import chain_and_loops, drive, graph_of, linprog_l1, noisy_graph

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import linearise, step_poses, whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, backtrack, is_far, minimise
from l1slam_ros.core.solvers.optimality import Status, duality_gap, l1_cost
from l1slam_ros.core.solvers.primal_dual import PrimalDualOptions
from l1slam_ros.core.solvers.seed import seed_poses

DEFAULTS = OptimiserOptions()


def cost(graph, poses):
    return l1_cost(whitened_residual(graph, poses))


def seed_of(graph):
    return seed_poses(graph, cholesky_of(graph))


def solve(graph, start, options, **more):
    return minimise(graph, start, options, cholesky_of(graph), **more)


def parallel(*distances):
    """Return two keyframes and a factor of unit noise for each distance between them."""
    graph = FactorGraph(se2)
    graph.add_poses(2)
    m = len(distances)
    measurement = np.array([(x, 0.0, 0.0) for x in distances])
    graph.add_between(np.zeros(m, int), np.ones(m, int), measurement,
                      np.broadcast_to(np.eye(3), (m, 3, 3)))
    return graph


@pytest.fixture
def world(rng):
    return noisy_graph(60, 50, rng)


@pytest.mark.parametrize('start_of', [seed_of, odometry_poses, None],
                         ids=['seed', 'odometry', 'truth'])
def test_no_small_step_is_better_by_highs(start_of, world):
    graph, truth = world
    start = truth if start_of is None else start_of(graph)
    solution = solve(graph, start, DEFAULTS)
    system = linearise(graph, solution.poses)
    best, _ = linprog_l1(system.A, system.b, box=0.02)
    assert solution.cost == cost(graph, solution.poses) == l1_cost(system.b)
    assert best >= (1 - 1e-3) * solution.cost
    assert solution.cost < cost(graph, truth)


def test_without_a_factorisation_it_ends_there_too(world):
    """Of a graph that fills in; the linear problems then begin where the last one ended."""
    graph, truth = world
    best = solve(graph, truth, DEFAULTS).cost
    for start in seed_poses(graph, None), odometry_poses(graph), truth:
        assert minimise(graph, start, DEFAULTS).cost == pytest.approx(best, rel=2e-3)


# How it ends


def test_it_converges(world):
    graph, truth = world
    options = OptimiserOptions(outer_iterations=1000)
    solution = solve(graph, truth, options)
    assert solution.status is Status.CONVERGED
    assert solution.outer_iterations < 1000
    small = -np.diff(solution.history) <= options.outer_tolerance * solution.history[1:]
    assert small[-2:].all() and not (small[:-2] & small[1:-1]).any()


def test_where_nothing_is_better_it_has_converged():
    """At the median to the last bit no step lowers the cost, and the dual proves it."""
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    solution = solve(parallel(0.0, 1.0, 5.0), poses, DEFAULTS)
    assert solution.status is Status.CONVERGED
    assert solution.cost == 5.0
    assert_array_equal(solution.poses, poses)


def test_a_deadline_that_has_passed_leaves_one_linearisation(world):
    graph, _ = world
    start = odometry_poses(graph)
    solution = solve(graph, start, DEFAULTS, deadline=time.monotonic())
    assert solution.status is Status.OUT_OF_TIME
    assert solution.outer_iterations == 1
    assert solution.cost < cost(graph, start)


def test_a_graph_that_fits_to_rounding_is_solved(rng):
    truth = drive(30, rng)
    graph = graph_of(truth, chain_and_loops(30, 20, rng))
    solution = solve(graph, se2.retract(truth, 1e-9 * rng.standard_normal((30, 3))), DEFAULTS)
    assert_allclose(se2.between(solution.poses[:1], solution.poses), se2.between(truth[:1], truth),
                    atol=1e-8)


def test_chains_without_loops_are_solved_from_anywhere():
    for seed in range(300):
        rng = np.random.default_rng(seed)
        truth = drive(2, rng)
        solution = solve(graph_of(truth, [(0, 1)]), se2.identity(2), DEFAULTS)
        assert_allclose(solution.poses, truth, atol=1e-9)


# The dual


def test_the_dual_proves_how_good_the_last_step_was(world):
    graph, truth = world
    solution = solve(graph, truth, OptimiserOptions(outer_iterations=1000))
    system = linearise(graph, solution.poses)
    assert np.abs(solution.dual).max() <= 1
    within = duality_gap(system.A, system.b, np.zeros(system.A.shape[1]), solution.dual,
                         np.full(system.A.shape[1], 0.01))
    assert 0 <= within < 0.01 * solution.cost
    assert 0 <= solution.gap < 1e-3 * solution.cost


def test_with_the_dual_returned_it_converges_at_once(world):
    graph, truth = world
    first = solve(graph, truth, OptimiserOptions(outer_iterations=1000))
    first.dual.flags.writeable = False
    again = solve(graph, first.poses, DEFAULTS, dual=first.dual)
    assert again.status in (Status.CONVERGED, Status.STALLED)
    assert again.outer_iterations <= 4
    assert first.cost - again.cost <= 2e-5 * first.cost


def test_a_dual_kept_from_step_to_step_leads_further(world):
    """Ten linearisations of 100 iterations: the reason why the paper's own costs are higher."""
    graph, truth = world
    best = solve(graph, truth, OptimiserOptions(outer_iterations=1000)).cost
    options = OptimiserOptions(outer_iterations=1, inner=PrimalDualOptions(iterations=100))
    zeros = np.zeros(3 * len(graph.between))
    excess = []
    for kept in True, False:
        poses, dual = truth, zeros
        for _ in range(10):
            solution = solve(graph, poses, options, dual=dual)
            poses, dual = solution.poses, solution.dual if kept else zeros
        excess.append(solution.cost / best - 1)
    assert excess[0] < excess[1] / 2


# Backtracking


def test_a_step_that_lowers_the_cost_is_taken_whole(world):
    graph, truth = world
    start = solve(graph, truth, OptimiserOptions(outer_iterations=1)).poses
    system = linearise(graph, start)
    _, step = linprog_l1(system.A, system.b, box=0.01)
    poses, residual = backtrack(graph, start, whitened_residual(graph, start), step)
    assert_array_equal(poses, step_poses(graph, start, step))
    assert_array_equal(residual, whitened_residual(graph, poses))
    assert l1_cost(residual) < cost(graph, start)


@pytest.mark.parametrize('length, taken', [
    (1.0, 1.0), (1.5, 1.5), (2.0, 1.0), (3.0, 1.5), (30.0, 1.875), (63.0, 63 / 32)])
def test_a_step_too_long_is_halved(length, taken):
    """The best is at 1; at 2 the cost is that of the start, which is no gain."""
    graph, start = parallel(1.0), np.zeros((2, 3))
    residual = whitened_residual(graph, start)
    poses, residual = backtrack(graph, start, residual, np.array([length, 0.0, 0.0]))
    assert_array_equal(poses, [[0, 0, 0], [taken, 0, 0]])
    assert l1_cost(residual) == abs(taken - 1)


@pytest.mark.parametrize('step', [[-1.0, 0, 0], [64.0, 0, 0], [0.0, 0, 0], [np.nan, 0, 0]])
def test_a_direction_that_is_no_good_is_given_up(step):
    graph, start = parallel(1.0), np.zeros((2, 3))
    before = whitened_residual(graph, start)
    poses, residual = backtrack(graph, start, before, np.array(step))
    assert poses is start and residual is before


def test_far_is_more_than_a_hundredth():
    assert is_far(102.0, 100.0) and not is_far(100.9, 100.0)
    assert is_far(1.0, 0.0) and not is_far(0.0, 0.0)
