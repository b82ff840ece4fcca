# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A simulated team of the size of COSMO-Bench's ntu_r5_00: how near the map is to the best one.

    python benchmarks/fleet/teams.py [--worlds streets,building] [--kinds random,grouped]
        [--seeds 3]

Five robots drive 8.94 km together and close 2,019 loops, 868 of them between robots; false are
3.6% of those within a robot and 2.9% of those between. Each team goes through a JRL file, with its
truth and flags. Printed is the position error (RMSE after alignment) of `l1slam solve` over that
of the L1 map without the false loops, the false ones that are kept, the true ones that are left
out, and in how many parts the map is.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.batch_map import SolveOptions, solve
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.graphs.robots import keyframes_of
from l1slam_ros.io.jrl.reading import read_jrl_file
from l1slam_ros.io.jrl.writing import write_jrl_file

ROBOTS = 5
POSES = 4470
STEP = 2.0
# Within a robot and between robots: loops, and how many of them are false.
LOOPS, FALSE = (1151, 868), (41, 25)
# So many times as many are drawn, of which some are chosen: true ones, and false ones, of which
# few are within a robot.
_DRAWN, _FALSE_DRAWN = 8, 40


def team(name: str, kind: str, seed: int, loops: tuple[int, int] = LOOPS,
         false: tuple[int, int] = FALSE,
         poses: int = POSES) -> tuple[GraphRecord, np.ndarray, np.ndarray]:
    """Return the graph of a team, which factors are false (m,), and the true poses (n, p)."""
    rng = np.random.default_rng(seed)
    world = simulate_world(poses, poses - 1 + _DRAWN * sum(loops), WorldOptions(step=STEP), rng,
                           name)
    robot = np.arange(poses) * ROBOTS // poses
    first = np.searchsorted(robot, np.arange(ROBOTS))
    ids = ((robot + ord('a')) << 56) + np.arange(poses) - first[robot]
    graph = world.graph
    steps = np.flatnonzero(graph.between.is_odometry)
    steps = steps[same_robot(graph, steps, robot)]
    true = _chosen(graph, np.flatnonzero(~graph.between.is_odometry), robot,
                   (loops[0] - false[0], loops[1] - false[1]), rng)
    lies = FALSE_LOOPS[kind](graph, world.truth, _FALSE_DRAWN * sum(false), rng)
    lying = graph.without_factors()
    lying.add_between(lies.i, lies.j, lies.measurement, lies.information)
    wrong = _chosen(lying, np.arange(len(lies.i)), robot, false, rng)
    of_team, factors = keyframes_of(ids, graph.manifold), (graph.between, lying.between)
    for source, rows in ((factors[0], np.concatenate((steps, true))), (factors[1], wrong)):
        of_team.append_between(source.i[rows], source.j[rows], source.measurement[rows],
                               source.sqrt_information[rows])
    is_false = np.arange(len(of_team.between)) >= len(steps) + len(true)
    # The time that all of them drive at once.
    record = GraphRecord(of_team, None, ids, (np.arange(poses) - first[robot] + 1) * 10**9)
    return record, is_false, world.truth


def same_robot(graph: FactorGraph, rows: Indices, robot: Indices) -> np.ndarray:
    """Tell of which factors both ends are of one robot."""
    i, j = graph.between.pairs[rows].T
    return np.asarray(robot[i] == robot[j])


def _chosen(graph: FactorGraph, rows: Indices, robot: Indices, counts: tuple[int, int],
            rng: np.random.Generator) -> Indices:
    """Return so many of the factors within a robot, and so many between; runs stay together."""
    within = same_robot(graph, rows, robot)
    parts = []
    for of, count in ((rows[within], counts[0]), (rows[~within], counts[1])):
        parts.append(rng.choice(of, min(count, len(of)), replace=False))
    return np.sort(np.concatenate(parts))


def line(name: str, kind: str, seed: int) -> str:
    """Return the line of the table of one team."""
    record, is_false, truth = team(name, kind, seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'team.jrl'
        write_jrl_file(path, record, truth)
        read = read_jrl_file(path)
        # As the data sets say it: it is the file that knows which are false.
        lies = {tuple(pair) for pair in record.ids[record.graph.between.pairs[is_false]].tolist()}
        pairs = read.ids[read.graph.between.pairs].tolist()
        false = np.array([tuple(pair) in lies for pair in pairs])
        false &= ~read.graph.between.is_odometry
        write_jrl_file(path, replace(read, log=replace(read.log, false=false)))
        read = read_jrl_file(path)
    graph = read.graph
    false = read.log.known_false
    positions = read.graph.manifold.positions
    outcome = solve(graph, None, SolveOptions())
    best = solve(graph.subset(~false), None, SolveOptions(robust=False))
    ours, known = (absolute_trajectory_error(positions(of.solution.poses),
                                             positions(read.log.true_poses))
                   for of in (outcome, best))
    kept = outcome.judgement.accepted if outcome.judgement else np.ones(len(false), bool)
    loops = ~graph.between.is_odometry
    doubts = ', '.join(doubt.kind for doubt in outcome.judgement.doubts) if (
        outcome.judgement) else outcome.unjudged
    return (f'| {name} | {kind} | {seed} | {known:.3f} | {ours:.3f} | {ours / known:.3f} | '
            f'{int((kept & false).sum())} of {int(false.sum())} | '
            f'{int((~kept & ~false & loops).sum())} of {int((loops & ~false).sum()):,} | '
            f'{outcome.parts} | {outcome.seconds:.0f} | {doubts or "none"} |')


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--worlds', default='streets,building')
    parser.add_argument('--kinds', default='random,grouped')
    parser.add_argument('--seeds', type=int, default=3)
    arguments = parser.parse_args()
    print('| world | kind | seed | error, lies known [m] | error [m] | ratio | false kept | '
          'true left out | parts | seconds | doubts |\n' + '|---' * 11 + '|', flush=True)
    for name in arguments.worlds.split(','):
        for kind in arguments.kinds.split(','):
            for seed in range(arguments.seeds):
                print(line(name, kind, seed), flush=True)


if __name__ == '__main__':
    main()
