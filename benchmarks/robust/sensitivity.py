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

    python benchmarks/robust/sensitivity.py --datasets DIR [--drawn N] [--only NAME...]

Each number that stands alone as a constant of a module of `core/robust` is halved and doubled, one
at a time, in every module that uses it. The runs are some of those of `verdict.py`: worlds of its
first set, and graphs of `FIT`; no set that a record is claimed on. Of these are left out

- three in four of those where nothing was near: the map was right, without a doubt, a slip or a
  drift, and surer than `_PLAIN`;
- those that take longer than `_SLOW`;
- and of a constant those in which no function was called that reads it: there it tells nothing.

A row of the table says in how many runs the constant was read, in how many of these any loop, slip
or doubt then was another one, and how many maps were better, worse and newly wrong and silent: of
the four outcomes right, right and doubted, wrong and said, wrong and silent each is worse than the
one before.
"""

import argparse
import ast
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from inspect import getmembers, isclass, isfunction
from pathlib import Path
from pkgutil import walk_packages
from types import CodeType, FrameType, FunctionType, ModuleType
from typing import Any

# As a program of its own it finds its neighbours.
sys.path.insert(0, str(Path(__file__).parents[1]))

from measuring import report_progress
from robust.places import Place, place
from robust.verdict import (
    CONDITIONS,
    FIT,
    FITTED,
    MADE,
    generator,
    judged,
    made_wrong,
    worlds_drawn,
)

from l1slam_ros.core import robust
from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph

Number = float | int
# Conditions whose runs tell of the rules: clean, random and grouped lies, a slip, drift, noise
# stated wrong, streets taken for each other.
_TOLD = ('', 'slip', 'drift', 'information', 'aliased', 'odometry')
_NUMBERS = int, float
# Where a right map is surer than this, few rules are near their edge; of such every fourth is run.
_PLAIN, _EVERY = 0.99, 4
# [s] Of the processor.
_SLOW = 2.0
_FOLDER = str(Path(str(robust.__file__)).parent)


@dataclass(frozen=True)
class Ended:
    """
    How a run ended.

    outcome : 0 right, 1 right and doubted, 2 wrong and said, 3 wrong and silent, 4 the judgement
    failed; plain : nothing was near; found : the loops, slips and doubts.
    """

    outcome: int
    plain: bool = False
    found: tuple[Any, ...] = ()


@dataclass(frozen=True)
class Case:
    """A graph, where it is, the best map of it (n, 2), how it ended, and what was called for."""

    found: Place
    graph: FactorGraph
    best: Array
    ended: Ended
    called: frozenset[CodeType]

    def reads(self, name: str, modules: list[ModuleType]) -> bool:
        """Return whether any function was called that reads a constant of some modules."""
        files = {module.__file__ for module in modules}
        value = getattr(modules[0], name)
        defaults = {function.__code__ for function in _with_default(modules, value)}
        return any(code in defaults or (code.co_filename in files and name in code.co_names)
                   for code in self.called)


def constants() -> dict[str, list[ModuleType]]:
    """Return the name of each constant, `module.NAME`, and all modules that hold it."""
    modules = modules_of_judgement()
    found: dict[str, list[ModuleType]] = {}
    for module in modules:
        for name in _assigned(module):
            value = getattr(module, name)
            if type(value) in _NUMBERS and name.isupper() and value != 0:
                # Of the others those that import it.
                found[f'{module.__name__.rpartition("robust.")[2]}.{name}'] = [module, *(
                    other for other in modules if other is not module
                    and vars(other).get(name) is value and name not in _assigned(other))]
    return found


def modules_of_judgement() -> list[ModuleType]:
    """Return all modules of `core.robust`."""
    return [import_module(found.name)
            for found in walk_packages(robust.__path__, f'{robust.__name__}.')]


def _assigned(module: ModuleType) -> list[str]:
    """Return the names that a module assigns to itself, in order."""
    statements = ast.parse(Path(str(module.__file__)).read_text()).body
    return [node.id for statement in statements if isinstance(statement, ast.Assign)
            for target in statement.targets for node in ast.walk(target)
            if isinstance(node, ast.Name)]


def _with_default(modules: list[ModuleType], value: Number) -> list[FunctionType]:
    """Return the functions of some modules that have a value, the same object, as a default."""
    members = [member for module in modules for member in vars(module).values()]
    members += [method for member in members if isclass(member)
                for _, method in getmembers(member, isfunction)]
    return [function for function in members if isfunction(function)
            and function.__module__ in {module.__name__ for module in modules}
            and any(default is value for default in function.__defaults__ or ())]


@contextmanager
def changed_to(name: str, modules: list[ModuleType], value: Number) -> Iterator[None]:
    """Let a constant have another value within the block, as a default of arguments too."""
    before = getattr(modules[0], name)
    functions = {function: function.__defaults__ or ()
                 for function in _with_default(modules, before)}
    try:
        for module in modules:
            setattr(module, name, value)
        for function, defaults in functions.items():
            function.__defaults__ = tuple(value if default is before else default
                                          for default in defaults)
        yield
    finally:
        for module in modules:
            setattr(module, name, before)
        for function, defaults in functions.items():
            function.__defaults__ = defaults


def scaled(value: Number, times: float) -> Number:
    """Return a constant times a factor; one that counts stays a whole number of at least 1."""
    return max(1, round(value * times)) if isinstance(value, int) else value * times


def _ended(found: Place, graph: FactorGraph, best: Array) -> Ended:
    try:
        row, judgement = judged('', found, graph, best, '')
    except ArithmeticError:
        return Ended(4)
    outcome = (2 if row.wrong else 0) + (row.wrong != row.doubted)
    plain = (outcome == 0 and not len(judgement.slips) and not judgement.drift
             and judgement.confidence > _PLAIN)
    return Ended(outcome, plain, (judgement.accepted.tobytes(), judgement.slips.tolist(),
                                  judgement.drift != 0, row.doubts))


@contextmanager
def _calls() -> Iterator[set[CodeType]]:
    """Collect what is called of the judgement within the block."""
    called: set[CodeType] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == 'call' and frame.f_code.co_filename.startswith(_FOLDER):
            called.add(frame.f_code)

    sys.setprofile(note)
    try:
        yield called
    finally:
        sys.setprofile(None)


def _graphs(datasets: Path, drawn: int) -> Iterator[tuple[Place, FactorGraph, Array]]:
    """Yield what is solved: a place, a graph in which something is wrong, its best map (n, 2)."""
    for name, found, asked, rng, seed in worlds_drawn(FITTED, drawn):
        report_progress(f'{name} {seed}')
        with suppress(GraphError):  # no room for so many lies
            yield found, *made_wrong(found, asked, rng)
    for name in FIT:
        found = MADE[name](0) if name in MADE else place(datasets, name)
        for number, (change, amounts, _, share) in enumerate(CONDITIONS):
            if change in _TOLD and not (change == 'slip' and amounts[1] == 2) and share <= 0.7:
                yield found, *made_wrong(found, CONDITIONS[number], generator(name, number, 0))


def telling_cases(datasets: Path, drawn: int) -> list[Case]:
    """Return the runs that tell."""
    cases, plain = [], 0
    for found, graph, best in _graphs(datasets, drawn):
        began = time.process_time()
        ended = _ended(found, graph, best)
        if time.process_time() - began > _SLOW:
            continue
        plain += ended.plain
        if not ended.plain or plain % _EVERY == 0:
            with _calls() as called:
                _ended(found, graph, best)
            cases.append(Case(found, graph, best, ended, frozenset(called)))
    return cases


def compared(cases: list[Case]) -> str:
    """Return in how many runs something is other than it was, better, worse, newly silent."""
    ends = [(case.ended, _ended(case.found, case.graph, case.best)) for case in cases]
    other = sum(now.found != then.found for now, then in ends)
    better = sum(then.outcome < now.outcome for now, then in ends)
    worse = sum(then.outcome > now.outcome for now, then in ends)
    silent = sum(then.outcome >= 3 > now.outcome for now, then in ends)
    return f'{other} | {better} | {worse} | {silent}'


def main() -> int:
    """Change each constant, run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--datasets', type=Path, required=True)
    parser.add_argument('--drawn', type=int, default=12, help='worlds of each kind')
    parser.add_argument('--only', nargs='+', help='constants, as gating.DOUBT')
    given = parser.parse_args()
    cases = telling_cases(given.datasets, given.drawn)
    now = [case.ended.outcome for case in cases]
    print(f'{len(now)} runs; right {now.count(0)}, right and doubted {now.count(1)}, wrong and '
          f'said {now.count(2)}, wrong and silent {now.count(3)}\n\n'
          '| constant | is | read in | half: other | better | worse | silent | double: other | '
          'better | worse | silent |\n|---|---|---|---|---|---|---|---|---|---|---|', flush=True)
    for name, modules in constants().items():
        if given.only and name not in given.only:
            continue
        report_progress(name)
        short = name.rpartition('.')[2]
        value, columns = getattr(modules[0], short), []
        telling = [case for case in cases if case.reads(short, modules)]
        for times in (0.5, 2.0):
            with changed_to(short, modules, scaled(value, times)):
                columns.append(compared(telling))
        print(f'| `{name}` | {value:.4g} | {len(telling)} | {columns[0]} | {columns[1]} |',
              flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
