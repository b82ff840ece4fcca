# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What becomes of maps when a constant of the judgement is half as large, and twice.

    python benchmarks/robust/sensitivity.py --datasets DIR [--only NAME...]

Each number that stands alone as a constant of a module of `core/robust` is halved and doubled, one
at a time, in every module that uses it. The runs are some of those of `verdict.py`, on the graphs
that its weights are fitted on. A row of the table says how many maps were then better, worse and
otherwise doubted than with the constant as it is: of the four outcomes right, right and doubted,
wrong and said, wrong and silent each is worse than the one before.
"""

import argparse
import ast
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from types import ModuleType

# As a program of its own it finds its neighbours.
sys.path.insert(0, str(Path(__file__).parents[1]))

from measuring import report_progress
from robust.places import Place, place
from robust.verdict import CONDITIONS, FIT, MADE, Row, run_one

from l1slam_ros.core import robust

Number = float | int
# Conditions whose runs tell of the rules: clean, random and grouped lies, a slip, drift, noise
# stated wrong, streets taken for each other.
_TOLD = ('', 'slip', 'drift', 'information', 'aliased', 'odometry')
_NUMBERS = int, float


def constants() -> dict[str, list[ModuleType]]:
    """Return the name of each constant, `module.NAME`, and all modules that hold it."""
    modules = [import_module(found.name)
               for found in walk_packages(robust.__path__, f'{robust.__name__}.')]
    found: dict[str, list[ModuleType]] = {}
    for module in modules:
        for name in _assigned(module):
            value = getattr(module, name)
            if type(value) in _NUMBERS and name.isupper() and value != 0:
                found[f'{module.__name__.rpartition("robust.")[2]}.{name}'] = [
                    other for other in modules if vars(other).get(name) is value]
    return found


def _assigned(module: ModuleType) -> list[str]:
    """Return the names that a module assigns to itself, in order."""
    statements = ast.parse(Path(str(module.__file__)).read_text()).body
    return [node.id for statement in statements if isinstance(statement, ast.Assign)
            for target in statement.targets for node in ast.walk(target)
            if isinstance(node, ast.Name)]


@contextmanager
def changed_to(name: str, modules: list[ModuleType], value: Number) -> Iterator[None]:
    """Let a constant have another value within the block."""
    before = getattr(modules[0], name)
    try:
        for module in modules:
            setattr(module, name, value)
        yield
    finally:
        for module in modules:
            setattr(module, name, before)


def scaled(value: Number, times: float) -> Number:
    """Return a constant times a factor; one that counts stays a whole number of at least 1."""
    return max(1, round(value * times)) if isinstance(value, int) else value * times


def _outcome(row: Row) -> int:
    """Return 0: right, 1: right and doubted, 2: wrong and said, 3: wrong and silent."""
    return (2 if row.wrong else 0) + (row.wrong != row.doubted)


def _outcomes(places: dict[str, Place]) -> list[int]:
    """Return the outcome of each run, 4 where the judgement fails."""
    outcomes = []
    for name, found in places.items():
        for condition, (change, amounts, _, share) in enumerate(CONDITIONS):
            two = change == 'slip' and amounts[1] == 2
            if change not in _TOLD or two or share > 0.7:
                continue
            try:
                outcomes.append(_outcome(run_one(name, found, condition, 0)))
            except ArithmeticError:
                outcomes.append(4)
    return outcomes


def _compared(now: list[int], then: list[int]) -> str:
    better = sum(b < a for a, b in zip(now, then, strict=True))
    worse = sum(b > a for a, b in zip(now, then, strict=True))
    silent = sum(b >= 3 > a for a, b in zip(now, then, strict=True))
    return f'{better} | {worse} | {silent}'


def main() -> int:
    """Change each constant, run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--datasets', type=Path, required=True)
    parser.add_argument('--only', nargs='+', help='constants, as gating.DOUBT')
    given = parser.parse_args()
    places = {name: MADE[name](0) if name in MADE else place(given.datasets, name)
              for name in FIT}
    now = _outcomes(places)
    print(f'{len(now)} runs; right {now.count(0)}, right and doubted {now.count(1)}, wrong and '
          f'said {now.count(2)}, wrong and silent {now.count(3)}\n\n'
          '| constant | is | at half: better | worse | silent | at double: better | worse | '
          'silent |\n|---|---|---|---|---|---|---|---|')
    for name, modules in constants().items():
        if given.only and name not in given.only:
            continue
        report_progress(name)
        short = name.rpartition('.')[2]
        value, columns = getattr(modules[0], short), []
        for times in (0.5, 2.0):
            with changed_to(short, modules, scaled(value, times)):
                columns.append(_compared(now, _outcomes(places)))
        print(f'| `{name}` | {value:.4g} | {columns[0]} | {columns[1]} |', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
