# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What judging costs: processor time of a robust solve over that of a plain one without the lies.

    python benchmarks/robust/cost.py --datasets DIR [--seeds N] [--growth N,...]

Half of all loops are random lies. `manhattan3500 + .1 rad` is Manhattan whose every measured
heading is off by .1 rad more, as M3500a of the literature is: odometry and loops say far less than
they state, so that few loops come in at a time. The least of three runs counts. With `--growth`
worlds of so many keyframes and twice as many factors are drawn in place of these, and the last
line is the power of the keyframes that the time of judging grows by.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

# As a program of its own it finds its neighbours.
sys.path.insert(0, str(Path(__file__).parents[1]))

from measuring import clock
from robust.kinds import CITY, MANHATTAN, SPHERE
from robust.places import place

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.robust.batch_map import SolveOptions, solve
from l1slam_ros.core.worlds.false_loops import insert_loops, random_false_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

_NOISE, _RUNS = 0.1, 3


def with_lies(graph: FactorGraph, poses: Array, seed: int) -> FactorGraph:
    """Return a graph with as many random lies as it has loops; poses (n, p) : where it is."""
    count = int(np.count_nonzero(~graph.between.is_odometry))
    return insert_loops(graph, random_false_loops(graph, poses, count,
                                                  np.random.default_rng((seed, 50))))


def noisier(graph: FactorGraph, seed: int) -> FactorGraph:
    """Return a graph in the plane with noise of .1 rad on the headings that it measured."""
    other = graph.subset(np.arange(len(graph.between)))
    step = np.zeros((len(other.between), 3))
    step[:, 2] = _NOISE * np.random.default_rng(1000 + seed).standard_normal(len(step))
    other.between.measurement[:] = se2.retract(other.between.measurement, step)
    return other


def least(work: Callable[[], object]) -> float:
    """Return the least processor time of some runs [s]."""
    seconds = []
    for _ in range(_RUNS):
        began = clock()
        work()
        seconds.append(clock() - began)
    return min(seconds)


def graphs(datasets: Path, seeds: int) -> Iterator[tuple[str, FactorGraph, Array]]:
    """Yield the name of a graph, itself and where it is, (n, p)."""
    for name in (MANHATTAN, CITY, SPHERE):
        found = place(datasets, name)
        yield name, found.graph, found.best
        if name == MANHATTAN:
            for seed in range(seeds):
                yield f'{name} + .1 rad, {seed}', noisier(found.graph, seed), found.best


def worlds(sizes: list[int]) -> Iterator[tuple[str, FactorGraph, Array]]:
    """Yield the same of drawn worlds."""
    for size in sizes:
        world = simulate_world(size, 2 * size, WorldOptions(), np.random.default_rng(1))
        yield f'{size} keyframes', world.graph, world.truth


def judging(name: str, graph: FactorGraph, poses: Array) -> float:
    """Print the row of a graph; return the time that judging it with lies takes [s]."""
    lied, rounds = with_lies(graph, poses, 0), [0]

    def count(number: int, accepted: int) -> None:
        rounds[0] = number

    seconds = least(lambda: robust_solve(lied, count))
    plain = least(lambda: solve(graph, None, SolveOptions(robust=False)))
    robust = least(lambda: solve(lied, None, SolveOptions(robust=True)))
    print(f'{name}: plain {plain:.2f} s, judging {seconds:.2f} s in {rounds[0]} rounds, '
          f'robust {robust:.2f} s, {robust / plain:.1f} times', flush=True)
    return seconds


def main() -> None:
    """Print a row for each graph."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--datasets', type=Path, required=True)
    parser.add_argument('--seeds', type=int, default=3)
    parser.add_argument('--growth', type=lambda text: [int(size) for size in text.split(',')])
    asked = parser.parse_args()
    rows = [(graph.n_poses, judging(name, graph, poses)) for name, graph, poses in (
        worlds(asked.growth) if asked.growth else graphs(asked.datasets, asked.seeds))]
    if asked.growth:
        print(f'judging grows as n^{np.polyfit(*np.log(rows).T, 1)[0]:.2f}')


if __name__ == '__main__':
    main()
