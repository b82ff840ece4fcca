# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How many small faults in the package the tests notice (mutation testing).

    python benchmarks/mutants.py cover TREE FOLDER [--jobs 3]
    python benchmarks/mutants.py draw TREE MUTANTS.json [--count 200] [--seed 1]
    python benchmarks/mutants.py run TREE MUTANTS.json FOLDER RESULTS.json [--jobs 2]
                                 [--seconds 60] [--survivors OTHER.json]

A mutant is one change of one expression in core, io or ros: another operator or comparison, a
number one larger, a condition negated, None returned. `cover` runs the tests of a checkout once
and keeps which of them run which line of the package, in which time; `run` tries on each mutant
the tests that run its line, the fastest first, until one fails or the time is up. A test that
kills must pass without the mutant. With --survivors only what survived elsewhere is tried.
Needs the package `coverage`.
"""

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

PACKAGE = 'l1slam_ros'
PARTS = 'core', 'io', 'ros'
SETTINGS = f"""[run]
source_pkgs = {PACKAGE}
parallel = true
data_file = ${{COVERED}}/lines
context = ${{TEST_NOW-}}
sigterm = true
"""
COMPARISONS = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt,
               ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.In: ast.NotIn, ast.NotIn: ast.In,
               ast.Is: ast.IsNot, ast.IsNot: ast.Is}
OPERATORS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
             ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.MatMult: ast.Add,
             ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd}


class Mutant(NamedTuple):
    """A stretch of a file, from one (line, column) to another, and what stands there instead."""

    file: str
    start: tuple[int, int]
    end: tuple[int, int]
    kind: str
    text: str


def replaced(node: ast.AST) -> tuple[str, ast.expr] | None:
    """Return the kind of the change of an expression and what replaces it; None for no change."""
    match node:
        case ast.Compare(ops=[first, *_]) if type(first) in COMPARISONS:
            return 'comparison', ast.Compare(
                node.left, [COMPARISONS[type(first)](), *node.ops[1:]], node.comparators)
        case ast.BinOp() if type(node.op) in OPERATORS and not isinstance(node.left, ast.Constant
                                                                           | ast.JoinedStr):
            return 'operator', ast.BinOp(node.left, OPERATORS[type(node.op)](), node.right)
        case ast.BoolOp():
            other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            return 'boolean', ast.BoolOp(other, node.values)
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            return 'negation', node.operand
        case ast.Constant(value=bool(value)):
            return 'truth', ast.Constant(not value)
        case ast.Constant(value=int(value) | float(value)):
            return 'number', ast.Constant(value + 1)
        case ast.IfExp():
            return 'condition', ast.IfExp(ast.UnaryOp(ast.Not(), node.test), node.body,
                                          node.orelse)
    return None


def mutants_of(path: Path, name: str) -> list[Mutant]:
    """Return every mutant of a file; annotations and what only type checkers read have none."""
    tree = ast.parse(path.read_text())
    skipped: set[ast.AST] = set()
    for node in ast.walk(tree):
        for field in ('annotation', 'returns'):
            skipped.update(ast.walk(getattr(node, field, None) or ast.Pass()))
        if isinstance(node, ast.If) and ast.unparse(node.test) == 'TYPE_CHECKING':
            skipped.update(ast.walk(node))
        if isinstance(node, ast.JoinedStr):
            skipped.update(ast.walk(node))
    found = []
    for node in ast.walk(tree):
        if node in skipped:
            continue
        change = replaced(node)
        where: Any = node
        if isinstance(node, ast.Return) and node.value is not None:
            change, where = ('returned', ast.Constant(None)), node.value
        if change:
            text = f'({ast.unparse(ast.fix_missing_locations(change[1]))})'
            found.append(Mutant(name, (where.lineno, where.col_offset),
                                (where.end_lineno, where.end_col_offset), change[0], text))
    return found


def draw(tree: Path, count: int, seed: int) -> list[Mutant]:
    """Return mutants of the package, each kind as often as the code offers it."""
    paths = [path for part in PARTS for path in sorted((tree / PACKAGE / part).rglob('*.py'))]
    every = [mutant for path in paths
             for mutant in mutants_of(path, path.relative_to(tree).as_posix())]
    return sorted(random.Random(seed).sample(every, count))


def put_in(tree: Path, mutant: Mutant) -> str:
    """Change a file of a checkout; return its former text."""
    path = tree / mutant.file
    former = path.read_text()
    lines = former.encode().splitlines(keepends=True)
    (first, left), (last, right) = mutant.start, mutant.end
    changed = lines[first - 1][:left] + mutant.text.encode() + lines[last - 1][right:]
    path.write_bytes(b''.join([*lines[:first - 1], changed, *lines[last:]]))
    return former


def pytest_runtest_logstart(nodeid: str) -> None:
    """Note each line that runs from now on for this test (a hook of pytest, `-p mutants`)."""
    import coverage
    os.environ['TEST_NOW'] = nodeid
    running = coverage.Coverage.current()
    if running:
        running.switch_context(nodeid)


def pytest_runtest_logreport(report: Any) -> None:
    """Note how long a test took (a hook of pytest, `-p mutants`)."""
    if os.environ.get('COVERED') and 'PYTEST_XDIST_WORKER' in os.environ:
        with open(f'{os.environ["COVERED"]}/durations', 'a') as file:
            file.write(json.dumps([report.nodeid, report.duration]) + '\n')


def environment(tree: Path, **more: str) -> dict[str, str]:
    """Return the environment in which the tests of a checkout import its package."""
    here = Path(__file__).parent
    return {**os.environ, 'PYTHONPATH': f'{tree}{os.pathsep}{here}', **more}


def cover(tree: Path, folder: Path, jobs: int) -> None:
    """Run the tests of a checkout, and keep in a folder which of them run which line."""
    folder.mkdir(parents=True)
    (folder / 'settings').write_text(SETTINGS)
    started = 'import os, coverage; os.environ.get("COVERAGE_PROCESS_START") and ' \
              'coverage.process_startup()\n'
    (folder / 'sitecustomize.py').write_text(started)
    variables = environment(tree, COVERED=str(folder), TEST_NOW='',
                            COVERAGE_PROCESS_START=str(folder / 'settings'))
    variables['PYTHONPATH'] += f'{os.pathsep}{folder}'
    subprocess.run([sys.executable, '-m', 'pytest', '-p', 'mutants', '-q', '-n', str(jobs),
                    '--dist', 'worksteal'], cwd=tree, env=variables)
    subprocess.run([sys.executable, '-m', 'coverage', 'combine', '--quiet',
                    '--data-file', str(folder / 'lines'), str(folder)], env=variables, check=True)


def tests_of_lines(folder: Path, tree: Path) -> dict[str, dict[int, set[str]]]:
    """Return for each file of the package, for each line, the tests that run it."""
    import coverage
    data = coverage.CoverageData(str(folder / 'lines'))
    data.read()
    runs: dict[str, dict[int, set[str]]] = {}
    for file in data.measured_files():  # also of an installed package
        lines = runs.setdefault(str(Path(PACKAGE, file.rpartition(f'/{PACKAGE}/')[2])), {})
        for line, tests in data.contexts_by_lineno(file).items():
            lines.setdefault(line, set()).update({*tests} - {''})
    return runs


class Trial(NamedTuple):
    """What became of a mutant: how many tests run its line, which of them failed; [s]."""

    mutant: Mutant
    tests: int
    killer: str | None
    seconds: float


def failing(tree: Path, tests: list[str], seconds: float, variables: dict[str, str]) -> str | None:
    """Return the first of the tests that fails, or how the run ended without one; None."""
    command = [sys.executable, '-m', 'pytest', '-x', '-q', '--no-header', '--tb=no',
               '-p', 'no:cacheprovider', '-rfE', *tests]
    with subprocess.Popen(command, cwd=tree, env=variables, text=True, stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, start_new_session=True) as process:
        try:
            printed, _ = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, 9)
            return None
    named = [line.split(' ', 1)[1].split(' - ')[0] for line in printed.splitlines()
             if line.startswith(('FAILED ', 'ERROR '))]
    return named[0] if named else None if process.returncode in (0, 4, 5) else 'the run itself'


def run(tree: Path, mutants: list[Mutant], covered: Path, jobs: int, seconds: int
        ) -> list[Trial]:
    """Return what became of each mutant."""
    by_line = tests_of_lines(covered, tree)
    lasted: dict[str, float] = {}
    for line in (covered / 'durations').read_text().splitlines():
        test, took, *_ = json.loads(line)
        lasted[test] = lasted.get(test, 0.) + took
    copies: SimpleQueue[Path] = SimpleQueue()

    def tried(mutant: Mutant) -> Trial:
        runs = by_line.get(mutant.file, {})
        lines = range(mutant.start[0], mutant.end[0] + 1)
        found = {test for line in lines for test in runs.get(line, ())}
        if not found and any(line in runs for line in lines):  # runs when it is imported
            found = {test for of_line in runs.values() for test in of_line}
        tests = sorted(found & lasted.keys(), key=lasted.__getitem__)
        if not tests:
            return Trial(mutant, 0, None, 0.)
        copy, begun = copies.get(), time.monotonic()
        former = put_in(copy, mutant)
        try:
            # No more of them than pass in the time, so that none waits for the start of many.
            total, chosen = 0., []
            for test in tests:
                total += lasted[test]
                if total > seconds and chosen:
                    break
                chosen.append(test)
            variables = environment(copy)
            killer = failing(copy, chosen, 2 * seconds + 60, variables)
            if killer and failing_without(copy, mutant, former, killer, variables):
                killer = None
        finally:
            (copy / mutant.file).write_text(former)
            copies.put(copy)
        print(f'{mutant.file}:{mutant.start[0]} {mutant.kind}: {killer or "survived"}', flush=True)
        return Trial(mutant, len(tests), killer, time.monotonic() - begun)

    def failing_without(copy: Path, mutant: Mutant, former: str, killer: str,
                        variables: dict[str, str]) -> bool:
        (copy / mutant.file).write_text(former)
        return '::' in killer and failing(copy, [killer], 2 * seconds, variables) is not None

    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(jobs) as pool:
        for number in range(jobs):
            copy = Path(scratch, str(number), 'main')
            shutil.copytree(tree, copy, symlinks=True, ignore=shutil.ignore_patterns(
                '.venv', '.git', '__pycache__', '.*_cache'))
            if (tree.parent / 'shared').exists():
                (copy.parent / 'shared').symlink_to((tree.parent / 'shared').resolve())
            copies.put(copy)
        return list(pool.map(tried, mutants))


def read(path: Path) -> list[Mutant]:
    """Return the mutants that `draw` wrote."""
    return [Mutant(file, tuple(start), tuple(end), kind, text)
            for file, start, end, kind, text in json.loads(path.read_text())]


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    commands = parser.add_subparsers(dest='command', required=True)
    for name, words, options in (
            ('cover', ('tree', 'folder'), {'--jobs': 3}),
            ('draw', ('tree', 'mutants'), {'--count': 200, '--seed': 1}),
            ('run', ('tree', 'mutants', 'folder', 'results'), {'--jobs': 2, '--seconds': 60})):
        command = commands.add_parser(name)
        for word in words:
            command.add_argument(word, type=lambda text: Path(text).resolve())
        for option, default in options.items():
            command.add_argument(option, type=int, default=default)
    command.add_argument('--survivors', type=Path)
    given = parser.parse_args()
    if given.command == 'cover':
        cover(given.tree, given.folder, given.jobs)
    elif given.command == 'draw':
        given.mutants.write_text(json.dumps(draw(given.tree, given.count, given.seed), indent=0))
    else:
        mutants = read(given.mutants)
        if given.survivors:
            survived = [killer is None for _, _, killer, _ in json.loads(
                given.survivors.read_text())]
            mutants = [mutant for mutant, kept in zip(mutants, survived, strict=True) if kept]
        trials = run(given.tree, mutants, given.folder, given.jobs, given.seconds)
        given.results.write_text(json.dumps(trials, indent=0))
        killed = sum(trial.killer is not None for trial in trials)
        print(f'{killed} of {len(trials)} killed, {sum(not trial.tests for trial in trials)} '
              'on lines that no test runs')


if __name__ == '__main__':
    main()
