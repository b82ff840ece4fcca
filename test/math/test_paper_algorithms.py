# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The paper's algorithms as printed, what is measured of them, and a run with a draw."""

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
from l1slam_ros.core.solvers.seed import rotation_system, seed_poses, translation_system
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.paper import experiments, runs
from l1slam_ros.paper.experiments import Effort

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
    return np.abs(whitened_residual(graph, poses)).sum()


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
    ours = experiments.printed_iterates(system, np.zeros(system.A.shape[1]))
    for (x, y), (x_ours, y_ours) in islice(zip(algorithm_2(system), ours, strict=True), 25):
        np.testing.assert_allclose(x_ours, x, atol=1e-12)
        np.testing.assert_allclose(y_ours, y, atol=1e-12)


def test_algorithm_4_as_printed_takes_full_steps_from_a_cold_dual_until_it_has_settled(
        world, seed):
    poses = world.odometry
    expected = [cost(world.graph, poses)]
    for _ in range(3):
        *_, (x, _) = islice(algorithm_2(linearise(world.graph, poses)), LITTLE.inner)
        poses = step_poses(world.graph, poses, x)
        expected.append(cost(world.graph, poses))
    costs = experiments.printed_costs(
        world.graph, world.odometry, replace(LITTLE, outer=3), silent)
    np.testing.assert_allclose(costs, expected, rtol=1e-9)
    costs = experiments.printed_costs(world.graph, seed, Effort(outer=200, inner=40), silent)
    changes = np.abs(np.diff(costs)) / costs[1:]
    still = (np.lib.stride_tricks.sliding_window_view(changes, 5) < 1e-4).all(axis=1)
    assert len(costs) < 201 and np.flatnonzero(still).tolist() == [len(still) - 1]


def test_both_problems_begin_at_the_odometry_and_come_near_their_optimum(world, seed):
    graph, factors = world.graph, world.graph.between
    curves = experiments.measure_convergence(graph, world.odometry, seed, 2000)
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
            assert 'least squares' in name or history[0, 1] == pytest.approx(begin[problem])


def test_the_largest_residual_is_that_of_a_linear_program(world, seed):
    """To first order, as near as the map is to the L2 map."""
    graph = world.graph
    found = experiments.measure_largest(graph, seed, replace(LITTLE, iterations=20_000))
    largest = {name: values[0] for name, values in found.items()}
    assert largest['L-infinity'] < largest['L2'] < largest['L1']
    assert found['L1'][1] == min(values[1] for values in found.values())
    assert found['L2'][2] == min(values[2] for values in found.values())
    l2 = minimise_l2(graph, seed, LeastSquaresOptions(), cholesky_of(graph)).poses
    system = linearise(graph, l2)
    A, level = system.A.toarray(), np.ones((len(system.b), 1))
    columns = A.shape[1]
    best = linprog(np.append(np.zeros(columns), 1.0),
                   A_ub=np.block([[A, -level], [-A, -level]]),
                   b_ub=np.concatenate((system.b, -system.b)),
                   bounds=[(None, None)] * columns + [(0, None)], method='highs').fun
    assert largest['L-infinity'] == pytest.approx(best, rel=1e-2)


def test_the_start_that_is_drawn_is_the_first_that_l2_does_not_survive(world, rng):
    run, graph = runs.run_noisy_start(world.graph, world.odometry, rng), world.graph
    size = np.linalg.norm(np.ptp(world.odometry[:, :2], axis=0))
    assert runs.NOISES[0] < run.noise and runs.off(graph, run.l2, run.l1) > 0.02 * size
    assert runs.off(graph, run.start, run.l1) > runs.off(graph, run.seed, run.l1) > 0
    poses = np.tile(world.truth, (40, 1))
    step = graph.manifold.local(poses, runs.with_noise(graph, poses, 0.2, rng))
    np.testing.assert_allclose(step.std(axis=0), 0.2, rtol=0.05)
    np.testing.assert_allclose(step.mean(axis=0), 0, atol=0.015)
