# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What each constant and each rule of the judgement decides, on worlds of the second generator.

    python benchmarks/robust/unseen.py --half a --first 1000 --count 400 --out a.jsonl
    python benchmarks/robust/sensitivity.py a.jsonl [--constants | --rules] [--only NAME...]

Each tuned number of `core/robust` is halved and doubled, and each rule is left out, one at a time.
Of the runs in the file (half a alone: b stays unopened) those are run again where something was
near: the map was wrong, doubted or less sure than `_PLAIN`; and of the others every `_EVERY`th. A
row of the table counts the maps whose loops, slips or doubts change, and those that are better,
worse and newly wrong and silent: of right, right and doubted, wrong and said, wrong and silent
each is worse than the one before.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from inspect import getmembers, isclass, isfunction
from pathlib import Path
from pkgutil import walk_packages
from types import ModuleType
from typing import Any

import numpy as np

# As a program of its own it finds its neighbours.
sys.path.insert(0, str(Path(__file__).parents[1]))

from measuring import report_progress
from unseen import Record, half, read, run

from l1slam_ros.core import robust
from l1slam_ros.core.robust.rounds.growth import gain_of_places

_PLAIN, _EVERY = 0.99, 4
_NONE = np.zeros(0, np.int64)

# The numbers that could be others; not those that bound time, memory or rounding, nor definitions.
CONSTANTS = (
    'as_measured._OVERSTATED', 'as_measured._TURN', 'audit._LEAST', 'audit._RIVAL',
    'audit._UNTOLD', 'batch._SURE_OF_NORM', 'batch_map._MOST_GAPS', 'confidence.CONFIDENT',
    'gating.DOUBT', 'gating._RATIO_COSTS', 'innovation.TAIL', 'innovation.BY_CHANCE',
    'innovation.CHECKED', 'inspection._LONG', 'inspection.FEWEST', 'inspection.OFF_SCALE',
    'odometry.drift_likelihood.USUAL', 'odometry.drift_likelihood._NONE',
    'odometry.drift_likelihood._ANOTHER', 'odometry.hypotheses.FAR_NOISIER',
    'odometry.slips._TRIED', 'pairwise_consistency.RUN', 'places.NEAR', 'places._NEAR_STEPS',
    'rounds.evidence.TWO_PLACES', 'rounds.evidence.FEWEST_PLACES', 'rounds.evidence._SMALL',
    'rounds.growth._CHANCES', 'rounds.noise._WORD',
)
# Each function, and its replacement.
RULES: dict[str, Callable[..., Any]] = {
    'gating.rivals': lambda found, posterior, alone, place: np.full(len(place), -np.inf),
    'gating.together': lambda *_: _NONE,
    'places.err_together': lambda *_: False,
    'rounds.growth.Growth._is_noisier': lambda growth, rows: False,
    'rounds.growth.Growth._misfits': lambda growth, rows, residual: _NONE,
    'pairwise_consistency._by_chance': lambda growth, rows: 0.0,
    'pairwise_consistency.longest_run': lambda growth, rows: _NONE,
    'pairwise_consistency.gain_of': gain_of_places,
    'odometry.drift_likelihood.likely_drifts': lambda graph: np.zeros(0),
    'odometry.hypotheses.noisier_run': lambda growth: [],
    'odometry.hypotheses._log_likelihood_loss': lambda growth, noisier: 0.0,
    'odometry.slips.slips': lambda growth, as_stated: [],
    'odometry.slips._Search.pointers': lambda search: [],
    'odometry.slips._Search.by_own_odds': lambda search: iter(()),
    'odometry.cuts.moved_to_likeliest': lambda state, motion: state,
    'odometry.cuts.unusual': lambda state, motion: _NONE,
    'audit._with_uncontested': lambda growth: growth,
    'audit._drop': lambda growth: [],
    'batch.slips': lambda growth: [],
    'batch.agreeing': lambda growth: [],
    'batch._norm_doubts': lambda *_: (),
}


def modules_of_judgement() -> list[ModuleType]:
    """Return all modules of `core.robust`."""
    return [import_module(found.name)
            for found in walk_packages(robust.__path__, f'{robust.__name__}.')]


@contextmanager
def replaced(path: str, change: Callable[[Any], Any]) -> Iterator[None]:
    """Replace `module.NAME` or `module.Class.method` wherever it is held, within the block."""
    module, *owner, name = _split(path)
    holders: list[Any] = [import_module(f'{robust.__name__}.{module}')]
    if owner:
        holders = [getattr(holders[0], owner[0])]
    value = vars(holders[0])[name]
    if not owner:
        holders += [one for one in modules_of_judgement()
                    if one is not holders[0] and vars(one).get(name) is value]
    functions = {} if callable(value) else _with_default(holders, value)
    try:
        for holder in holders:
            setattr(holder, name, change(value))
        for function, defaults in functions.items():
            function.__defaults__ = tuple(
                change(value) if one is value else one for one in defaults)
        yield
    finally:
        for holder in holders:
            setattr(holder, name, value)
        for function, defaults in functions.items():
            function.__defaults__ = defaults


def _split(path: str) -> list[str]:
    module, _, name = path.rpartition('.')
    above, _, owner = module.rpartition('.')
    return [above, owner, name] if owner.lstrip('_')[0].isupper() else [module, name]


def _with_default(modules: list[Any], value: Any) -> dict[Any, tuple[Any, ...]]:
    """Return the functions of some modules that have a value, the same object, as a default."""
    members = [member for module in modules for member in vars(module).values()]
    members += [method for member in members if isclass(member)
                for _, method in getmembers(member, isfunction)]
    return {one: one.__defaults__ for one in members
            if isfunction(one) and any(each is value for each in one.__defaults__ or ())}


def scaled(times: float) -> Callable[[Any], Any]:
    """Return what scales a constant; one that counts stays a whole number of at least 1."""
    return lambda value: max(1, round(value * times)) if isinstance(value, int) else value * times


def _outcome(row: Record) -> int:
    return 2 * (not row['right']) + (bool(row['right']) == bool(row['doubtful']))


def telling(rows: list[Record]) -> list[Record]:
    """Return the runs of half a where something was near, and some others."""
    rows = [row for row in rows if row['method'] == 'l1slam' and half(row['number']) == 'a']
    plain = [_outcome(row) == 0 and (row['confidence'] or 1.0) >= _PLAIN for row in rows]
    near, rest = ([row for row, one in zip(rows, plain, strict=True) if one == kind]
                  for kind in (False, True))
    return near + rest[::_EVERY]


def compared(rows: list[Record]) -> str:
    """Run again; return of how many the finding changes, is better, worse, newly silent."""
    pairs = [(row, run(row['number'], row['references'])[0]) for row in rows]
    keys = 'true_refused', 'false_accepted', 'slips', 'doubts'
    other = sum(any(now[key] != then[key] for key in keys) for then, now in pairs)
    ends = [(_outcome(then), _outcome(now)) for then, now in pairs]
    return ' | '.join(str(count) for count in (
        other, sum(now < then for then, now in ends), sum(now > then for then, now in ends),
        sum(now == 3 > then for then, now in ends)))


def main() -> None:
    """Change each constant, leave out each rule, run, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('runs', type=Path, nargs='+', help='records of unseen.py')
    parser.add_argument('--constants', action='store_true', help='no rules')
    parser.add_argument('--rules', action='store_true', help='no constants')
    parser.add_argument('--only', nargs='+', help='of these, as gating.DOUBT')
    given = parser.parse_args()
    rows = telling(read(given.runs))
    ends = [_outcome(row) for row in rows]
    print(f'{len(rows)} runs; right {ends.count(0)}, right and doubted {ends.count(1)}, wrong and '
          f'said {ends.count(2)}, wrong and silent {ends.count(3)}')
    if not given.rules:
        columns = ' other | better | worse | silent |'
        print(f'\n| constant | is | half:{columns} double:{columns}\n'
              '|---|---|---|---|---|---|---|---|---|---|', flush=True)
        for path in given.only or CONSTANTS:
            report_progress(path)
            cells = []
            for times in (0.5, 2.0):
                with replaced(path, scaled(times)):
                    cells.append(compared(rows))
            module, name = path.rsplit('.', 1)
            value = getattr(import_module(f'{robust.__name__}.{module}'), name)
            print(f'| `{path}` | {value:.4g} | {cells[0]} | {cells[1]} |', flush=True)
    if not given.constants:
        print('\n| without | other | better | worse | silent |\n|---|---|---|---|---|', flush=True)
        for path in given.only or RULES:
            report_progress(path)
            with replaced(path, lambda _, path=path: RULES[path]):
                print(f'| `{path}` | {compared(rows)} |', flush=True)


if __name__ == '__main__':
    main()
