# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
One graph cut into robots: whether the same loops are believed as in one piece.

    python benchmarks/fleet/cut.py --datasets DIR [--graphs manhattan3500,city10000,building]
        [--robots 2,5,20] [--lies 0.3]

To the graph false loops of the kind `random` are added, so many for each loop. Its keyframes then
go in equal pieces to so many robots, each with a letter in its vertex ids, as a g2o file: the
edges are the same, but at a cut there is no odometry. Printed is for how many loops the verdict is
another one, and how far the L1 optimum of the loops that the cut graph accepts is from that of the
same loops in the graph in one piece.
"""

import argparse
import string
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.batch_map import Outcome, SolveOptions, solve
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS, insert_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file, write_graph_file

BUILDING = 'building'
_POSES, _EDGES = 4000, 8000
_BELIEVING = SolveOptions(robust=False)


def with_lies(record: GraphRecord, lies: float, seed: int = 0) -> GraphRecord:
    """Return a graph with so many random false loops for each of its loops."""
    graph = record.graph
    loops = ~graph.between.is_odometry & ~graph.between.is_absolute
    poses = solve(graph, record.poses, SolveOptions(norm='l2', robust=False)).solution.poses
    false = FALSE_LOOPS['random'](graph, poses, round(lies * int(loops.sum())),
                                  np.random.default_rng(seed))
    return replace(record, graph=insert_loops(graph, false), ids=np.arange(graph.n_poses),
                   poses=None, stamps=None, left_out=None, comments=())


def cut(record: GraphRecord, robots: int) -> GraphRecord:
    """Return what is read from the file of a graph whose keyframes go to some robots."""
    n = record.graph.n_poses
    piece = np.arange(n) * robots // n
    first = np.searchsorted(piece, np.arange(robots))
    letters = np.array([ord(letter) for letter in string.ascii_lowercase[:robots]])
    ids = (letters[piece] << 56) + np.arange(n) - first[piece]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'cut.g2o'
        write_graph_file(path, replace(record, ids=ids))
        return read_graph_file(path)


def accepted(outcome: Outcome, graph: FactorGraph) -> np.ndarray:
    """Return which factors are believed, (m,) bool."""
    if outcome.judgement is None:
        return np.ones(len(graph.between), bool)
    return np.asarray(outcome.judgement.accepted)


def row(name: str, whole: GraphRecord, outcome: Outcome, robots: int) -> str:
    """Return the line of the table of one graph and number of robots."""
    pieces = cut(whole, robots)
    of_pieces = solve(pieces.graph, None, SolveOptions())
    mine, theirs = accepted(of_pieces, pieces.graph), accepted(outcome, whole.graph)
    loops = ~whole.graph.between.is_odometry
    there = solve(whole.graph.subset(mine), None, _BELIEVING).solution.cost
    here = solve(pieces.graph.subset(mine), None, _BELIEVING).solution.cost
    others = int((mine != theirs).sum())
    return (f'| {name} | {robots} | {int(loops.sum()):,} | {int((~theirs).sum()):,} | '
            f'{int((~mine).sum()):,} | {others:,} ({others / loops.sum():.2%}) | '
            f'{abs(here / there - 1):.1e} | {of_pieces.parts} | {of_pieces.unjudged or "yes"} |')


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--datasets', type=Path, required=True)
    parser.add_argument('--graphs', default=f'manhattan3500,city10000,{BUILDING}')
    parser.add_argument('--robots', default='2,5,20')
    parser.add_argument('--lies', type=float, default=0.3)
    arguments = parser.parse_args()
    print('| graph | robots | loops | refused in one piece | refused | other verdict | cost off | '
          'parts | judged |\n|---|---|---|---|---|---|---|---|---|', flush=True)
    for name in arguments.graphs.split(','):
        if name == BUILDING:
            world = simulate_world(_POSES, _EDGES, WorldOptions(), np.random.default_rng(0), name)
            record = GraphRecord(world.graph, world.odometry, np.arange(_POSES))
        else:
            record = read_graph_file(arguments.datasets / f'{name}.g2o')
        whole = with_lies(record, arguments.lies)
        outcome = solve(whole.graph, None, SolveOptions())
        for robots in map(int, arguments.robots.split(',')):
            print(row(name, whole, outcome, robots), flush=True)


if __name__ == '__main__':
    main()
