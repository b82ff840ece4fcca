# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Which solver a graph gets: by what a factorisation costs, by name, and where one fails."""

import re

import pytest
from problems import chain_and_loops, drive, graph_of

from l1slam_ros.core import memory
from l1slam_ros.core.errors import FillError, L1SlamError
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.names import SOLVERS
from l1slam_ros.core.solvers import block_cholesky
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import Status
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import AUTO, INTERIOR_POINT, PRIMAL_DUAL, choose, minimise_by
from l1slam_ros.core.worlds.false_loops import random_false_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world, with_false_loops

DEFAULTS = OptimiserOptions()


@pytest.fixture
def world(rng):
    return simulate_world(60, 90, WorldOptions(), rng)


@pytest.fixture
def dense(rng):
    """A graph whose far places are joined at random: half of it ends in one dense block."""
    truth = drive(1000, rng)
    pairs = chain_and_loops(1000, 3000, rng)
    return graph_of(truth, pairs, 0.01 * rng.standard_normal((len(pairs), 3)))


def test_sparse_graphs_get_the_interior_point_and_dense_ones_algorithm_4(world, dense):
    short = OptimiserOptions(outer_iterations=1)
    for graph, expected, expected_reason, options in (
            (world.graph, INTERIOR_POINT, 'sparse', DEFAULTS),
            (dense, PRIMAL_DUAL, 'dense', short)):
        method = choose(AUTO, graph)
        assert (method.solver, method.falls_back) == (expected, True)
        assert method.cholesky is not None
        assert method.reason == f'the graph is {expected_reason}'
        _, solver = minimise_by(method, graph, seed_poses(graph, method.cholesky), options)
        assert solver == expected


def test_the_papers_graphs_get_the_interior_point(datasets):
    from l1slam_ros.io.graphs.graph_file import read_graph_file

    for name in ('intel', 'manhattan3500', 'city10000'):
        assert choose(AUTO, read_graph_file(datasets / f'{name}.g2o').graph).solver == (
            INTERIOR_POINT)


@pytest.mark.parametrize('solver', SOLVERS[1:])
def test_a_solver_that_was_asked_for_is_the_one(solver, world, dense):
    for graph in world.graph, dense:
        method = choose(solver, graph)
        assert (method.solver, method.reason, method.falls_back) == (solver, 'asked for', False)
        assert method.cholesky is not None


def test_both_solvers_end_at_one_cost(world):
    start = odometry_poses(world.graph)
    solved = [minimise_by(choose(solver, world.graph), world.graph, start, DEFAULTS)
              for solver in SOLVERS]
    assert [name for _, name in solved] == [INTERIOR_POINT, PRIMAL_DUAL, INTERIOR_POINT]
    costs = [solution.cost for solution, _ in solved]
    assert costs == pytest.approx([costs[0]] * 3, rel=1e-3)
    assert [solution.inner_iterations > 0 for solution, _ in solved] == [False, True, False]


def test_a_graph_that_fills_in_gets_algorithm_4(world, monkeypatch):
    """With memory for a few blocks only: nothing is factored, and it is solved all the same."""
    graph = world.graph
    expected = minimise_by(choose(AUTO, graph), graph, world.truth, DEFAULTS)[0].cost
    monkeypatch.setattr(block_cholesky, 'most_blocks', lambda graph: 30)
    for solver in AUTO, PRIMAL_DUAL:
        method = choose(solver, graph)
        assert (method.cholesky, method.solver) == (None, PRIMAL_DUAL)
        assert re.fullmatch(r'factorising 60 keyframes and [0-9]+ factors takes [0-9.e-]+ GB of '
                            r'memory or more, and [0-9.]+ GB are free', method.reason)
        solution, name = minimise_by(method, graph, seed_poses(graph, None), DEFAULTS)
        assert name == PRIMAL_DUAL
        assert solution.cost == pytest.approx(expected, rel=1e-3)


def test_the_interior_point_of_a_graph_that_fills_in_is_refused(world, monkeypatch):
    monkeypatch.setattr(memory, 'free', lambda: 150_000.0)
    said = r'60 keyframes .* takes 0\.000[0-9]+ GB .* 0\.00015 GB are free'
    with pytest.raises(FillError, match=said) as refusal:
        choose(INTERIOR_POINT, world.graph)
    assert isinstance(refusal.value, L1SlamError) and '\n' not in str(refusal.value)


def test_the_memory_of_the_factor_is_predicted_to_a_third(rng):
    """That of the blocks of all sizes which a seed and a map lay out."""
    graph = simulate_world(600, 1200, WorldOptions(), rng).graph
    method = choose(AUTO, graph)
    seed_poses(graph, method.cholesky)
    minimise_by(method, graph, odometry_poses(graph), OptimiserOptions(outer_iterations=2))
    taken = sum(layout.panels.nbytes for layout in method.cholesky._layouts.values())
    blocks = method.needs.memory - block_cholesky.needs(graph, 0.0, 0.0).memory
    assert 0.75 * taken < blocks < 1.33 * taken


def test_the_time_is_predicted_by_factors_by_fill_and_by_work(rng):
    """More of each takes longer; ten times the factors, less than thrice as long."""
    sparse, crowded = (simulate_world(600, edges, WorldOptions(), rng).graph
                       for edges in (1200, 12000))
    blocks, work = 10_000, 300_000.0
    first = block_cholesky.needs(sparse, blocks, work).seconds
    assert first < block_cholesky.needs(crowded, blocks, work).seconds < 3 * first
    assert first < block_cholesky.needs(sparse, 2 * blocks, work).seconds < 2 * first
    assert first < block_cholesky.needs(sparse, blocks, 2 * work).seconds < 2 * first


def test_what_does_not_fit_grows_with_the_graph_and_what_fits_is_never_refused(monkeypatch, rng):
    graph = simulate_world(600, 1200, WorldOptions(), rng).graph
    needed = choose(INTERIOR_POINT, graph).needs.memory
    monkeypatch.setattr(memory, 'free', lambda: 1.001 * needed)
    assert choose(AUTO, graph).solver == INTERIOR_POINT
    monkeypatch.setattr(memory, 'free', lambda: 0.999 * needed)
    assert choose(AUTO, graph).cholesky is None


@pytest.mark.parametrize('solver, expected', [(AUTO, PRIMAL_DUAL), (INTERIOR_POINT,) * 2])
def test_algorithm_4_goes_on_where_the_interior_point_failed_unless_it_was_asked_for(
        solver, expected, rng):
    """From raw odometry, a third of the loops false, five steps are not enough."""
    world = simulate_world(150, 220, WorldOptions(), rng)
    loops = random_false_loops(world.graph, world.truth, 30, rng)
    graph = with_false_loops(world, loops).graph
    start = odometry_poses(graph)
    options = OptimiserOptions(outer_iterations=5)
    asked, _ = minimise_by(choose(INTERIOR_POINT, graph), graph, start, options)
    assert asked.status is not Status.CONVERGED
    solution, name = minimise_by(choose(solver, graph), graph, start, options)
    assert name == expected
    if expected == PRIMAL_DUAL:
        assert solution.cost < solution.history[0] == asked.cost
