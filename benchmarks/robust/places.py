# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Graphs as they are found: public ones, recorded ones, and two of our making.

In: a folder of datasets, a name. Out: `Place`, a graph, what is known of its truth, and which of
its own loops lie.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from robust.kinds import BICOCCA, BOVISA, RING, TORUS, WORLD
from scipy.spatial import cKDTree

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error, align, poses_at
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import read_graph_file, read_vertices
from l1slam_ros.io.trajectory import read_reference

# [m] A recorded loop lies when its ends are by more farther from each other, or nearer, than it
# says.
_LIE = 3.0
# [ns] Between true poses further apart none is known: of a map's error as `l1slam --reference` has
# it, and with 3 m to go by, of what lies.
_SECOND = 10**9
_LONGEST, _LONGEST_OF_LOOPS = _SECOND, 2 * _SECOND
_FILES = {BICOCCA: 'real/bicocca25b_0.150.g2o', BOVISA: 'real/bovisa06.g2o',
          'fr079': 'real/fr079.graph', 'kitti_00': 'real/kitti_00.g2o', TORUS: 'real/torus3D.g2o'}

Error = Callable[[Array], float]


@dataclass(frozen=True)
class Place:
    """
    A graph before anything is made wrong in it.

    stored : (n, p) poses of its file, None without; is_false, is_true : (m,) bool, of its own
    loops, neither where nobody knows; truth_error : [m] of positions (n, k), None where nobody
    knows the truth; timed : it is by time, so it has a meaning for the first part of a way, too;
    unit : [m] of a length of one.
    """

    name: str
    graph: FactorGraph
    stored: Array | None
    is_false: Mask
    is_true: Mask
    truth_error: Error | None = None
    timed: bool = True
    unit: float = 1.0

    @cached_property
    def best(self) -> Array:
        """Its L2 map (n, p), of all loops that are not known to lie."""
        graph = self.graph.subset(~self.is_false)
        cholesky = cholesky_of(graph)
        return minimise_l2(graph, seed_poses(graph, cholesky), LeastSquaresOptions(),
                           cholesky).poses


def place(datasets: Path, name: str) -> Place:
    """Return a place by its name, of `kinds.GRAPHS`."""
    if name in _MADE:
        return _MADE[name]()
    record = read_graph_file(graph_file(datasets, name))
    found = place_of(name, record.graph, record.poses)
    if name == BICOCCA:
        return _bicocca(datasets / 'real', found)
    if name == BOVISA:
        unknown = np.zeros(len(record.graph.between), bool)
        track = read_vertices(datasets / 'real' / 'bovisa06.gps.g2o', se2)[1][:, :2]
        return Place(name, record.graph, record.poses, unknown, unknown, nearest_error(track),
                     timed=False)
    truth = datasets / f'{name}.truth.txt'
    if not truth.exists():
        return found
    return place_of(name, record.graph, record.poses,
                    error_by_time(np.loadtxt(truth)[:, 1:3]))


def graph_file(datasets: Path, name: str) -> Path:
    """Return where its graph is, for those that are not made."""
    return datasets / _FILES.get(name, f'{name}.g2o')


def place_of(name: str, graph: FactorGraph, stored: Array | None,
             truth_error: Error | None = None) -> Place:
    """Return a place whose loops are all true."""
    is_loop = ~graph.between.is_odometry
    return Place(name, graph, stored, np.zeros(len(is_loop), bool), is_loop, truth_error)


def _bicocca(folder: Path, found: Place) -> Place:
    """Add the truth by its stamps: the poses between its known ones, and which loops lie."""
    stamps = (np.loadtxt(folder / 'bicocca25b.stamps.txt') * _SECOND).astype(np.int64)
    truth = read_reference(folder / 'bicocca25b.truth.csv')

    def positions(longest: int) -> Array:
        rows, poses = poses_at(se2, truth.keys, truth.poses, stamps, longest, 0)
        known = np.full((found.graph.n_poses, 2), np.nan)
        known[rows] = se2.positions(poses)
        return known

    factors, at = found.graph.between, positions(_LONGEST_OF_LOOPS)
    true_distance = np.linalg.norm(at[factors.i] - at[factors.j], axis=1)
    off = np.abs(true_distance - np.linalg.norm(factors.measurement[:, :2], axis=1))
    is_loop = ~factors.is_odometry
    # Not a number, where an end has no truth, is neither.
    return Place(found.name, found.graph, found.stored, is_loop & (off > _LIE),
                 is_loop & (off <= _LIE), error_by_time(positions(_LONGEST)))


def error_by_time(truth: Array) -> Error:
    """
    Return the error of positions (k, 2), k <= n, to the truth (n, 2) [m].

    NaN, in either, where they are not known.
    """

    def error(estimate: Array) -> float:
        known = np.isfinite(truth[: len(estimate), 0]) & np.isfinite(estimate[:, 0])
        if not known.any():
            return 0.0
        return absolute_trajectory_error(estimate[known], truth[: len(estimate)][known])

    return error


def nearest_error(track: Array) -> Error:
    """
    Return the error of positions to a track (t, 2) [m] without times.

    The RMSE of the distance from the track to the nearest position, after the rigid motion that
    iterated closest points find from the best of 36 headings about the centre.
    """

    def error(estimate: Array) -> float:
        estimate = estimate[np.isfinite(estimate[:, 0])]
        return min(_closest(estimate, track, heading)
                   for heading in np.linspace(0, 2 * np.pi, 36, endpoint=False))

    return error


def _closest(estimate: Array, track: Array, heading: float, rounds: int = 40) -> float:
    cos, sin = np.cos(heading), np.sin(heading)
    moved = (estimate - estimate.mean(axis=0)) @ np.array([[cos, sin], [-sin, cos]])
    moved += track.mean(axis=0)
    for _ in range(rounds):
        _, nearest = cKDTree(moved).query(track)
        R, t = align(moved[nearest], track)
        moved = moved @ R.T + t
    distance, _ = cKDTree(moved).query(track)
    return float(np.sqrt(np.mean(distance**2)))


def _ring() -> Place:
    """
    Return a lap of 600 keyframes, closed by 20 loops at the place where it began.

    By this draw odometry is three sigmas off there, as one lap in a hundred is.
    """
    n, loops = 600, 20
    angle = 2 * np.pi * np.arange(n + loops) / n
    truth = np.stack((np.cos(angle), np.sin(angle), angle), axis=1) * [n / 6.3, n / 6.3, 1.0]
    back, rng = np.arange(loops), np.random.default_rng(1)
    sigma = np.broadcast_to([0.05, 0.05, 0.005], (n + 2 * loops - 1, 3))
    return place_of(RING, measured(truth, back, back + n, sigma,
                                   sigma * rng.standard_normal(sigma.shape)), None)


def measured(truth: Array, i: Indices, j: Indices, sigma: Array, noise: Array) -> FactorGraph:
    """
    Return the graph of a way, poses (n, 3), with loops from keyframes i to j, (l,).

    sigma, noise : (n - 1 + l, 3) what each step, then each loop, states, and how far off it is
    """
    k = np.arange(len(truth) - 1)
    i, j = np.concatenate((k, i)), np.concatenate((k + 1, j))
    graph = FactorGraph(se2, len(truth))
    graph.add_between(i, j, se2.retract(se2.between(truth[i], truth[j]), noise),
                      np.eye(3) / sigma[:, :, None]**2)
    return graph


def _world() -> Place:
    """Return a world of 500 keyframes in streets, with 109 loops."""
    world = simulate_world(500, 499 + 109, WorldOptions(), np.random.default_rng(0))
    return place_of(WORLD, world.graph, odometry_poses(world.graph))


_MADE = {RING: _ring, WORLD: _world}
