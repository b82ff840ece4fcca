# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
One job in a process of its own, seen from the worker that waits for it.

In: a job and its limits. Out: a row, whatever became of the process: a hang, a crash and a bomb
are told in a sentence.
"""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from l1slam_ros.fleet.starter import CLOCK, Values

# Linear algebra on one thread: the workers are the threads. Sets in one order.
_ENVIRONMENT = {**dict.fromkeys(
    ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS'), '1'), 'PYTHONHASHSEED': '0'}
_TIME_IS_UP = -signal.SIGXCPU, -signal.SIGALRM
_STARTERS = threading.local()
# Of a job that was not brought to an end, nobody knows what it took.
TOOK_NOTHING: Values = {'seconds': 0.0, 'cpu_seconds': 0.0, 'peak_bytes': 0}


@dataclass(frozen=True)
class Limits:
    """
    What a job may take.

    seconds : [s] of the processor, and `CLOCK` times as long by the clock; bytes : of address
    space.
    """

    seconds: int
    bytes: int


@dataclass(frozen=True)
class Job:
    """
    A recording to be solved.

    name : of the recording; input, output : the paths of it and of its map; arguments : how to
    solve it.
    """

    name: str
    input: str
    output: str
    arguments: tuple[str, ...] = ()


class _DiedError(Exception):
    """The starter came to its end amid a job."""


class _Starter:
    """A process of `starter`, begun by a function of some module that calls `serve`."""

    def __init__(self, begin: Callable[[], None]):
        code = (f'import sys; sys.path[:] = {sys.path!r}; '
                f'from {begin.__module__} import {begin.__qualname__} as begin; begin()')
        # Ctrl-C of a person is for the command, which ends this one.
        self._process = subprocess.Popen(
            [sys.executable, '-c', code], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, text=True, start_new_session=True,
            env={**os.environ, **_ENVIRONMENT})

    def ended(self, job: Job, limits: Limits) -> Values:
        """Return how a job ended, see `starter`."""
        requests, answers = self._process.stdin, self._process.stdout
        assert requests is not None and answers is not None
        try:
            requests.write(json.dumps({'job': asdict(job), 'limits': asdict(limits)}) + '\n')
            requests.flush()
            line = answers.readline()
        except OSError as error:
            raise _DiedError from error
        if not line.endswith('\n'):
            raise _DiedError
        found: Values = json.loads(line)
        return found

    def close(self) -> None:
        """End the process."""
        with self._process:
            self._process.kill()


def run_job(begin: Callable[[], None], job: Job, limits: Limits, retries: int) -> Values:
    """
    Do a job, again where its process crashed; return its row and what it took.

    Parameters
    ----------
    begin : starts a process that calls `serve`; a function of a module
    job, limits : what is to be done, and what it may take
    retries : how often it is tried again

    Returns
    -------
    `row`, what the table says of it, and `attempts`, `seconds`, `cpu_seconds`, `peak_bytes`, of
    the last attempt, and `worker`

    """
    ended: Values = {}
    for attempt in range(1, retries + 2):
        ended = _attempt(begin, job, limits)
        ended['attempts'] = attempt
        if ended['answer'] is not None or ended['status'] in _TIME_IS_UP:
            break
    status, answer = ended.pop('status'), ended.pop('answer')
    if answer is None:
        answer = failed(status, _reason(status, limits, ended['attempts']))
    return {**ended, 'row': {'recording': job.name, **answer},
            'worker': f'{os.uname().nodename}:{os.getpid()}'}


def failed(code: int | None, sentence: str) -> dict[str, Any]:
    """Return what the table says of a recording without a map."""
    return {'status': 'failed', 'exit_code': code, 'sentence': sentence}


def _attempt(begin: Callable[[], None], job: Job, limits: Limits) -> Values:
    if not hasattr(_STARTERS, 'of'):
        _STARTERS.of = {}
    starter = _STARTERS.of.get(begin)
    if starter is None:
        starter = _STARTERS.of[begin] = _Starter(begin)
    try:
        return starter.ended(job, limits)
    except _DiedError:
        del _STARTERS.of[begin]
        starter.close()
        return {'answer': None, 'status': -signal.SIGKILL, **TOOK_NOTHING}


def _reason(status: int, limits: Limits, attempts: int) -> str:
    """Say in a sentence why there is no answer."""
    if status == -signal.SIGXCPU:
        return f'took more than {limits.seconds:,} s of the processor'
    if status == -signal.SIGALRM:
        return f'took more than {CLOCK * limits.seconds:,} s by the clock'
    times = f', {attempts} times' if attempts > 1 else ''
    if status < 0:
        return f'its process was ended by signal {-status}, {signal.strsignal(-status)}{times}'
    return f'its process ended with code {status} and said nothing{times}'
