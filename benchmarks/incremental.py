# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What an update costs while the map grows, and how good the map is, beside gtsam's ISAM2.

    python benchmarks/incremental.py --datasets DIR [--graphs NAME,...] [--kinds NAME,...]
        [--shares P,...] [--poses N] [--rate 200] [--peer-limit 600] [--no-peer] [--no-robust]
        [--again] [--output benchmarks]

Each graph is fed to the back end pose by pose, at so many keyframes per second, clean and with
each kind of lie; after each of our updates ISAM2 gets the same pose, without the false loops. A
cell of graph and kind replaces itself in results/incremental.json of the output folder, and
INCREMENTAL.md is written from all, after each: a run that is stopped leaves what it has, and goes
on there. What was measured of this commit of the package is not measured again without --again.
"""

import argparse
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import peer_environment
from arguments import shares_of, words_of

HERE = Path(__file__).resolve().parent


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Return the arguments, with the cells that they ask for as `cells`."""
    from robust.kinds import BICOCCA, KITTI, LIES
    from robust.places import graph_file
    from updates.cells import CLEAN, GRAPHS, RECORDED, WORLDS, cells
    from updates.in_space import BUILDING, HILLS

    kinds = (CLEAN, *LIES, RECORDED)
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--datasets', type=Path, default=Path(),
                        help='folder of the public graphs, of NAME.truth.txt, and of real/')
    parser.add_argument('--graphs', type=words_of, default=GRAPHS, metavar='NAME,...',
                        help=f'{", ".join(GRAPHS)}, fr079, kitti_00, torus3D, or NAME of a file '
                        'NAME.g2o in the folder')
    parser.add_argument('--kinds', type=words_of, default=kinds, metavar='NAME,...',
                        help=f'of {", ".join(kinds)}, which is that of {BICOCCA} alone')
    parser.add_argument('--shares', type=shares_of, default=(), metavar='P,...',
                        help='of all loops that are false, in place of the usual 0.3')
    parser.add_argument('--poses', type=int, default=0, help='only so many of them')
    parser.add_argument('--rate', type=float, default=200.0, help='keyframes per second')
    parser.add_argument('--peer-limit', type=float, default=600.0,
                        help="[s] of ISAM2's updates; it is left behind where it needs more")
    parser.add_argument('--no-peer', action='store_true')
    parser.add_argument('--no-robust', action='store_true', help='believe all loops')
    parser.add_argument('--again', action='store_true', help='measure what is there already')
    parser.add_argument('--output', type=Path, default=HERE,
                        help='folder of results/ and INCREMENTAL.md')
    arguments = parser.parse_args(words)
    unknown = set(arguments.kinds) - set(kinds)
    if unknown:
        parser.error(f'--kinds: {min(unknown)!r} is none of {", ".join(kinds)}')
    arguments.cells = [cell for graph in arguments.graphs for cell in cells(
        graph, arguments.kinds, arguments.shares, poses=arguments.poses, rate=arguments.rate,
        robust=not arguments.no_robust)]
    if not arguments.cells:
        parser.error('there is no such kind on these graphs')
    for graph in set(arguments.graphs) - {*WORLDS, BUILDING}:
        if not graph_file(arguments.datasets, KITTI if graph == HILLS else graph).exists():
            parser.error(f'--datasets: {arguments.datasets} has no {graph}')
    return arguments


def main() -> None:
    """Measure what is not there yet, write after each cell."""
    os.environ.update(peer_environment.ONE_THREAD)
    arguments = parse(sys.argv[1:])
    if not arguments.no_peer:
        # Ours has threads that go on behind the updates.
        peer_environment.enter(one_core=False)
    from measuring import record
    from updates.cells import Row, commit, is_done, measure
    from updates.tables import document

    from l1slam_ros.io.files import write_lines
    from l1slam_ros.io.free_memory import give_back_freed_memory

    give_back_freed_memory()
    file = arguments.output / 'results' / 'incremental.json'
    file.parent.mkdir(parents=True, exist_ok=True)
    before = json.loads(file.read_text())['rows'] if file.exists() else []
    rows = {row.cell: row for row in map(Row.of, before)}
    for cell in arguments.cells:
        there = rows.get(cell)
        if there and not arguments.again and is_done(
                there, cell, not arguments.no_peer, commit()):
            continue
        row = measure(arguments.datasets, cell,
                      0.0 if arguments.no_peer else arguments.peer_limit)
        if row is None:
            print(f'{cell}: the time was up', flush=True)
            continue
        rows[cell] = row
        head = record('updates', [])
        write_lines(file, [json.dumps(head | {'rows': [asdict(r) for r in rows.values()]},
                                      indent=1)])
        lines = document(head, list(rows.values()))
        write_lines(arguments.output / 'INCREMENTAL.md', lines)
        print('\n'.join(line for line in lines
                        if line.startswith(f'| {cell.graph} | {cell.kind}')), flush=True)


if __name__ == '__main__':
    main()
