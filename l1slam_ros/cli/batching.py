# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The command of `l1slam` that solves a folder of recordings, each in a process of its own."""

import argparse
import io
import json
import os
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from hashlib import sha256
from typing import Any

from l1slam_ros.cli.commands import Ending
from l1slam_ros.cli.main import main
from l1slam_ros.cli.version import version_text
from l1slam_ros.core.errors import OptionError
from l1slam_ros.fleet.batch import FAILED, TABLE, Batch, run
from l1slam_ros.fleet.child import Values
from l1slam_ros.fleet.isolated import Limits, failed
from l1slam_ros.io.files import counted
from l1slam_ros.io.node_options import read_params_file
from l1slam_ros.io.progress import say

_READ_IN_PART, _DOUBTFUL = 3, 4
_GIGABYTE = 10**9
# The longest sentence of a recording in the table.
_LONGEST = 1000
# Numbers, and lists of which the table has the length, of what `solve --json` says.
_VALUES = ('status', 'poses', 'factors', 'loops', 'parts', 'initial_cost', 'final_cost')
_LISTS = ('rejected', 'suspect', 'slips')


def batch(arguments: argparse.Namespace) -> Ending:
    """Solve each recording of a folder; write maps, a log and a table."""
    for name, least in (('workers', 1), ('retries', 0), ('seconds', 1)):
        value = getattr(arguments, name)
        if value is not None and value < least:
            raise OptionError(f'--{name} is {value}, expected {least} or more')
    if not arguments.memory >= 1:  # NaN is none
        raise OptionError(f'--memory is {arguments.memory:g}, expected 1 [GB] or more')
    words = _words(arguments)
    about: dict[str, Any] = {'version': version_text().splitlines()[0], 'arguments': words}
    if arguments.params_file:
        read_params_file(arguments.params_file)  # what is wrong with it is said once
        about['params_file'] = sha256(arguments.params_file.read_bytes()).hexdigest()
    if arguments.params_file:
        words = [*words, '--params-file', os.path.abspath(arguments.params_file)]
    asked = Batch(
        arguments.folder, arguments.output, tuple(words), about,
        Limits(arguments.seconds, int(arguments.memory * _GIGABYTE), arguments.retries),
        arguments.resume is not None, arguments.resume == 'failed')
    rows = run(asked, solve_one, arguments.workers or _cores(), arguments.scheduler)
    found = Counter(row['status'] for row in rows)
    of_code = Counter(row['exit_code'] for row in rows)
    table = arguments.output / f'{TABLE}.csv'
    print(f'{counted(len(rows), "recording")}, {counted(len(rows) - found[FAILED], "map")}: '
          f'{table}')
    if of_code[_DOUBTFUL]:
        say(f'{counted(of_code[_DOUBTFUL], "map is", "maps are")} doubtful, said in {table}')
    parts = [f'{count:,} {what}' for count, what in (
        (found[FAILED], 'failed'), (of_code[_READ_IN_PART], 'used only in part')) if count]
    return Ending(f'of {counted(len(rows), "recording")} {" and ".join(parts)}, said in {table}'
                  if parts else '')


def _cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else (
        os.cpu_count() or 1)


def _words(arguments: argparse.Namespace) -> list[str]:
    """Return the options of `solve` that say how to read a recording."""
    stated = ['--information', repr(arguments.information)] if arguments.information else []
    return [*stated, '--rotation-information', arguments.rotation_information,
            '--odom-topic', arguments.odom_topic, '--loop-topic', arguments.loop_topic]


def solve_one(job: Values) -> Values:
    """Return what the table says of a recording, by the command `l1slam solve`."""
    if os.path.exists(job['input']) and not (
            os.path.isfile(job['input']) or os.path.isdir(job['input'])):
        return failed(2, f'{job["name"]}: is not a regular file; expected a recording')
    said, complaints = io.StringIO(), io.StringIO()
    with redirect_stdout(said), redirect_stderr(complaints):
        code = main(['solve', job['input'], '--output', job['output'], '--json', '--quiet',
                     *job['arguments']])
    sentences = [line.removeprefix('l1slam: ') for line in complaints.getvalue().splitlines()]
    sentence = '; '.join(sentences).replace(job['input'], job['name'])[:_LONGEST]
    if not said.getvalue():
        return failed(code, sentence)
    report = json.loads(said.getvalue())
    return {'exit_code': code, 'sentence': sentence, **{name: report[name] for name in _VALUES},
            **{name: len(report[name]) for name in _LISTS}}
