# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The exact L1 map: optimal by HiGHS and by its dual, never worse than its start."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import chain_of, graph_of, linprog_l1, straight

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import linearise, whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.exact import minimise_interior_point
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, minimise
from l1slam_ros.core.solvers.optimality import Status, l1_cost
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.worlds.false_loops import random_false_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world, with_false_loops

DEFAULTS = OptimiserOptions()


def cost_of(graph, poses):
    return l1_cost(whitened_residual(graph, poses))


def solve(graph, poses, options=DEFAULTS):
    return minimise_interior_point(graph, poses, options, cholesky_of(graph))


@pytest.fixture
def world(rng):
    return simulate_world(200, 330, WorldOptions(), rng)


def test_it_agrees_with_algorithm_4_and_is_optimal_by_its_dual(world):
    graph, cholesky = world.graph, cholesky_of(world.graph)
    seed = seed_poses(graph, cholesky)
    solution = minimise_interior_point(graph, seed, DEFAULTS, cholesky)
    first_order = minimise(graph, seed, OptimiserOptions(outer_iterations=60), cholesky)
    assert solution.cost <= (1 + 1e-5) * first_order.cost
    system = linearise(graph, solution.poses)
    assert np.abs(solution.dual).max() <= 1
    # The dual is feasible for the linear problem at the end, and its value is nearly the cost.
    assert np.abs(system.A.T @ solution.dual).max() < 1e-9 * np.abs(system.A).sum(axis=0).max()
    assert solution.dual @ -system.b == pytest.approx(solution.cost, rel=1e-3)
    assert 0 <= solution.gap == pytest.approx(solution.cost - solution.dual @ -system.b)


def closed_square(side, more, rng):
    """Return a drive round a square in steps of 1 m, whose last keyframes see the first."""
    n, sigma = 4 * side, np.array([0.05, 0.05, 0.002])
    steps = np.tile([1.0, 0.0, 0.0], (n + more - 1, 1))
    steps[side - 1::side, 2] = np.pi / 2
    measured = np.concatenate((steps, np.zeros((more, 3))))
    k, again = np.arange(len(steps)), np.arange(n, n + more)
    graph = FactorGraph(se2)
    graph.add_poses(n + more)
    graph.add_between(np.concatenate((k, again - n)), np.concatenate((k + 1, again)),
                      se2.retract(measured, sigma * rng.standard_normal(measured.shape)),
                      np.tile(np.diag(sigma**-2), (len(measured), 1, 1)))
    return graph


@pytest.mark.parametrize(('side', 'more', 'seed'), [
    (25, 5, 2), (250, 20, 10), (750, 5, 0), (750, 20, 0), (750, 20, 11)])
def test_a_long_way_that_closes_at_its_end_is_solved_to_its_end(side, more, seed):
    """Whoever damps the steps of a long way ends up to 9% above what the dual proves here."""
    graph = closed_square(side, more, np.random.default_rng(seed))
    cholesky = cholesky_of(graph)
    solution = minimise_interior_point(graph, odometry_poses(graph), DEFAULTS, cholesky)
    assert solution.status is Status.CONVERGED
    assert solution.gap < 1e-3 * solution.cost
    warm = minimise(graph, solution.poses, OptimiserOptions(outer_iterations=3), cholesky)
    assert warm.cost > (1 - 1e-3) * solution.cost


def stiff_part_on_soft_ties(rng):
    """Return six ties that contradict each other, on a part whose factors say far more."""
    along = np.arange(6)
    pairs = np.array([*[(0, 1)] * 6, (1, 2), (2, 3), (3, 4), (4, 5), (1, 5)])
    ties, step = np.column_stack((along, 0.5 * along, 0.1 * along)), [1.0, 0.0, 0.0]
    measured = np.concatenate((ties, [step] * 4, [[4.001, 0.0, 0.0]]))
    graph = FactorGraph(se2)
    graph.add_poses(6)
    graph.add_between(*pairs.T, measured + 1e-9 * rng.standard_normal(measured.shape),
                      np.where(pairs[:, 0] > 0, 3e5, 1.0)[:, None, None] * np.eye(3))
    return graph


def test_long_straight_ways_with_few_loops_are_solved_to_their_end():
    """600 m that bend as a whole: of ten, steps of each pose by itself solve seven."""
    n = 600
    loops = 9
    sigma = np.array([0.05, 0.05, 0.01])
    solved = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        last = rng.integers(n // 10, n, loops)
        first = last - rng.integers(2, n // 10, loops)
        pairs = np.concatenate((chain_of(n), np.column_stack((first, last))))
        graph = graph_of(straight(n), pairs, rng.normal(size=(len(pairs), 3)) * sigma,
                         np.diag(sigma**-2))
        cholesky = cholesky_of(graph)
        solution = minimise_interior_point(graph, seed_poses(graph, cholesky), OptimiserOptions(),
                                           cholesky)
        solved += solution.status is Status.CONVERGED and solution.outer_iterations < 30
    assert solved > 8


def test_what_rounding_leaves_indefinite_is_solved_to_its_end():
    """
    Where no tie is kept exactly, all of them give way to a push so much more than the part does,
    in the end, that the normal matrix has no factor. With nothing added to it the run stalls 10%
    above the optimum. Five times, moved a little: at such a point a run now and then goes astray.
    """
    graphs = [stiff_part_on_soft_ties(np.random.default_rng(seed)) for seed in range(5)]
    solutions = [solve(graph, odometry_poses(graph)) for graph in graphs]
    assert np.median([solution.gap / solution.cost for solution in solutions]) < 1e-3


def test_no_small_step_is_better_by_highs(world):
    solution = solve(world.graph, world.truth)
    system = linearise(world.graph, solution.poses)
    best, _ = linprog_l1(system.A, system.b, box=0.02)
    assert solution.cost == cost_of(world.graph, solution.poses)
    assert best >= (1 - 3e-5) * solution.cost


@pytest.mark.parametrize('seed', range(8))
def test_clean_worlds_converge_to_one_cost_from_all_starts(seed):
    world = simulate_world(150, 250, WorldOptions(), np.random.default_rng(seed))
    graph, cholesky = world.graph, cholesky_of(world.graph)
    starts = seed_poses(graph, cholesky), world.truth, odometry_poses(graph)
    solutions = [minimise_interior_point(graph, poses, DEFAULTS, cholesky) for poses in starts]
    assert {solution.status for solution in solutions} == {Status.CONVERGED}
    assert_allclose([solution.cost for solution in solutions], solutions[0].cost, rtol=3e-5)


def test_from_its_own_map_it_converges_to_that_map(world):
    first = solve(world.graph, world.truth)
    again = solve(world.graph, first.poses)
    assert again.status is Status.CONVERGED
    assert (1 - 3e-5) * first.cost <= again.cost <= first.cost


@pytest.mark.parametrize('seed', range(4))
def test_it_never_ends_worse_than_it_began(seed):
    rng = np.random.default_rng(seed)
    world = simulate_world(150, 220, WorldOptions(), rng)
    loops = random_false_loops(world.graph, world.truth, 30, rng)
    graph = with_false_loops(world, loops).graph
    start = cost_of(graph, world.truth)
    for outer in (0, 1, 2, 60):
        solution = solve(graph, world.truth, OptimiserOptions(outer_iterations=outer))
        assert solution.cost == cost_of(graph, solution.poses) <= start
        assert solution.history[0] == start and solution.history[-1] == solution.cost
        assert (np.diff(solution.history) <= 0).all()
