# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The paper's algorithms as printed, and what is measured of them."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from problems import linprog_l1
from scipy.optimize import linprog

from l1slam_ros.core.geometry.noise import whiten
from l1slam_ros.core.geometry.se2 import wrap
from l1slam_ros.core.graph.linear_system import linearise, step_poses, whitened_residual
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.solvers.seed import rotation_system, seed_poses, translation_system
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.paper import experiments as reproduction
from l1slam_ros.paper.experiments import (
    Effort,
    measure_convergence,
    measure_costs,
    measure_largest,
    printed_costs,
    printed_iterates,
)

LITTLE = Effort(outer=4, inner=60, iterations=400, timed=3, keyframes=0)


def silent(iteration, cost):
    """A report that nobody reads."""


@pytest.fixture(scope='module')
def world():
    return simulate_world(80, 160, WorldOptions(), np.random.default_rng(3))


@pytest.fixture(scope='module')
def seed(world):
    return seed_poses(world.graph, cholesky_of(world.graph))


def cost(graph, poses):
    return l1_cost(whitened_residual(graph, poses))


def algorithm_2(system):
    """The paper's Algorithm 2 for theta = 1, from zero, written out in dense matrices."""
    A, b = system.A.toarray(), system.b
    tau, sigma = 1 / np.abs(A).sum(axis=0), 1 / np.abs(A).sum(axis=1)
    x = x_bar = np.zeros(A.shape[1])
    y = np.zeros(len(b))
    while True:
        y = y + sigma * (A @ x_bar - b)
        y = y / np.maximum(1, np.abs(y))
        x_new = x - tau * (A.T @ y)
        x, x_bar = x_new, 2 * x_new - x
        yield x, y


def test_the_printed_iterates_are_those_of_algorithm_2(world, seed):
    system = linearise(world.graph, seed)
    ours = printed_iterates(system, np.zeros(system.A.shape[1]))
    for (x, y), (x_ours, y_ours) in islice(zip(algorithm_2(system), ours, strict=True), 25):
        np.testing.assert_allclose(x_ours, x, atol=1e-12)
        np.testing.assert_allclose(y_ours, y, atol=1e-12)


def test_algorithm_4_as_printed_takes_full_steps_from_a_cold_dual(world):
    told = []
    poses = world.odometry
    expected = [cost(world.graph, world.odometry)]
    for _ in range(3):
        *_, (x, _) = islice(algorithm_2(linearise(world.graph, poses)), LITTLE.inner)
        poses = step_poses(world.graph, poses, x)
        expected.append(cost(world.graph, poses))
    costs = printed_costs(world.graph, world.odometry, replace(LITTLE, outer=3),
                          lambda *step: told.append(step))
    np.testing.assert_allclose(costs, expected, rtol=1e-9)
    assert told == list(enumerate(costs))[1:]


def test_algorithm_4_as_printed_ends_once_it_has_settled(world, seed):
    costs = printed_costs(world.graph, seed, Effort(outer=200, inner=40), silent)
    changes = np.abs(np.diff(costs)) / costs[1:]
    windows = np.lib.stride_tricks.sliding_window_view(changes, 5)
    assert len(costs) < 201 and (windows < 1e-4).all(axis=1).tolist() == [
        k == len(windows) - 1 for k in range(len(windows))]


def test_costs_are_those_of_the_poses_and_ours_is_the_lowest(world, seed):
    costs = measure_costs(world.graph, world.odometry, seed, LITTLE, silent)
    assert costs.initial == cost(world.graph, world.odometry)
    assert costs.seed == costs.printed[0] == cost(world.graph, seed)
    assert costs.solution.cost == cost(world.graph, costs.solution.poses)
    assert costs.solution.cost < min(costs.seed, costs.l2, *costs.printed, costs.initial)


def test_both_problems_begin_at_the_odometry_and_come_near_their_optimum(world, seed):
    graph, factors = world.graph, world.graph.between
    curves = measure_convergence(graph, world.odometry, seed, 2000)
    theta = world.odometry[:, 2]
    error = wrap(theta[factors.j] - theta[factors.i] - factors.measurement[:, 2])
    mixed = np.concatenate((world.odometry[:, :2], seed[:, 2:]), axis=1)
    rows = whiten(factors.sqrt_information, graph.manifold.residual(
        factors.measurement, mixed[factors.i], mixed[factors.j]))
    begin = {'angle': np.abs(factors.sqrt_information[:, 2, 2] * error).sum(),
             'translation': np.abs(rows[:, :2]).sum()}
    systems = {'angle': rotation_system(graph, world.odometry),
               'translation': translation_system(graph, seed)}
    for problem, system in systems.items():
        optimum, _ = linprog_l1(system.A, system.b)
        for name, history in curves[problem].items():
            assert history[0, 0] == 0 and history[-1, 0] == 2000
            assert optimum - 1e-6 < history[-1, 1] < 1.02 * optimum
            if 'least squares' not in name:
                assert history[0, 1] == pytest.approx(begin[problem])


def test_algorithm_4_as_printed_is_cut_short_on_the_largest_graphs(world, seed, monkeypatch):
    whole = measure_costs(world.graph, world.odometry, seed, LITTLE, silent)
    assert not whole.cut_short and len(whole.printed) == 1 + LITTLE.outer
    monkeypatch.setattr(reproduction, '_MOST_PASSES', 2.5 * LITTLE.inner * 160)
    cut = measure_costs(world.graph, world.odometry, seed, LITTLE, silent)
    assert cut.cut_short and cut.printed.tolist() == whole.printed[:3].tolist()
    few = measure_costs(world.graph, world.odometry, seed, replace(LITTLE, outer=2), silent)
    assert not few.cut_short


def test_the_largest_residual_is_that_of_a_linear_program(world, seed):
    graph = world.graph
    found = measure_largest(graph, seed, replace(LITTLE, iterations=20_000))
    largest = {name: values[0] for name, values in found.items()}
    assert largest['L-infinity'] < largest['L2'] < largest['L1']
    assert found['L1'][1] == min(values[1] for values in found.values())
    assert found['L2'][2] == min(values[2] for values in found.values())
    # To first order, as near as the map is to the L2 map.
    l2 = minimise_l2(graph, seed, LeastSquaresOptions(), cholesky_of(graph)).poses
    system = linearise(graph, l2)
    A, b = system.A.toarray(), system.b
    rows, columns = A.shape
    level = np.ones((rows, 1))
    best = linprog(np.append(np.zeros(columns), 1.0),
                   A_ub=np.block([[A, -level], [-A, -level]]), b_ub=np.concatenate((b, -b)),
                   bounds=[(None, None)] * columns + [(0, None)], method='highs').fun
    assert largest['L-infinity'] == pytest.approx(best, rel=1e-2)
