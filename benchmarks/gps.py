# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A map that only GPS holds together: how far it is off, and which positions it refuses.

    python benchmarks/gps.py GRAPH TRUTH [--every 100] [--sigma 1] [--false .1] [--seeds 5]

Of GRAPH (g2o, in the plane) the odometry is taken, without its loops, and for every so many
keyframes one position without a heading, drawn about TRUTH (`id x y theta`) in a map frame that is
far off and turned; some are wrong by 50 m. Said are errors to the truth, RMSE of positions [m],
nothing aligned: of ours in L1 and in L2, and of least squares that is told what no back end knows,
the false ones and how noisy the odometry truly is. Below that nobody gets but by chance.
"""

import argparse
from pathlib import Path

import numpy as np

import l1slam_ros as l1
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import WORLD

_FRAME = np.array([100.0, -40.0, 2.0])  # the first keyframe in the map frame
_OFF = 50.0  # [m]


def seen_from_above(
    graph: l1.FactorGraph, truth: Array, every: int, sigma: float, share: float,
    rng: np.random.Generator,
) -> tuple[l1.FactorGraph, Indices]:
    """Return the odometry of a graph with positions of keyframes, and which rows are false."""
    graph = graph.subset(graph.between.is_odometry)
    k = np.arange(0, graph.n_poses, every)
    positions = truth[k] * [1, 1, 0] + np.pad(sigma * rng.standard_normal((len(k), 2)),
                                              ((0, 0), (0, 1)))
    bad = np.sort(rng.permutation(len(k))[: round(share * len(k))])
    angle = rng.uniform(0, 2 * np.pi, len(bad))
    positions[bad, :2] += _OFF * np.stack((np.cos(angle), np.sin(angle)), axis=1)
    information = np.tile(np.diag([sigma**-2, sigma**-2, 0.0]), (len(k), 1, 1))
    graph.add_between(np.full(len(k), WORLD), k, positions, information)
    return graph, bad + len(graph.between) - len(k)


def told_everything(graph: l1.FactorGraph, truth: Array, false: Indices) -> Array:
    """Return the least squares map (n, 3) of what is true, the odometry as noisy as it is."""
    true = graph.subset(np.setdiff1d(np.arange(len(graph.between)), false))
    between = true.between
    steps = ~between.is_absolute
    i = between.i[steps]
    j = between.j[steps]
    Z = between.measurement[steps]
    error = se2.local(se2.between(truth[i], truth[j]), Z)
    told = l1.FactorGraph(se2)
    told.add_poses(graph.n_poses)
    told.add_between(i, j, Z, np.tile(np.linalg.inv(error.T @ error / len(error)), (len(i), 1, 1)))
    told.append_between(between.i[~steps], between.j[~steps], between.measurement[~steps],
                        between.sqrt_information[~steps])
    poses: Array = l1.solve(told, norm='l2', robust=False).poses
    return poses


def main() -> None:
    """Print a line for each seed."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('graph', type=Path)
    parser.add_argument('truth', type=Path)
    parser.add_argument('--every', type=int, default=100, help='keyframes from fix to fix')
    parser.add_argument('--sigma', type=float, default=1.0, help='of x and of y [m]')
    parser.add_argument('--false', type=float, default=0.1, help='part of the fixes, 50 m off')
    parser.add_argument('--seeds', type=int, default=5)
    arguments = parser.parse_args()
    recorded, _ = l1.read_graph(arguments.graph)
    truth = np.loadtxt(arguments.truth)[:, 1:]
    truth = se2.compose(np.broadcast_to(_FRAME, truth.shape), truth)
    print('seed   L1 [m]  L2 [m]  told everything [m]   false: named, not named; true: refused')
    for seed in range(arguments.seeds):
        graph, false = seen_from_above(recorded, truth, arguments.every, arguments.sigma,
                                       arguments.false, np.random.default_rng(seed))
        maps = [l1.solve(graph), l1.solve(graph, norm='l2')]
        refused = np.flatnonzero(~maps[0].inliers)
        errors = [np.sqrt(((poses - truth)[:, :2] ** 2).sum(axis=1).mean())
                  for poses in (*(one.poses for one in maps),
                                told_everything(graph, truth, false))]
        print(f'{seed:4d}   {errors[0]:6.2f}  {errors[1]:6.2f}  {errors[2]:18.2f}   '
              f'{np.isin(false, refused).sum()}, {(~np.isin(false, refused)).sum()}; '
              f'{(~np.isin(refused, false)).sum()}')


if __name__ == '__main__':
    main()
