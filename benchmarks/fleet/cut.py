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
        [--robots 2,5,20] [--lies 0.3] [--dropped 0.5] [--late 5]

With `--dropped`, this share of the graph's loops is left out first. False loops of the kind
`random` are added, so many for each loop. The keyframes then go in equal pieces to so many robots,
each with a letter in its vertex ids, as a g2o file: the edges are the same, but at a cut there is
no odometry. Printed is for how many loops the verdict is another one, and how far the L1 optimum
of the loops that the cut graph accepts is from that of the same loops in the graph in one piece.

With `--late` the pieces are driven as well, as messages to a running back end, a keyframe of each
robot a second, each robot late by a number of seconds up to this; the last column is for how many
loops the verdict is another one than in one piece, once nothing is left to do.
"""

import argparse
import string
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.l1_problem import GraphProblem
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.graph.recording import recorded
from l1slam_ros.core.robust.batch_map import Outcome, SolveOptions, solve
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.core.running.snapshot import ACCEPTED
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.interior_point import interior_point
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS, insert_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file, write_graph_file

BUILDING = 'building'
_POSES, _EDGES = 4000, 8000
_BELIEVING = SolveOptions(robust=False)
_SECOND = 10**9
# Of the L1 optimum, and the most steps to it.
_TOLERANCE, _STEPS = 1e-7, 200
_EVERY = BackendOptions.from_mapping({
    'keyframe': {'translation': 0.0, 'rotation': 0.0}, 'on_time_jump': 'ignore',
    'odometry': {'covariance_source': 'increment'}, 'loop': {'wait': 1e6}})


def with_lies(record: GraphRecord, lies: float, dropped: float = 0.0,
              seed: int = 0) -> GraphRecord:
    """Return a graph without some of its loops, and so many random false ones for each other."""
    whole = record.graph
    kept = np.random.default_rng(seed + 1).random(len(whole.between)) >= dropped
    graph = whole.subset(kept | whole.between.is_odometry)
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


def optimum(graph: FactorGraph) -> float:
    """
    Return the L1 cost of a graph that is connected, solved from its own start.

    `solve` is done where it is within 2e-5 of the optimum, which would hide what is looked for: it
    is gone on from there.
    """
    rough = solve(graph, None, _BELIEVING).solution.poses
    return interior_point(GraphProblem(graph), rough, cholesky_of(graph), _STEPS,
                          _TOLERANCE).costs[-1]


def stamped(pieces: FactorGraph) -> tuple[np.ndarray, np.ndarray]:
    """Return the robot of each keyframe, from 0, and its stamp; no two have the same."""
    _, robot = np.unique(pieces.robot, return_inverse=True)
    second = np.arange(len(robot)) - np.searchsorted(robot, np.arange(robot[-1] + 1))[robot] + 1
    return robot, second * _SECOND + robot


def messages(pieces: FactorGraph, late: float
             ) -> Iterator[tuple[int, OdometrySample | LoopClosure]]:
    """Yield robot and message as they come, each robot late by up to so much [s]."""
    robot, stamps = stamped(pieces)
    delay = np.random.default_rng(0).uniform(0, late, robot[-1] + 1)
    events: list[tuple[float, int, OdometrySample | LoopClosure]] = []
    for k, (sample, loops) in enumerate(recorded(pieces, stamps.tolist())):
        own = int(robot[k])
        events.append((sample.stamp / _SECOND + delay[own], own, sample))
        for loop in loops:
            one, other = ((stamp, stamp % _SECOND) for stamp in loop.stamps)
            comes = max(stamp / _SECOND + delay[whose] for stamp, whose in (one, other))
            events.append((comes, own, replace(loop, robot=own, reference_robot=one[1])))
    yield from (event[1:] for event in sorted(events, key=lambda event: event[0]))


def other_verdicts(pieces: FactorGraph, believed: np.ndarray, late: float) -> int:
    """Return for how many loops a running back end has another verdict, believed : (m,) bool."""
    with Backend(_EVERY, 2 if pieces.manifold is se2 else 3) as backend:
        for robot, message in messages(pieces, late):
            if isinstance(message, LoopClosure):
                backend.add_loop(message)
            else:
                backend.add_odometry(message, robot)
                backend.update(0.0)
        backend.settle()
        states = backend.loop_states()
    rows = believed & ~pieces.between.is_odometry
    here, there = (Counter(map(tuple, np.sort(pairs, axis=1).tolist())) for pairs in (
        states.stamps[states.state == ACCEPTED], stamped(pieces)[1][pieces.between.pairs[rows]]))
    return ((here - there) + (there - here)).total()


def row(name: str, whole: GraphRecord, outcome: Outcome, robots: int,
        late: float | None = None) -> str:
    """Return the line of the table of one graph and number of robots."""
    pieces = cut(whole, robots)
    of_pieces = solve(pieces.graph, None, SolveOptions())
    mine, theirs = accepted(of_pieces, pieces.graph), accepted(outcome, whole.graph)
    loops = ~whole.graph.between.is_odometry
    there, here = optimum(whole.graph.subset(mine)), optimum(pieces.graph.subset(mine))
    others, live = int((mine != theirs).sum()), ''
    if late is not None:
        driven = other_verdicts(pieces.graph, theirs, late)
        live = f' {driven:,} ({driven / loops.sum():.2%}) |'
    return (f'| {name} | {robots} | {int(loops.sum()):,} | {int((~theirs).sum()):,} | '
            f'{int((~mine).sum()):,} | {others:,} ({others / loops.sum():.2%}) | '
            f'{abs(here / there - 1):.1e} | {of_pieces.parts} | {of_pieces.unjudged or "yes"} |'
            f'{live}')


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--datasets', type=Path, required=True)
    parser.add_argument('--graphs', default=f'manhattan3500,city10000,{BUILDING}')
    parser.add_argument('--robots', default='2,5,20')
    parser.add_argument('--lies', type=float, default=0.3)
    parser.add_argument('--dropped', type=float, default=0.0)
    parser.add_argument('--late', type=float, help='drive them, so late at most [s]')
    arguments = parser.parse_args()
    names = ['graph', 'robots', 'loops', 'refused in one piece', 'refused', 'other verdict',
             'cost off', 'parts', 'judged', *(['driven'] if arguments.late is not None else [])]
    print(f'| {" | ".join(names)} |\n{"|---" * len(names)}|', flush=True)
    for name in arguments.graphs.split(','):
        if name == BUILDING:
            world = simulate_world(_POSES, _EDGES, WorldOptions(), np.random.default_rng(0), name)
            record = GraphRecord(world.graph, world.odometry, np.arange(_POSES))
        else:
            record = read_graph_file(arguments.datasets / f'{name}.g2o')
        whole = with_lies(record, arguments.lies, arguments.dropped)
        outcome = solve(whole.graph, None, SolveOptions())
        for robots in map(int, arguments.robots.split(',')):
            print(row(name, whole, outcome, robots, arguments.late), flush=True)


if __name__ == '__main__':
    main()
