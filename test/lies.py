# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Worlds with false loops in them, and a drive on which nothing is known until a loop says it."""

import numpy as np
from problems import PERIOD, covariance6, loop, odometry, retold

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.spanning_tree import odometry_poses, pair_key
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS
from l1slam_ros.core.worlds.simulate import (
    World,
    WorldOptions,
    simulate_world,
    with_false_loops,
)

# Odometry good enough for a drive of some hundred metres to come back near where it was.
CAREFUL = WorldOptions(odometry_sigma_rotation=0.005)


def careful_world(n, n_edges, seed=0):
    """Return a world whose odometry can tell true loops from false ones."""
    return simulate_world(n, n_edges, CAREFUL, np.random.default_rng(seed))


def laps(n, count, n_loops, options, rng):
    """Return a world of n keyframes, `count` laps of one square; loops see the lap before."""
    side, chain = n // count // 4, np.arange(n - 1)
    quarter = np.arange(n) // side % 4
    heading = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[quarter]
    position = np.concatenate((np.zeros((1, 2)), np.cumsum(heading[:-1], axis=0)))
    truth = np.column_stack((position, se2.wrap(quarter * np.pi / 2)))
    i = np.sort(rng.choice(n - 4 * side - 1, n_loops, replace=False))
    j = i + 4 * side + rng.integers(-1, 2, size=n_loops)
    i, j = np.concatenate((chain, i)), np.concatenate((chain + 1, j))
    is_loop = np.arange(len(i)) >= n - 1
    order = np.lexsort((i, is_loop, j))
    sigma = np.where(is_loop[order, None], [options.loop_sigma_translation] * 2 + [
        options.loop_sigma_rotation], [options.odometry_sigma_translation] * 2 + [
        options.odometry_sigma_rotation])
    i, j = i[order], j[order]
    graph = FactorGraph(se2, n)
    graph.add_between(i, j, se2.retract(
        se2.between(truth[i], truth[j]), sigma * rng.standard_normal((len(i), 3))),
        np.eye(3) / sigma[:, :, None]**2)
    return World(graph, truth, odometry_poses(graph), np.zeros((0, 2), np.int64))


def spoilt(world, kind, count, seed=1):
    """Return the world with false loops of one of `FALSE_LOOPS`."""
    loops = FALSE_LOOPS[kind](world.graph, world.truth, count, np.random.default_rng(seed))
    return with_false_loops(world, loops)


def is_false(world, factors):
    """Tell which between factors are false loops of the world, (m,) bool."""
    n = world.graph.n_poses
    return np.isin(pair_key(factors.i, factors.j, n), pair_key(*world.false_loops.T, n))


def slipped(graph, steps, more):
    """Return the graph, its odometry wrong at each of some steps (s,) by more, (3,) or (s, 3)."""
    factors, Z = graph.between, graph.between.measurement.copy()
    rows = np.flatnonzero(factors.is_odometry & np.isin(factors.i, steps))
    Z[rows] = se2.retract(Z[rows], np.broadcast_to(np.asarray(more, float), (len(rows), 3)))
    return retold(graph, Z)


def position_error(poses, truth):
    """Return the RMSE of the positions [m] after rigid alignment."""
    return absolute_trajectory_error(se2.positions(poses), se2.positions(truth[:len(poses)]))


ROUND = 200  # keyframes of one round of the roundabout
_SIGMA = np.array([0.3, 0.3, 0.03])


def roundabout(n):
    """Return the true poses of a drive in a circle, 1 m a step, (n, 3)."""
    truth, step = np.zeros((n, 3)), np.array([[1.0, 0.0, 2 * np.pi / ROUND]])
    for k in range(1, n):
        truth[k] = se2.compose(truth[k - 1 : k], step)[0]
    return truth


def drive_roundabout(backend, truth, seed=0):
    """Add keyframes that drift so far that one loop back to the start could be chance."""
    noise = _SIGMA * np.random.default_rng(seed).standard_normal((len(truth) - 1, 3))
    steps, pose = se2.retract(se2.between(truth[:-1], truth[1:]), noise), truth[:1]
    backend.add_odometry(odometry(0.0, pose[0]))
    for k, step in enumerate(steps, 1):
        pose = se2.compose(pose, step[None])
        backend.add_odometry(odometry(k * PERIOD, pose[0], covariance6(np.diag(_SIGMA**2))))


def seen(truth, i, j):
    """Return the loop that sees keyframe j from keyframe i as they are in truth."""
    pose = se2.between(truth[i : i + 1], truth[j : j + 1])[0]
    return loop(i * PERIOD, j * PERIOD, pose, covariance6(np.diag([1e-2, 1e-2, 1e-3])))
