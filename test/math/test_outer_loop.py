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
from numpy.testing import assert_array_equal
from problems import linprog_l1, noisy_graph

import l1slam_ros as l1
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.linear_system import linearise, whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, backtrack, minimise
from l1slam_ros.core.solvers.optimality import duality_gap, l1_cost
from l1slam_ros.core.solvers.primal_dual import PrimalDualOptions
from l1slam_ros.core.solvers.seed import seed_poses

DEFAULTS = OptimiserOptions()
LONG = OptimiserOptions(outer_iterations=1000)


def cost(graph, poses):
    return l1_cost(whitened_residual(graph, poses))


def solve(graph, start, options=DEFAULTS, **more):
    return minimise(graph, start, options, cholesky_of(graph), **more)


def parallel(*distances):
    """Return two keyframes and a factor of unit noise for each distance between them."""
    graph, m = l1.FactorGraph(se2, 2), len(distances)
    measurement = np.array([(x, 0.0, 0.0) for x in distances])
    graph.add_between(np.zeros(m, int), np.ones(m, int), measurement,
                      np.broadcast_to(np.eye(3), (m, 3, 3)))
    return graph


@pytest.fixture
def world(rng):
    return noisy_graph(60, 50, rng)


@pytest.mark.parametrize('start', ['seed', 'odometry', 'truth'])
@pytest.mark.parametrize('factored', [True, False])
def test_no_small_step_is_better_by_highs(factored, start, world):
    """Also of a graph that fills in: linear problems then begin where the last one ended."""
    graph, truth = world
    cholesky = cholesky_of(graph) if factored else None
    starts = {'seed': seed_poses(graph, cholesky), 'odometry': odometry_poses(graph),
              'truth': truth}
    found = minimise(graph, starts[start], DEFAULTS, cholesky)
    system = linearise(graph, found.poses)
    best, _ = linprog_l1(system.A, system.b, box=0.02)
    assert found.cost == cost(graph, found.poses) == l1_cost(system.b)
    assert best >= (1 - (1e-3 if factored else 2e-3)) * found.cost
    assert found.cost < cost(graph, truth)
    assert found.cost == pytest.approx(l1.solve(graph, robust=False).cost, rel=3e-3)


# How it ends


def test_it_converges_with_a_dual_that_proves_how_good_the_last_step_was(world):
    graph, truth = world
    found = solve(graph, truth, LONG)
    assert found.status == 'converged' and found.outer_iterations < 1000
    small = -np.diff(found.history) <= LONG.outer_tolerance * found.history[1:]
    assert small[-2:].all() and not (small[:-2] & small[1:-1]).any()
    system = linearise(graph, found.poses)
    assert np.abs(found.dual).max() <= 1
    columns = system.A.shape[1]
    within = duality_gap(system.A, system.b, np.zeros(columns), found.dual,
                         np.full(columns, 0.01))
    assert 0 <= within < 0.01 * found.cost and 0 <= found.gap < 1e-3 * found.cost
    again = solve(graph, found.poses, dual=found.dual)
    assert again.outer_iterations <= 4 and found.cost - again.cost <= 2e-5 * found.cost


def test_where_nothing_is_better_it_has_converged():
    """At the median to the last bit no step lowers the cost, and the dual proves it."""
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    found = solve(parallel(0.0, 1.0, 5.0), poses)
    assert (found.status, found.cost) == ('converged', 5.0)
    assert_array_equal(found.poses, poses)


def test_a_deadline_that_has_passed_leaves_one_linearisation(world):
    graph, _ = world
    start = odometry_poses(graph)
    found = solve(graph, start, deadline=time.monotonic())
    assert (found.status, found.outer_iterations) == ('out_of_time', 1)
    assert found.cost < cost(graph, start)


def test_a_dual_kept_from_step_to_step_leads_further(world):
    """Ten linearisations of 100 iterations: the reason why the paper's own costs are higher."""
    graph, truth = world
    best = solve(graph, truth, LONG).cost
    options = OptimiserOptions(outer_iterations=1, inner=PrimalDualOptions(iterations=100))
    zeros = np.zeros(3 * len(graph.between))
    excess = []
    for kept in True, False:
        poses, dual = truth, zeros
        for _ in range(10):
            found = solve(graph, poses, options, dual=dual)
            poses, dual = found.poses, found.dual if kept else zeros
        excess.append(found.cost / best - 1)
    assert excess[0] < excess[1] / 2


# Backtracking


@pytest.mark.parametrize('length, taken', [
    (1.0, 1.0), (1.5, 1.5), (2.0, 1.0), (3.0, 1.5), (30.0, 1.875), (63.0, 63 / 32)])
def test_a_step_too_long_is_halved(length, taken):
    """The best is at 1; at 2 the cost is that of the start, which is no gain."""
    graph, start = parallel(1.0), np.zeros((2, 3))
    residual = whitened_residual(graph, start)
    poses, residual = backtrack(graph, start, residual, np.array([length, 0.0, 0.0]))
    assert_array_equal(poses, [[0, 0, 0], [taken, 0, 0]])
    assert l1_cost(residual) == abs(taken - 1)
