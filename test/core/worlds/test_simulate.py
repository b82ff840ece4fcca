# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Manhattan worlds: the streets, the order of factors, and noise that is what it says."""

import math

import numpy as np
import pytest

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

OPTIONS = WorldOptions()


@pytest.mark.parametrize('n_poses, n_edges', [
    (2, 1), (3, 2), (3, 3), (12, 66), (100, 99), (400, 1200), (300, 9000)])
def test_a_world_has_the_size_asked_for(n_poses, n_edges, rng):
    world = simulate_world(n_poses, n_edges, OPTIONS, rng)
    assert world.graph.n_poses == len(world.truth) == len(world.odometry) == n_poses
    assert len(world.graph.between) == n_edges
    assert world.graph.between.is_odometry.sum() == n_poses - 1
    assert world.false_loops.shape == (0, 2)
    np.testing.assert_array_equal(world.truth[0], 0)
    np.testing.assert_array_equal(world.odometry[0], 0)


def test_the_robot_drives_along_streets_and_turns_at_crossings(rng):
    options = WorldOptions(step=0.5, block=4)
    truth = simulate_world(2000, 3000, options, rng).truth
    x, y, theta = truth.T
    dx, dy = np.diff(x), np.diff(y)
    np.testing.assert_allclose(np.hypot(dx, dy), 0.5, atol=1e-12)
    # It moves the way it looks, and looks along an axis.
    np.testing.assert_allclose(np.cos(theta[:-1]), dx / 0.5, atol=1e-12)
    np.testing.assert_allclose(np.sin(theta[:-1]), dy / 0.5, atol=1e-12)
    turns = np.round(se2.wrap(np.diff(theta)) / (math.pi / 2)).astype(int)
    at_crossing = np.arange(1, 2000) % 4 == 0
    assert set(turns[at_crossing]) == {-1, 0, 1}
    assert not turns[~at_crossing].any()
    on_street = [np.abs(v / 2.0 - np.round(v / 2.0)) < 1e-9 for v in (x, y)]
    assert (on_street[0] | on_street[1]).all()


def test_streets_are_driven_again(rng):
    truth = simulate_world(3000, 5000, OPTIONS, rng).truth
    _, visits = np.unique(np.round(truth[:, :2]), axis=0, return_counts=True)
    assert np.median(visits) >= 2
    assert np.ptp(truth[:, :2], axis=0).min() > 20


def test_factors_come_in_the_order_of_a_drive(rng):
    factors = simulate_world(500, 2000, OPTIONS, rng).graph.between
    loop = factors.j - factors.i != 1
    np.testing.assert_array_equal(~loop, factors.is_odometry)
    order = list(zip(factors.j.tolist(), loop.tolist(), factors.i.tolist(), strict=True))
    assert order == sorted(set(order))
    assert (factors.i < factors.j).all()


def test_loops_join_poses_that_are_near(rng):
    world = simulate_world(2000, 4000, OPTIONS, rng)
    factors = world.graph.between
    distance = np.linalg.norm(world.truth[factors.i, :2] - world.truth[factors.j, :2], axis=1)
    assert distance.max() < 3.0
    # Most of them after a long way round, not around the last corner.
    assert np.median((factors.j - factors.i)[~factors.is_odometry]) > 200


def test_noise_has_the_information_stated(rng):
    options = WorldOptions(odometry_sigma_translation=0.2, odometry_sigma_rotation=0.003,
                           loop_sigma_translation=0.01, loop_sigma_rotation=0.1)
    world = simulate_world(4000, 12000, options, rng)
    factors = world.graph.between
    sigma = 1 / np.diagonal(factors.sqrt_information, axis1=1, axis2=2)
    odometry = factors.is_odometry
    np.testing.assert_allclose(sigma[odometry], [[0.2, 0.2, 0.003]] * 3999, rtol=1e-12)
    np.testing.assert_allclose(sigma[~odometry], [[0.01, 0.01, 0.1]] * 8001, rtol=1e-12)
    residual = whitened_residual(world.graph, world.truth).reshape(-1, 3)
    for part in residual[odometry], residual[~odometry]:
        spread = 5 / math.sqrt(len(part))
        np.testing.assert_allclose(part.mean(axis=0), 0, atol=spread)
        np.testing.assert_allclose(part.std(axis=0), 1, atol=spread)


def test_a_seed_makes_one_world():
    worlds = [simulate_world(200, 500, OPTIONS, np.random.default_rng(seed)) for seed in (5, 5, 6)]
    measurements = [world.graph.between.measurement for world in worlds]
    np.testing.assert_array_equal(measurements[0], measurements[1])
    assert not np.array_equal(measurements[0], measurements[2])


@pytest.mark.parametrize('seed', range(4))
def test_by_default_odometry_drifts_by_metres_and_loops_mend_it(seed):
    world = simulate_world(1000, 2000, OPTIONS, np.random.default_rng(seed))
    poses = minimise_l2(world.graph, world.odometry, LeastSquaresOptions(),
                        cholesky_of(world.graph)).poses
    truth = se2.positions(world.truth)
    assert 1 < absolute_trajectory_error(se2.positions(world.odometry), truth) < 15
    assert absolute_trajectory_error(se2.positions(poses), truth) < 0.15


def test_the_largest_world_of_the_paper(rng):
    world = simulate_world(50_000, 700_000, OPTIONS, rng)
    factors = world.graph.between
    assert len(np.unique(factors.i * 50_000 + factors.j)) == 700_000
    assert np.isfinite(world.odometry).all()


@pytest.mark.parametrize('n_poses, n_edges, said', [
    (1, 0, 'a world of 1 poses, expected 2 or more'),
    (-3, 0, 'a world of -3 poses, expected 2 or more'),
    (10, 8, '8 edges between 10 poses, expected 9 to 45'),
    (10, 46, '46 edges between 10 poses, expected 9 to 45'),
])
def test_impossible_sizes_are_refused(n_poses, n_edges, said, rng):
    with pytest.raises(GraphError) as caught:
        simulate_world(n_poses, n_edges, OPTIONS, rng)
    assert str(caught.value) == said
