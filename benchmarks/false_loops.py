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
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import peer_environment

HERE = Path(__file__).resolve().parent
GRAPHS = ('intel', 'manhattan3500', 'city10000')


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Return the arguments."""
    from robust_cases import KINDS, ONLINE, SHARES

    lines = (__doc__ or '').strip().splitlines()
    parser = argparse.ArgumentParser(description=lines[0])
    parser.add_argument('--datasets', type=Path, required=True,
                        help='folder of the public graphs, and of NAME.truth.txt')
    parser.add_argument('--graphs', type=_words, default=GRAPHS, metavar='NAME,...',
                        help=f'of {", ".join(GRAPHS)}')
    parser.add_argument('--kinds', type=_words, metavar='KIND,...',
                        default=tuple(kind for kind in KINDS if not kind.startswith(ONLINE)),
                        help=f'of {", ".join(KINDS)}; all that are not online')
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
    # Before the environment is entered, only what this Python has may be imported.
    peer_environment.enter()
    arguments = parse(sys.argv[1:])
    from robust_cases import public_place
    from robust_peers import ONLINE_PEERS, PEERS
    from robust_solvers import ONLINE_OURS, OURS

    from l1slam_ros.core.warm_up import warm_up

    # Each run is a copy of this process, which has all loops compiled.
    warm_up()
    solvers, online = (
        [solver for solver in all_ if any(word in solver.name for word in arguments.solvers)]
        for all_ in ((*OURS, *PEERS), (*ONLINE_OURS, *ONLINE_PEERS)))
    for name in arguments.graphs:
        place = public_place(arguments.datasets, name)
        for kind in arguments.kinds:
            for share, chosen in _chosen(kind, arguments.shares, solvers, online):
                runs = measure(place, kind, share, arguments.seeds, chosen, arguments.limit)
                write(arguments.output, runs)


def _chosen(
    kind: str, shares: tuple[float, ...], solvers: list[Any], online: list[Any]
) -> Iterator[tuple[float, list[Any]]]:
    from robust_cases import ONLINE, shares_of

    for share in shares_of(kind, shares):
        yield share, online if kind.startswith(ONLINE) else solvers


def measure(
    place: Any, kind: str, share: float, seeds: int, solvers: Iterable[Any], limit: float
) -> list[Any]:
    """Return the runs of all seeds; a solver whose time was up does not run again."""
    from measuring import report_progress
    from robust_cases import CLEAN, ONLINE, false_case

    runs: list[Any] = []
    left = list(solvers)
    run_one = _online_one if kind.startswith(ONLINE) else _batch_one
    for seed in range(1 if kind == CLEAN else seeds):
        case = false_case(place, kind, share, seed)
        report_progress(f'{place.name}, {kind} {share:.0%}, seed {seed}')
        for solver in tuple(left):
            run = run_one(case, solver, limit)
            if run.seconds is None:
                left.remove(solver)
            runs.append(run)
    return runs


def _batch_one(case: Any, solver: Any, limit: float) -> Any:
    from robust_runs import batch_run, clean_map, timed_out

    reference = clean_map(case, solver, limit)
    return timed_out(case, solver) if reference is None else batch_run(
        case, solver, reference, limit)


def _online_one(case: Any, solver: Any, limit: float) -> Any:
    from robust_runs import EVERY, online_run, timed_out, within

    clean = within(limit, lambda: solver.drive(case.clean, EVERY))
    return timed_out(case, solver) if clean is None else online_run(case, solver, clean, limit)


def write(folder: Path, runs: Sequence[Any]) -> None:
    """Merge runs into the record, and write record and tables."""
    from dataclasses import asdict

    from measuring import record
    from robust_runs import Run
    from robust_tables import document

    from l1slam_ros.io.files import write_lines

    file = folder / 'results' / 'false_loops.json'
    file.parent.mkdir(parents=True, exist_ok=True)
    before = json.loads(file.read_text())['rows'] if file.exists() else []
    merged = {run.key: run for run in (*(Run(**fields) for fields in before), *runs)}
    ordered = sorted(merged.values(), key=lambda run: run.key)
    recorded = record('false loops', []) | {'rows': [asdict(run) for run in ordered]}
    write_lines(file, [json.dumps(recorded, indent=1)])
    write_lines(folder / 'FALSE_LOOPS.md', document(recorded, ordered))


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split(','))


def _shares(text: str) -> tuple[float, ...]:
    shares = tuple(float(word) for word in text.split(','))
    if not all(0 < share < 1 for share in shares):
        raise argparse.ArgumentTypeError(f'{text!r}, expected shares between 0 and 1')
    return shares


if __name__ == '__main__':
    main()
