# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Synthetic worlds: a robot in the streets of a Manhattan, or in space.

In: sizes, noise, a random generator. Out: a graph and the truth it was measured in. A street grid
lies in the plane, so that world is SE(2); for the others see `in_space`. `false_loops` spoils
them, or any other graph.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import sigmas
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.names import WORLDS
from l1slam_ros.core.worlds.false_loops import Loops, insert_loops
from l1slam_ros.core.worlds.in_space import DRIVES

_EAST_NORTH_WEST_SOUTH = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
# A place is driven through this often or more, or there would be little to recognise.
_LEAST_VISITS = 3
# Loops are looked for within this many steps first: the same place and its neighbours.
_FIRST_RADIUS = 1.5
_RADIUS_GROWTH = 1.25


@dataclass(frozen=True)
class WorldOptions:
    """
    The streets the robot drives, and the standard deviations of what it measures.

    step : from one keyframe to the next [m]; block : keyframes from one crossing to the next;
    sigmas : of one measurement, along and across [m], and of its rotation [rad]. None may be 0: a
    measurement without noise would have infinite information.
    """

    step: float = 1.0
    block: int = 5
    odometry_sigma_translation: float = 0.05
    odometry_sigma_rotation: float = 0.01
    loop_sigma_translation: float = 0.05
    loop_sigma_rotation: float = 0.01


@dataclass(frozen=True)
class World:
    """
    A graph and the truth behind it.

    truth : (n, p) poses, the first the identity; odometry : (n, p) the chain of the odometry
    factors, where a robot believes to be before it closes a loop; false_loops : (k, 2) the
    keyframes i, j of each false loop, in the order of the graph.
    """

    graph: FactorGraph
    truth: Array
    odometry: Array
    false_loops: Indices


def simulate_world(
    n_poses: int, n_edges: int, options: WorldOptions, rng: np.random.Generator,
    world: str = WORLDS[0],
) -> World:
    """
    Return a world without false loops, of `names.WORLDS`.

    In streets the robot drives straight, left or right at random at every crossing of a square of
    them, as large as lets it come by the places often enough for `n_edges`. Loops join poses near
    each other in truth. Measurements are the true relative poses, then a step of Gaussian noise on
    the right. Factors come in the order of a drive: by j, at each j the odometry, then loops by i.

    Raises
    ------
    GraphError : fewer than two poses, fewer edges than the odometry has, or more than pairs.

    """
    n_loops = n_edges - (n_poses - 1)
    most = n_poses * (n_poses - 1) // 2
    if n_poses < 2:
        raise GraphError(f'a world of {n_poses} poses, expected 2 or more')
    if not 0 <= n_loops <= most - (n_poses - 1):
        raise GraphError(f'{n_edges} edges between {n_poses} poses, '
                         f'expected {n_poses - 1} to {most}')
    if world in DRIVES:
        manifold: Manifold = se3
        truth = DRIVES[world](n_poses, options.step, options.block, rng)
    else:
        visits = max(_LEAST_VISITS, n_loops / n_poses / 2)
        side = max(2, round(math.sqrt(n_poses / (2 * options.block * visits))))
        manifold = se2
        truth = _drive(n_poses, side, options, rng)
    loops = _near_pairs(manifold.positions(truth), n_loops, options.step, rng)
    chain = np.arange(n_poses - 1)
    i, j = np.concatenate((np.stack((chain, chain + 1), axis=1), loops)).T
    is_loop = np.arange(len(i)) >= n_poses - 1
    order = np.lexsort((i, is_loop, j))
    graph = _measured(manifold, truth, i[order], j[order], is_loop[order].astype(np.int64),
                      options, rng)
    return World(graph, truth, odometry_poses(graph), np.zeros((0, 2), np.int64))


def with_false_loops(world: World, loops: Loops) -> World:
    """Return the world with false loops in its graph, each at its place in time."""
    pairs = np.stack((loops.i, loops.j), axis=1)
    return replace(world, graph=insert_loops(world.graph, loops), false_loops=pairs)


def _drive(n_poses: int, side: int, options: WorldOptions, rng: np.random.Generator) -> Array:
    """Return the poses of a drive through side x side crossings, from one near the middle."""
    headings = [0]
    x = (side - 1) // 2 + 1
    y = (side - 1) // 2
    # A choice hangs on where the ones before led, so this cannot be done in one piece.
    for first in rng.integers(3, size=(n_poses - 1) // options.block).tolist():
        for k in range(3):
            heading = (headings[-1] + (first + k) % 3 - 1) % 4
            dx, dy = _EAST_NORTH_WEST_SOUTH[heading].tolist()
            if 0 <= x + dx < side and 0 <= y + dy < side:
                break
        headings.append(heading)
        x, y = x + dx, y + dy
    quarter = np.repeat(headings, options.block)[:n_poses]
    position = np.zeros((n_poses, 2))
    position[1:] = np.cumsum(_EAST_NORTH_WEST_SOUTH[quarter[:-1]], axis=0) * options.step
    theta = se2.wrap(quarter * (np.pi / 2))
    return np.concatenate((position, theta[:, None]), axis=1)


def _near_pairs(positions: Array, count: int, step: float, rng: np.random.Generator) -> Indices:
    """Return `count` random pairs i, j > i + 1 of positions near each other, (count, 2)."""
    if not count:
        return np.zeros((0, 2), np.int64)
    # Many positions are the same, on which a balanced tree would spend its time.
    tree = cKDTree(positions, balanced_tree=False)
    radius = _FIRST_RADIUS * step
    chain = len(positions) - 1
    itself = len(positions)
    while (tree.count_neighbors(tree, radius) - itself) // 2 - chain < count:
        radius *= _RADIUS_GROWTH
    pairs: Indices = tree.query_pairs(radius, output_type='ndarray')
    pairs = pairs[pairs[:, 1] > pairs[:, 0] + 1]
    return pairs[rng.choice(len(pairs), count, replace=False)]


def _measured(
    manifold: Manifold, truth: Array, i: Indices, j: Indices, is_loop: Indices,
    options: WorldOptions, rng: np.random.Generator,
) -> FactorGraph:
    """Return the graph of noisy measurements; is_loop : (m,) 0 for odometry, 1 for a loop."""
    sigma = np.stack((
        sigmas(manifold, options.odometry_sigma_translation, options.odometry_sigma_rotation),
        sigmas(manifold, options.loop_sigma_translation, options.loop_sigma_rotation)))
    noise = sigma[is_loop] * rng.standard_normal((len(i), manifold.TANGENT_SIZE))
    graph = FactorGraph(manifold, len(truth))
    graph.add_between(i, j, manifold.retract(manifold.between(truth[i], truth[j]), noise),
                      (sigma[:, :, None] ** -2 * np.eye(manifold.TANGENT_SIZE))[is_loop])
    return graph
