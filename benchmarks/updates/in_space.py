# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Drives in space that are fed pose by pose: streets over hills, as KITTI's, and a building.

In: a folder of datasets. Out: a graph in SE(3) and the truth it was measured in. KITTI's way is
that of the recorded graph at its L2 map, its loops those that were found there; the ground
beneath it and all noise are drawn.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from robust.kinds import KITTI
from robust.places import place

from l1slam_ros.core.geometry import se3
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

HILLS, BUILDING = 'hills', 'building'
# Of the building: keyframes and edges, as many to a keyframe as in City.
_BUILDING = 5000, 10_300
# The ground is a sum of waves, so long and so high [m], in random directions: streets as steep as
# a fifth.
_WAVES = ((400.0, 6.0), (250.0, 3.0), (120.0, 1.0))
# [m], [rad] What an odometry of lidar and inertial sensors is wrong by from one keyframe to the
# next, a metre on: gravity tells roll and pitch. And what a match of two scans is.
_ODOMETRY = (0.02, 0.02, 0.02, 0.0005, 0.0005, 0.001)
_LOOP = (0.1, 0.1, 0.1, 0.005, 0.005, 0.005)


def hills(datasets: Path) -> tuple[FactorGraph, Array]:
    """Return KITTI's streets over hills, and their truth (n, 7)."""
    rng, flat = np.random.default_rng(0), place(datasets, KITTI)
    truth, factors = _over_ground(flat.best, rng), flat.graph.between
    sigma = np.where(factors.is_odometry[:, None], _ODOMETRY, _LOOP)
    graph = FactorGraph(se3, len(truth))
    graph.add_between(
        factors.i, factors.j, se3.retract(se3.between(truth[factors.i], truth[factors.j]),
                                          sigma * rng.standard_normal(sigma.shape)),
        sigma[:, :, None] ** -2 * np.eye(se3.TANGENT_SIZE))
    return graph, truth


def floors(datasets: Path) -> tuple[FactorGraph, Array]:
    """Return a building of several floors, and its truth (n, 7)."""
    world = simulate_world(*_BUILDING, WorldOptions(), np.random.default_rng(0), 'building')
    return world.graph, world.truth


SPACES: dict[str, Callable[[Path], tuple[FactorGraph, Array]]] = {
    HILLS: hills, BUILDING: floors}


def _over_ground(poses: Array, rng: np.random.Generator) -> Array:
    """Return poses (n, 3) of a plane as they stand on hills, (n, 7): z off the ground."""
    height, slope = np.zeros(len(poses)), np.zeros((len(poses), 2))
    for length, most in _WAVES:
        angle, begin = rng.uniform(0, 2 * np.pi, 2)
        wave = 2 * np.pi / length * np.array([np.cos(angle), np.sin(angle)])
        phase = poses[:, :2] @ wave + begin
        height += most * np.sin(phase)
        slope += most * np.cos(phase)[:, None] * wave
    z = np.column_stack((-slope, np.ones(len(poses))))
    ahead = np.column_stack((np.cos(poses[:, 2]), np.sin(poses[:, 2])))
    x = np.column_stack((ahead, (ahead * slope).sum(axis=1)))
    x, z = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (x, z))
    return se3.from_rotation(np.stack((x, np.cross(z, x), z), axis=2),
                             np.column_stack((poses[:, :2], height)))
