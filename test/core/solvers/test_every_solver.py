# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What every solver promises: of whole graphs, and of one linear problem."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import add_absolute, drive, graph_of, noisy_graph
from systems import chain, random_loops, random_system

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.names import NORMS
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.exact import minimise_interior_point
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, gauss_newton, minimise_l2
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, minimise
from l1slam_ros.core.solvers.optimality import Huber, Lengths, Status, l1_cost, norm_of
from l1slam_ros.core.solvers.primal_dual import CHECK_EVERY, PrimalDualOptions, minimise_l1
from l1slam_ros.core.solvers.primal_dual_newton import minimise_norm
from l1slam_ros.core.solvers.restarted_pdhg import minimise_l1_halpern


def of(minimise, norm):
    """Return a solver of one norm."""
    return lambda graph, poses, *more, **named: minimise(graph, poses, norm, *more, **named)


# By the norm that each minimises.
WHOLE = {'algorithm 4': (minimise, 'l1'), 'interior point': (minimise_interior_point, 'l1'),
         'group L1': (of(minimise_norm, Lengths(3)), 'group-l1'), 'L2': (minimise_l2, 'l2'),
         'Huber': (of(gauss_newton, Huber(3, 1.345)), 'huber')}
MOST = 200


def solve(name, graph, start, steps=MOST, report=lambda k, cost: None):
    options = (LeastSquaresOptions(iterations=steps) if name in ('L2', 'Huber') else
               OptimiserOptions(outer_iterations=steps))
    return WHOLE[name][0](graph, start, options, cholesky_of(graph), report=report)


def cost(name, graph, poses):
    norm = norm_of(WHOLE[name][1], 3, LeastSquaresOptions().huber_delta)
    return norm.cost(whitened_residual(graph, poses))


@pytest.fixture(params=WHOLE)
def name(request):
    return request.param


@pytest.fixture
def world(rng):
    return noisy_graph(40, 35, rng)


def test_every_norm_has_its_solver():
    assert {norm for _, norm in WHOLE.values()} == set(NORMS)


@pytest.mark.parametrize('steps', [0, 1, 3, MOST])
def test_it_says_how_far_it_came_and_never_ends_worse(name, steps, world):
    graph = world[0]
    start = odometry_poses(world[0])
    reports = []
    given = start.copy()
    given.flags.writeable = False
    found = solve(name, graph, given, steps, lambda k, cost: reports.append((k, cost)))
    assert (found.status is Status.ITERATION_LIMIT) == (steps < MOST)
    assert found.outer_iterations <= steps and (
        steps == MOST or found.outer_iterations == steps)
    assert found.history[0] == cost(name, graph, start)
    assert found.history[-1] == found.cost == cost(name, graph, found.poses)
    assert (np.diff(found.history) <= 0).all()
    assert len(found.history) == found.outer_iterations + 1
    # The L2 map, where one solver begins with it, is one step, unreported.
    assert [value for _, value in reports] == found.history[-len(reports):].tolist() * (
        len(reports) > 0)
    assert len(reports) >= found.outer_iterations - 1
    assert found.dual.shape == (3 * len(graph.between),)
    assert_array_equal(given, start)
    if not steps:
        assert_array_equal(found.poses, start)


def test_a_fit_without_an_error_is_the_end(name, rng):
    one = FactorGraph(se2)
    one.add_poses(1)
    chain_alone = graph_of(drive(3, rng), [(0, 1), (1, 2)])
    for graph, start in (one, se2.identity(1)), (chain_alone, odometry_poses(chain_alone)):
        found = solve(name, graph, start)
        assert found.status is Status.CONVERGED
        assert found.cost == pytest.approx(0, abs=1e-9)
        assert_allclose(found.poses, start, atol=1e-12)


def test_the_world_takes_the_place_of_the_anchor(name, world):
    graph, truth = world
    alone = solve(name, graph, truth)
    there = se2.compose(np.broadcast_to([10.0, 20.0, 0.5], truth.shape), truth)
    add_absolute(graph, np.array([7]), there[7:8], 1e4 * np.eye(3)[None])
    found = solve(name, graph, there)
    assert found.cost == pytest.approx(alone.cost, rel=1e-4)
    assert_allclose(found.poses[7], there[7], atol=1e-3)
    assert found.dual.shape == (3 * len(graph.between),)


# Linear problems


def plain(system, x, y, options):
    return minimise_l1(system.A, system.b, x, y, options)


@pytest.fixture(params=[plain, minimise_l1_halpern], ids=['Algorithm 2', 'restarted'])
def method(request):
    return request.param


@pytest.fixture
def system(rng):
    return random_system(2 * chain(12) + random_loops(12), 12, 3, rng)


def zeros(system):
    return np.zeros(system.size * system.block_size), np.zeros(len(system.b))


@pytest.mark.parametrize('iterations', [1, 39, 40, 41, 100])
def test_the_iteration_limit_is_kept_and_the_history_goes_from_start_to_end(
        method, iterations, system):
    found = method(system, *zeros(system), PrimalDualOptions(iterations, 0.0))
    assert found.status is Status.ITERATION_LIMIT
    assert found.iterations == iterations
    expected = [*range(0, iterations, CHECK_EVERY), iterations]
    assert found.history[:, 0].tolist() == expected
    assert found.history[0, 1] == l1_cost(system.b)
    assert found.history[-1, 1] == found.objective


def test_a_warm_start_needs_fewer_iterations(method, system, rng):
    options = PrimalDualOptions(100_000, 1e-3)
    cold = method(system, *zeros(system), options)
    moved = type(system)(system.keyframe, system.blocks,
                         system.b + 1e-4 * rng.standard_normal(len(system.b)), system.size)
    again = method(moved, *zeros(system), options)
    warm = method(moved, cold.x, cold.y, options)
    assert warm.status is again.status is Status.CONVERGED
    assert warm.iterations < again.iterations / 2


def test_inputs_are_never_written_to(method, system, rng):
    arrays = (system.keyframe, system.blocks, system.b, rng.standard_normal(36),
              rng.uniform(-1, 1, len(system.b)))
    before = [array.copy() for array in arrays]
    for array in arrays:
        array.flags.writeable = False
    method(system, *arrays[3:], PrimalDualOptions(200, 0.0))
    for array, expected in zip(arrays, before, strict=True):
        assert_array_equal(array, expected)


@pytest.mark.parametrize('factor', [1000.0, 1e-6])
def test_the_unit_of_length_does_not_matter(method, factor, system):
    """Columns in another unit: the same path but for rounding."""
    other = type(system)(system.keyframe, factor * system.blocks, system.b, system.size)
    one, two = (method(s, *zeros(s), PrimalDualOptions(400, 0.0)) for s in (system, other))
    assert two.objective == pytest.approx(one.objective, rel=1e-3)
    assert_allclose(factor * two.x, one.x, rtol=0.05, atol=0.05 * np.abs(one.x).max())
