# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Which norm makes the better map: paired draws of the noise, errors over those of least squares.

    python benchmarks/norms.py GRAPH TRUTH [--seeds 42] [--noises contaminated]

GRAPH and TRUTH (lines of id x y theta) are Manhattan's, say. Every draw measures the pairs of the
graph anew in the truth, with noise as large as that of the file is at its L2 map: normal; of
Student's t with 3 degrees of freedom; normal with one loop in twenty six times as noisy. Printed
is the geometric mean over the draws of the position error (RMSE after alignment) over that of L2,
its standard error, and in how many draws it is the smaller one. Two names: the norm of the
odometry, and that of the loops.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.names import SAME
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, gauss_newton
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import Huber
from l1slam_ros.core.solvers.solve import choose, minimise_by
from l1slam_ros.io.graphs.graph_file import read_graph_file

# Of the odometry, and of loops.
NORMS = (('l1', SAME), ('group-l1', SAME), ('l2', 'group-l1'), ('l2', 'l1'), ('huber', SAME))
_OUTLIERS = 0.05
_TIMES = 6.0
_FREEDOM = 3


def normal(graph: FactorGraph, rng: np.random.Generator) -> Array:
    """Return whitened noise, (m, k)."""
    return rng.standard_normal((len(graph.between), graph.manifold.TANGENT_SIZE))


def student(graph: FactorGraph, rng: np.random.Generator) -> Array:
    """Return noise with heavy tails."""
    return rng.standard_t(_FREEDOM, (len(graph.between), graph.manifold.TANGENT_SIZE))


def contaminated(graph: FactorGraph, rng: np.random.Generator) -> Array:
    """Return normal noise, of a few loops many times as much."""
    noisy = (rng.random(len(graph.between)) < _OUTLIERS) & ~graph.between.is_odometry
    return normal(graph, rng) * np.where(noisy, _TIMES, 1.0)[:, None]


NOISES: dict[str, Callable[[FactorGraph, np.random.Generator], Array]] = {
    'normal': normal, "Student's t": student, 'contaminated': contaminated}


def as_noisy_as_it_is(graph: FactorGraph, poses: Array) -> FactorGraph:
    """Return the graph with its information scaled by what its L2 map, near poses, says."""
    poses = gauss_newton(graph, poses, Huber(), LeastSquaresOptions(), cholesky_of(graph)).poses
    rows = whitened_residual(graph, poses)
    spare = len(rows) - graph.manifold.TANGENT_SIZE * (graph.n_poses - 1)
    return graph.subset(np.arange(len(graph.between)),
                        np.full(len(graph.between), (rows**2).sum() / spare))


def measured(graph: FactorGraph, truth: Array, noise: Array) -> FactorGraph:
    """Return the graph as it would be measured in the truth (n, p) with noise (m, k)."""
    factors, new = graph.between, FactorGraph(graph.manifold)
    steps = np.linalg.solve(factors.sqrt_information, noise[:, :, None])[:, :, 0]
    new.add_poses(graph.n_poses)
    new.append_between(factors.i, factors.j, graph.manifold.retract(graph.manifold.between(
        truth[factors.i], truth[factors.j]), steps), factors.sqrt_information)
    return new


def errors(graph: FactorGraph, truth: Array) -> Array:
    """Return the position error [m] of L2 and of each of `NORMS`."""
    manifold, cholesky = graph.manifold, cholesky_of(graph)
    l2 = gauss_newton(graph, truth, Huber(), LeastSquaresOptions(), cholesky).poses
    maps = [l2]
    for names in NORMS:
        method = choose('auto', graph, *names)
        maps.append(minimise_by(method, graph, l2, OptimiserOptions())[0].poses)
    return np.array([absolute_trajectory_error(manifold.positions(poses), manifold.positions(
        truth)) for poses in maps])


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('graph', type=Path)
    parser.add_argument('truth', type=Path)
    parser.add_argument('--seeds', type=int, default=42)
    parser.add_argument('--noises', nargs='+', choices=NOISES, default=NOISES, metavar='NAME')
    given = parser.parse_args()
    graph, truth = read_graph_file(given.graph).graph, np.loadtxt(given.truth)[:, 1:]
    graph = as_noisy_as_it_is(graph, truth)
    print('| error over that of L2 | L2 [m] |', ' | '.join(
        a if b == SAME else f'{a} / {b}' for a, b in NORMS), '|')
    print('|---' * (len(NORMS) + 2) + '|')
    for name in given.noises:
        found = np.array([errors(measured(graph, truth, NOISES[name](graph, rng)), truth)
                          for rng in map(np.random.default_rng, range(given.seeds))])
        ratio = np.log(found[:, 1:] / found[:, :1])
        mean, spread = np.exp(ratio.mean(axis=0)), ratio.std(axis=0) / np.sqrt(len(ratio))
        cells = [f'{a:.2f} ± {a * b:.2f} ({c}/{len(ratio)})' for a, b, c in zip(
            mean, spread, (ratio < 0).sum(axis=0), strict=True)]
        print(f'| {name} | {np.median(found[:, 0]):.2f} |', ' | '.join(cells), '|', flush=True)


if __name__ == '__main__':
    main()
