# SPDX-License-Identifier: Apache-2.0
"""
The false-loop suite: what maps and solvers make of loops that lie.

    python benchmarks/false_loops.py --datasets DIR [--graphs NAME,...] [--kinds KIND,...]
        [--shares P,...] [--seeds N] [--solvers WORD,...] [--limit S]

Runs in the environment of `solvers.py`, on one core. What it measures replaces the same runs in
results/false_loops.json, the others stay; FALSE_LOOPS.md is written from all of them, after each
graph and kind, so a run that is stopped leaves what it has.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import peer_environment
from robust_kinds import BATCH, KINDS, ONLINE, SHARES, shares_of

if TYPE_CHECKING:
    from robust_runs import Run

HERE = Path(__file__).resolve().parent
GRAPHS = ('intel', 'manhattan3500', 'city10000')


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Return the arguments."""
    lines = (__doc__ or '').strip().splitlines()
    parser = argparse.ArgumentParser(description=lines[0])
    parser.add_argument('--datasets', type=Path, required=True,
                        help='folder of the public graphs, and of NAME.truth.txt')
    parser.add_argument('--graphs', type=_words, default=GRAPHS, metavar='NAME,...',
                        help=f'of {", ".join(GRAPHS)}')
    parser.add_argument('--kinds', type=_words, metavar='KIND,...',
                        default=BATCH, help=f'of {", ".join(KINDS)}; all that are not online')
    parser.add_argument('--shares', type=_shares, default=SHARES, metavar='P,...',
                        help='of all loops that are false, for the kinds without one of their own')
    parser.add_argument('--seeds', type=int, default=5, help='each case is drawn so often')
    parser.add_argument('--solvers', type=_words, default=('',), metavar='WORD,...',
                        help='those whose names contain one of these, e.g. ours,DCS')
    parser.add_argument('--limit', type=float, default=60.0,
                        help='processor time of one run [s]; who needs more gets no other seed')
    parser.add_argument('--output', type=Path, default=HERE,
                        help='folder of results/ and FALSE_LOOPS.md')
    arguments = parser.parse_args(words)
    for name, given, allowed in (('--graphs', arguments.graphs, GRAPHS),
                                 ('--kinds', arguments.kinds, KINDS)):
        unknown = set(given) - set(allowed)
        if unknown:
            parser.error(f'{name}: {min(unknown)!r} is none of {", ".join(allowed)}')
    missing = [name for name in arguments.graphs
               if not (arguments.datasets / f'{name}.g2o').exists()]
    if missing:
        parser.error(f'{arguments.datasets} has no {missing[0]}.g2o')
    return arguments


def main() -> None:
    """Measure, merge, write."""
    arguments = parse(sys.argv[1:])
    peer_environment.enter()
    # These need what only the environment has.
    from measuring import record
    from robust_cases import public_place
    from robust_peers import ONLINE_PEERS, PEERS
    from robust_runs import measure
    from robust_solvers import ONLINE_OURS, OURS

    from l1slam_ros.io.warm_up import warm_up

    # Each run is a copy of this process, which has all loops compiled.
    warm_up()
    batch, online = (
        [solver for solver in all_ if any(word in solver.name for word in arguments.solvers)]
        for all_ in ((*OURS, *PEERS), (*ONLINE_OURS, *ONLINE_PEERS)))
    for name in arguments.graphs:
        place = public_place(arguments.datasets, name)
        for kind in arguments.kinds:
            solvers = online if kind.startswith(ONLINE) else batch
            for share in shares_of(kind, arguments.shares):
                write(arguments.output, record('false loops', []), measure(
                    place, kind, share, arguments.seeds, solvers, arguments.limit))


def write(folder: Path, head: dict[str, Any], runs: Sequence['Run']) -> None:
    """Merge runs into the record, and write record and tables; head : of `measuring.record`."""
    from robust_runs import Run, merged
    from robust_tables import document

    from l1slam_ros.io.files import write_lines

    file = folder / 'results' / 'false_loops.json'
    file.parent.mkdir(parents=True, exist_ok=True)
    before = json.loads(file.read_text())['rows'] if file.exists() else []
    everything = merged((Run(**fields) for fields in before), runs)
    recorded = head | {'rows': [asdict(run) for run in everything]}
    write_lines(file, [json.dumps(recorded, indent=1)])
    write_lines(folder / 'FALSE_LOOPS.md', document(recorded, everything))


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split(','))


def _shares(text: str) -> tuple[float, ...]:
    shares = tuple(float(word) for word in text.split(','))
    if not all(0 < share < 1 for share in shares):
        raise argparse.ArgumentTypeError(f'{text!r}, expected shares between 0 and 1')
    return shares


if __name__ == '__main__':
    main()
