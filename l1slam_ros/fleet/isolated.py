# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Jobs on this machine, each in a process of its own that is spoken to over pipes.

In: jobs and their limits. Out: a row for each, whatever became of its process: a hang, a crash and
a bomb are told in a sentence. No port is open, so nobody else can reach a process.
"""

import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

from l1slam_ros.fleet import child
from l1slam_ros.fleet.child import Values
from l1slam_ros.io.progress import say

# Linear algebra on one thread: the jobs are the threads. Sets in one order.
_ENVIRONMENT = {**dict.fromkeys(
    ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS'), '1'), 'PYTHONHASHSEED': '0'}
_TIME_IS_UP = -signal.SIGXCPU, -signal.SIGALRM
_BLOCK = 2**16


@dataclass(frozen=True)
class Limits:
    """
    What a job may take.

    seconds : [s] of the processor, and `child.CLOCK` times as long by the clock; bytes : of
    address space; retries : how often it is tried again when its process ended or stalled;
    stall : [s] without a sign of life, after which a process is taken for stalled.
    """

    seconds: int
    bytes: int
    retries: int
    stall: float = 60.0


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


# Does a job in its own process, and returns what the table says of it; a function of a module.
Work = Callable[[Values], Values]
# Each job, and how it ended.
Ended = Generator[tuple[Job, Values], None, None]


def results(work: Work, jobs: Iterable[Job], limits: Limits, workers: int) -> Ended:
    """
    Do jobs, so many at once; yield each and how it ended, in the order in which they end.

    Yields
    ------
    job : as given
    ended : `row`, what the table says of it; `attempts`; `seconds`, `cpu_seconds`, `peak_bytes`
        of the last attempt; `worker`

    """
    waiting = iter(jobs)
    running: dict[Job, _Attempt] = {}
    with selectors.DefaultSelector() as outputs:
        def start(job: Job, number: int) -> None:
            attempt = running[job] = _Attempt(work, job, limits, number)
            outputs.register(attempt.output, selectors.EVENT_READ, attempt)

        try:
            while True:
                while len(running) < workers and (job := next(waiting, None)) is not None:
                    start(job, 1)
                if not running:
                    return
                for attempt in _finished(outputs, running.values()):
                    outputs.unregister(attempt.output)
                    job, number = attempt.job, attempt.number
                    ended, again = running.pop(job).end()
                    if again and number <= limits.retries:
                        say(f'{job.name}: {ended["row"]["sentence"]}; tried again')
                        start(job, number + 1)
                    else:
                        yield job, ended
        finally:
            for attempt in running.values():
                attempt.end()


def failed(code: int | None, sentence: str) -> dict[str, Any]:
    """Return what the table says of a recording without a map."""
    return {'status': 'failed', 'exit_code': code, 'sentence': sentence}


class _Attempt:
    """A process that does a job."""

    def __init__(self, work: Work, job: Job, limits: Limits, number: int):
        self.job, self.number = job, number
        self._limits = limits
        self._began = self._heard = time.monotonic()
        self._said = b''
        code = (f'import sys; sys.path[:] = {sys.path!r}; '
                f'from {child.__name__} import main; main()')
        # Ctrl-C of a person is for the command, which ends this one.
        self._process = subprocess.Popen(
            [sys.executable, '-c', code], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, start_new_session=True,
            env={**os.environ, **_ENVIRONMENT})
        assert self._process.stdin is not None and self._process.stdout is not None
        self.output = self._process.stdout.fileno()
        asked = {'module': work.__module__, 'function': work.__qualname__, 'job': asdict(job),
                 'limits': asdict(limits)}
        with suppress(BrokenPipeError):  # it has ended, as its output says, too
            self._process.stdin.write(json.dumps(asked).encode() + b'\n')
            self._process.stdin.flush()

    def listen(self) -> bool:
        """Read what is there; return False at the end of it."""
        block = os.read(self.output, _BLOCK)
        self._said += block
        self._heard = time.monotonic()
        return bool(block)

    def patience(self) -> float:
        """Return how much longer it may give no sign of life [s]; below 0, it has stalled."""
        return self._heard + self._limits.stall - time.monotonic()

    def end(self) -> tuple[Values, bool]:
        """End the process if it has not; return how the job ended, and whether to try again."""
        process, limits = self._process, self._limits
        stalled = self.patience() < 0
        os.kill(process.pid, signal.SIGKILL)  # one that has ended keeps its status
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        for pipe in process.stdin, process.stdout:
            with suppress(OSError):  # what it was not told any more
                assert pipe is not None
                pipe.close()
        again = False
        try:
            row = json.loads(self._said)
        except ValueError:  # it came to no end
            again = process.returncode not in _TIME_IS_UP
            row = failed(None if stalled else process.returncode,
                         _reason(process.returncode, limits, self.number, stalled))
        # In kilobytes on Linux, in bytes elsewhere.
        unit = 1024 if sys.platform.startswith('linux') else 1
        return {'row': {'recording': self.job.name, **row}, 'attempts': self.number,
                'seconds': round(time.monotonic() - self._began, 3),
                'cpu_seconds': round(used.ru_utime + used.ru_stime, 3),
                'peak_bytes': used.ru_maxrss * unit,
                'worker': f'{os.uname().nodename}:{process.pid}'}, again


def _finished(outputs: selectors.BaseSelector, running: Iterable[_Attempt]) -> list[_Attempt]:
    """Wait until a process says something; return those that have ended or stalled."""
    patience = min(attempt.patience() for attempt in running)
    ended = [key.data for key, _ in outputs.select(max(patience, 0)) if not key.data.listen()]
    # Only now: what was said while this process was stopped has been read.
    return ended + [attempt for attempt in running
                    if attempt not in ended and attempt.patience() < 0]


def _reason(status: int, limits: Limits, attempts: int, stalled: bool) -> str:
    """Say in a sentence why there is no answer."""
    if status == -signal.SIGXCPU:
        return f'took more than {limits.seconds:,} s of the processor'
    if status == -signal.SIGALRM:
        return f'took more than {child.CLOCK * limits.seconds:,} s by the clock'
    times = f', {attempts} times' if attempts > 1 else ''
    if stalled:
        return f'its process stalled: no sign of life for {limits.stall:g} s{times}'
    if status < 0:
        return f'its process was ended by signal {-status}, {signal.strsignal(-status)}{times}'
    return f'its process ended with code {status} and said nothing{times}'
