# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Damaged inputs of every kind that is read: each ends in order, in little time and memory.

    python benchmarks/mutated_inputs.py [--count 5000] [--seed 1] [--jobs 1] [--first 0]
                                        [--only NUMBER] [--keep FOLDER]

Small inputs of each kind are written and damaged at random: bytes, numbers, fields, lines, cells
of a database, messages. A random command then reads one in a process of its own. It may end with
0, 2, 3 or 4, for 2 with a line that says why, within 20 s and 1 GiB, and without a traceback or a
warning of Python. Printed is each failure, with what repeats it, and a table by kind; the exit
code is 1 if there was one.
"""

import argparse
import os
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import peer_environment

os.environ.update(peer_environment.ONE_THREAD)
import numpy as np
from mutated.changes import mutate
from mutated.kinds import KINDS, Kind, write_kinds

import l1slam_ros as l1
from l1slam_ros.cli.main import main as command
from l1slam_ros.io.graphs.saved_map import load_map

MOST_SECONDS, KILLED_AFTER = 20, 30
MOST_MEMORY = 2**20  # [KiB]
CODES = 0, 2, 3, 4


class Run(NamedTuple):
    """What became of an input: the exit code, or minus the signal; [s]; [KiB]; what is wrong."""

    number: int
    kind: str
    words: tuple[str, ...]
    code: int
    seconds: float
    memory: int
    wrong: str


def main() -> int:
    """Run all, print the table, return the exit code."""
    summary, _, rest = __doc__.strip().partition('\n')
    parser = argparse.ArgumentParser(description=summary, epilog=rest,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (('count', 5000), ('seed', 1), ('jobs', 1), ('first', 0)):
        parser.add_argument(f'--{name}', type=int, default=default)
    parser.add_argument('--only', type=int, help='one input alone; what it prints is shown')
    parser.add_argument('--keep', type=Path, help='an empty folder, where inputs stay')
    asked = parser.parse_args()
    numbers = range(asked.first, asked.first + asked.count) if asked.only is None else [asked.only]
    with tempfile.TemporaryDirectory() as folder:
        sound, work = Path(folder, 'sound'), asked.keep or Path(folder, 'work')
        for made in sound, work:
            made.mkdir(parents=True, exist_ok=True)
        _in_silence(lambda: write_kinds(sound))
        found = _all(numbers, asked, sound, work)
    _print_table(found)
    return int(any(run.wrong for run in found))


def _in_silence(work) -> None:
    """Do some work without what it prints; what it loads, the children have from the start."""
    kept = os.dup(2)
    with open(os.devnull, 'w') as nothing:
        os.dup2(nothing.fileno(), 2)
        try:
            work()
        finally:
            os.dup2(kept, 2)
    if threading.active_count() > 1:
        raise SystemExit(f'threads that no child has: {threading.enumerate()}')


def _all(numbers, asked: argparse.Namespace, sound: Path, work: Path) -> list[Run]:
    """Return what became of all inputs, some at a time."""
    found, running = [], {}
    left = iter(numbers)
    number = next(left, None)
    while number is not None or running:
        if number is not None and len(running) < asked.jobs:
            folder = work / str(number)
            kind, words = _prepared(np.random.default_rng((asked.seed, number)), sound, folder)
            running[_started(words, folder)] = number, kind.name, words, time.monotonic()
            number = next(left, None)
            continue
        child, status, used = os.wait4(-1, 0)
        number_of, name, words, begun = running.pop(child)
        said = (work / str(number_of) / 'said.txt').read_text(errors='replace')
        code, seconds = os.waitstatus_to_exitcode(status), time.monotonic() - begun
        run = Run(number_of, name, words, code, seconds, used.ru_maxrss,
                  _wrong(words, code, seconds, used.ru_maxrss, said))
        found.append(run)
        if run.wrong:
            print(f'{name}, {code}, {seconds:.1f} s, {run.memory >> 10} MiB: {run.wrong}\n'
                  f'    --seed {asked.seed} --only {number_of}    {" ".join(words)}', flush=True)
        if asked.only is not None:
            print(said)
        if asked.keep is None:
            shutil.rmtree(work / str(number_of), ignore_errors=True)
    return found


def _prepared(rng: np.random.Generator, sound: Path,
              folder: Path) -> tuple[Kind, tuple[str, ...]]:
    """Make a damaged input in a folder; return its kind, and a command that reads it."""
    kind = KINDS[rng.integers(len(KINDS))]
    shutil.copytree(sound / kind.folder, folder)
    files = sorted(path for path in folder.rglob('*') if path.is_file() and (
        not kind.damaged or path.match(kind.damaged)))
    mutate(files[rng.integers(len(files))], rng, sound)
    words = kind.commands[rng.integers(len(kind.commands))].split()
    for word in kind.options:
        if rng.random() < 0.15 and words[0] in word.commands:
            words += word.text[rng.integers(len(word.text))].split()
    return kind, tuple(word.format(input=folder / kind.input, folder=folder, sound=sound)
                       for word in words)


def _started(words: tuple[str, ...], folder: Path) -> int:
    """Return the process that runs a command."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return child
    code = 70
    try:
        signal.setitimer(signal.ITIMER_REAL, KILLED_AFTER)  # nobody catches it
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with (folder / 'said.txt').open('w') as said, open(os.devnull, 'w') as nothing:
            os.dup2(nothing.fileno(), 1)
            os.dup2(said.fileno(), 2)
        code = _load(Path(words[1])) if words[0] == 'load' else command(words)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _load(path: Path) -> int:
    """Go on with a saved map, as the node does; return the exit code that a command would have."""
    try:
        saved, _, _ = load_map(path)
        in_space = saved.builder.graph.manifold.NAME == 'SE3'
        with l1.Backend(l1.BackendOptions(), 3 if in_space else 2) as backend:
            backend.restore(saved)
            for k in range(5):  # the drive goes on
                backend.add_odometry(l1.OdometrySample(
                    (150 + k) * 10**9, np.array((k, 0.0, 0, 0, 0, 0, 1)), *2 * [0.01 * np.eye(6)]))
            backend.add_loop(l1.LoopClosure(
                102 * 10**9, 153 * 10**9, np.array((0, 0, 0, 0, 0, 0, 1.0)), 0.01 * np.eye(6)))
            backend.update()
            backend.settle()
            backend.loop_states()
    except l1.L1SlamError as error:
        print(f'l1slam: {error}', file=sys.stderr)
        return 2
    return 0


def _wrong(words: tuple[str, ...], code: int, seconds: float, memory: int, said: str) -> str:
    """Return what is wrong with a run, in words, or nothing."""
    last = said.strip().rpartition('\n')[2]
    if 'Traceback' in said or 'Warning' in said:
        return last
    if code not in CODES:
        return f'signal {-code}' if code < 0 else last
    lines = said.splitlines()
    if not all(line.startswith('l1slam: ') for line in lines) or (
            code == 2 and (not lines or '--quiet' in words and len(lines) > 1)):
        return repr(said[:300])
    if seconds > MOST_SECONDS:
        return 'too long'
    return 'too much memory' if memory > MOST_MEMORY else ''


def _print_table(found: list[Run]) -> None:
    print('| kind | inputs | codes | longest [s] | most memory [MiB] | failed |\n'
          '|---|---|---|---|---|---|')
    for name in (*dict.fromkeys(kind.name for kind in KINDS), 'all'):
        runs = [run for run in found if name in (run.kind, 'all')]
        if runs:
            codes = ', '.join(f'{code}: {count}' for code, count in sorted(
                Counter(run.code for run in runs).items()))
            print(f'| {name} | {len(runs)} | {codes} | {max(r.seconds for r in runs):.1f} | '
                  f'{max(r.memory for r in runs) >> 10} | {sum(bool(r.wrong) for r in runs)} |')


if __name__ == '__main__':
    sys.exit(main())
