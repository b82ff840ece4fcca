# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Everything about speed, measured side by side with others.

    python benchmarks/solvers --datasets DIR [--only PART,...] [--graphs NAME,...] [--compare]

Makes an environment with the peers on first use, and measures in it on one core: inner problems,
whole solves, one iteration, growth with size, perturbed starts. Writes results/PART.json,
RESULTS.md and results.png. README.md, above this folder, says what is measured and how.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]
# Python puts only the folder that it runs in front: its parts are `solvers.cases` and so on.
sys.path.insert(0, str(HERE))
BASELINE = HERE / 'baseline.json'
PARTS = ('inner', 'whole', 'iteration', 'growth', 'starts')
DENSE = 'dense'


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Return the arguments."""
    lines = (__doc__ or '').strip().splitlines()
    parser = argparse.ArgumentParser(description=lines[0])
    parser.add_argument('--datasets', type=Path,
                        help='folder of the public graphs intel, manhattan3500, city10000 (.g2o)')
    parser.add_argument('--only', type=_names(PARTS), default=PARTS, metavar='PART,...',
                        help=f'of {", ".join(PARTS)}')
    parser.add_argument('--graphs', type=lambda text: tuple(text.split(',')), default=None,
                        metavar='NAME,...', help=f'of the public ones and `{DENSE}`, a world')
    parser.add_argument('--repeats', type=int, default=5, help='runs a median is taken of')
    parser.add_argument('--limit', type=float, default=60.0,
                        help='of one run [s]; what takes longer runs only once')
    parser.add_argument('--output', type=Path, default=HERE,
                        help='folder of results/, RESULTS.md and results.png')
    parser.add_argument('--compare', action='store_true', help='print the ratios to baseline.json')
    parser.add_argument('--keep', action='store_true', help='make these results the baseline')
    arguments = parser.parse_args(words)
    public = arguments.graphs != (DENSE,) and set(arguments.only) != {'growth'}
    if public and not (arguments.datasets and arguments.datasets.is_dir()):
        parser.error('expected --datasets, the folder of the public graphs')
    if arguments.compare and not BASELINE.exists():
        parser.error('there is no baseline.json to compare with; --keep makes one')
    return arguments


def main() -> None:
    """Measure, write, compare."""
    arguments = parse(sys.argv[1:])
    import peer_environment

    peer_environment.enter()
    # These need what only the environment has.
    from solvers.picture import draw
    from solvers.tables import comparison, document

    from l1slam_ros.io.files import write_lines

    results = arguments.output / 'results'
    results.mkdir(parents=True, exist_ok=True)
    for part in arguments.only:
        measured = _measure(part, arguments)
        write_lines(results / f'{part}.json', [json.dumps(measured, indent=1)])
    recorded = {part: json.loads((results / f'{part}.json').read_text())
                for part in PARTS if (results / f'{part}.json').exists()}
    draw(arguments.output / 'results.png', recorded)
    write_lines(arguments.output / 'RESULTS.md', document(recorded))
    if arguments.compare:
        measured_now = {part: recorded[part] for part in arguments.only}
        print('\n'.join(comparison(measured_now, json.loads(BASELINE.read_text()))))
    if arguments.keep:
        write_lines(BASELINE, [json.dumps(recorded, indent=1)])


def _measure(part: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the record of one part."""
    from measuring import record
    from solvers import growth, inner, iteration, whole

    repeats, limit = arguments.repeats, arguments.limit
    if part == 'growth':
        return record(part, growth.measure(repeats, limit))
    measure: Callable[..., Any] = {
        'inner': inner.measure, 'whole': whole.measure, 'iteration': iteration.measure,
        'starts': whole.measure_starts}[part]
    return record(part, measure(_cases(arguments), repeats, limit))


def _cases(arguments: argparse.Namespace) -> Iterator[Any]:
    from solvers.cases import DENSE_WORLD, GRAPHS, public_case, simulated_case

    for name in arguments.graphs or (*GRAPHS, DENSE):
        yield (simulated_case(*DENSE_WORLD) if name == DENSE
               else public_case(arguments.datasets, name))


def _names(allowed: tuple[str, ...]) -> Callable[[str], tuple[str, ...]]:
    """Return a reader of names, separated by commas, of those allowed."""

    def read(text: str) -> tuple[str, ...]:
        names = tuple(text.split(','))
        unknown = set(names) - set(allowed)
        if unknown:
            raise argparse.ArgumentTypeError(f'{min(unknown)!r} is none of {", ".join(allowed)}')
        return names

    return read


if __name__ == '__main__':
    main()
