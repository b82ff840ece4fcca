# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The false-loop suite: what maps and solvers make of loops that lie, recorded and made.

    python benchmarks/false_loops.py --datasets DIR [--suite NAME,...] [--kinds WORD,...]
        [--graphs NAME,...] [--shares P,...] [--seeds N | A-B] [--solvers WORD,...] [--limit S]

        [--output benchmarks]

Prints a line for each run: pass or fail, and why. With --output, what it measures replaces the
same runs in results/false_loops.json of that folder, the others stay; FALSE_LOOPS.md is written
from all of them, after each graph and kind, so a run that is stopped leaves what it has. Peers run
in the environment of `solvers.py`; all runs on one core.
"""

import argparse
import json
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import peer_environment
from arguments import shares_of, words_of
from robust.kinds import GRAPHS, KINDS, MADE, SUITES

if TYPE_CHECKING:
    from robust.runs import Run

DEFAULT_SOLVERS = ('ours L', 'from odometry')


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Return the arguments."""
    lines = (__doc__ or '').strip().splitlines()
    parser = argparse.ArgumentParser(description=lines[0])
    parser.add_argument('--datasets', type=Path, required=True,
                        help='folder of the public graphs, of NAME.truth.txt, and of real/')
    parser.add_argument('--suite', type=words_of, default=SUITES, metavar='NAME,...',
                        help=f'of {", ".join(SUITES)}')
    parser.add_argument('--kinds', type=words_of, default=('',), metavar='WORD,...',
                        help='those whose names begin with one of these')
    parser.add_argument('--graphs', type=words_of, default=GRAPHS, metavar='NAME,...',
                        help=f'of {", ".join(GRAPHS)}')
    parser.add_argument('--shares', type=shares_of, metavar='P,...',
                        help='of all loops that are false; all that a kind has')
    parser.add_argument('--seeds', type=_seeds, default=range(3), metavar='N | A-B',
                        help='each case is drawn so often, or with seeds A to B')
    parser.add_argument('--solvers', type=words_of, default=DEFAULT_SOLVERS, metavar='WORD,...',
                        help='those whose names contain one of these, e.g. ours L2,live,ISAM2')
    parser.add_argument('--limit', type=float, default=120.0,
                        help='processor time of one run [s]; who needs more gets no other seed')
    parser.add_argument('--output', type=Path,
                        help='folder of results/ and FALSE_LOOPS.md')
    arguments = parser.parse_args(words)
    for name, given, allowed in (('--graphs', arguments.graphs, GRAPHS),
                                 ('--suite', arguments.suite, SUITES)):
        unknown = set(given) - set(allowed)
        if unknown:
            parser.error(f'{name}: {min(unknown)!r} is none of {", ".join(allowed)}')
    if not any(True for _ in selected(arguments)):
        parser.error('there is no such kind on these graphs with these shares')
    if not arguments.datasets.is_dir() and set(arguments.graphs) - set(MADE):
        parser.error(f'{arguments.datasets} is no folder')
    return arguments


def selected(arguments: argparse.Namespace) -> Iterable[tuple[str, Any, float]]:
    """Yield graph, kind and share of what is to be measured."""
    for graph in arguments.graphs:
        for kind in KINDS:
            if (graph in kind.graphs and kind.suite in arguments.suite
                    and kind.name.startswith(arguments.kinds)):
                for share in kind.shares:
                    if arguments.shares is None or share in (0.0, *arguments.shares):
                        yield graph, kind, share


def main() -> None:
    """Measure, merge, write."""
    arguments = parse(sys.argv[1:])
    if all(word.startswith('ours') for word in arguments.solvers):
        os.environ.update(peer_environment.ONE_THREAD)
    else:
        peer_environment.enter()
    # These need what only the environment has, and one thread.
    from measuring import record
    from robust.peers import PEERS
    from robust.places import place
    from robust.runs import measure
    from robust.solvers import OURS

    solvers = [solver for solver in (*OURS, *PEERS)
               if any(word in solver.name for word in arguments.solvers)]
    places: dict[str, Any] = {}
    for name, kind, share in selected(arguments):
        if name not in places:
            places = {name: place(arguments.datasets, name)}
        runs = measure(places[name], kind, share, arguments.seeds, solvers, arguments.limit)
        if arguments.output:
            write(arguments.output, record('false loops', []), runs)


def write(folder: Path, head: dict[str, Any], runs: Sequence['Run']) -> None:
    """Merge runs into the record, and write record and tables; head : of `measuring.record`."""
    from robust.runs import Run, merged
    from robust.tables import document

    from l1slam_ros.io.files import write_lines

    file = folder / 'results' / 'false_loops.json'
    file.parent.mkdir(parents=True, exist_ok=True)
    before = json.loads(file.read_text())['rows'] if file.exists() else []
    everything = merged((Run(**fields) for fields in before), runs)
    recorded = head | {'rows': [asdict(run) for run in everything]}
    write_lines(file, [json.dumps(recorded, indent=1)])
    write_lines(folder / 'FALSE_LOOPS.md', document(recorded, everything))


def _seeds(text: str) -> range:
    first, _, last = text.rpartition('-')
    return range(int(first), int(last) + 1) if first else range(int(last))


if __name__ == '__main__':
    main()
