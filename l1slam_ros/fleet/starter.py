# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A process that has all that a job needs in its memory, and forks a child for each job.

In: jobs, one line of JSON each, on standard input. Out: a line of JSON for each on standard
output, see `_done`. It has one thread, so a fork is safe; it ends when its standard input does,
and its child with it.
"""

import ctypes
import gc
import json
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NoReturn

# What a job is, and what it answers: values of JSON.
Values = dict[str, Any]
# By the clock a job may take so many times as long as on the processor: then it hangs.
CLOCK = 10
# [s] Between the signal that the processor's time is up, and the one that nobody can catch.
_GRACE = 5
_PARENT_DIED = 1  # of Linux's `prctl`
_BLOCK = 2**16


def serve(prepare: Callable[[], None], work: Callable[[Values], Values]) -> None:
    """
    Answer jobs until there are no more.

    Parameters
    ----------
    prepare : loads what each job needs
    work : does a job, in a process of its own, and returns its answer

    """
    answers = os.fdopen(os.dup(1), 'w')
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    prepare()
    gc.freeze()  # what stays is not looked at for garbage by each child, nor copied for it
    with os.fdopen(os.dup(0), buffering=1) as requests:
        for line in requests:
            asked = json.loads(line)
            print(json.dumps(_done(asked['job'], asked['limits'], work)), file=answers, flush=True)


def _done(job: Values, limits: Values, work: Callable[[Values], Values]) -> Values:
    """Return how a job ended: `answer` or none, `status` of its process, and what it took."""
    began = time.monotonic()
    here, there = os.pipe()
    child = os.fork()
    if not child:
        os.close(here)
        _work(job, limits, work, there)
    os.close(there)
    said = _heard(here, child)
    _, status, used = os.wait4(child, 0)
    try:
        answer = json.loads(said)
    except ValueError:  # it came to no end
        answer = None
    # In kilobytes on Linux, in bytes elsewhere.
    unit = 1024 if sys.platform.startswith('linux') else 1
    return {'answer': answer, 'status': os.waitstatus_to_exitcode(status),
            'seconds': round(time.monotonic() - began, 3),
            'cpu_seconds': round(used.ru_utime + used.ru_stime, 3),
            'peak_bytes': used.ru_maxrss * unit}


def _heard(pipe: int, child: int) -> bytes:
    """Return all that a child says; if nobody wants to hear it any more, end it and this."""
    blocks = list[bytes]()
    while True:
        ready = select.select([pipe, 0], [], [])[0]
        if 0 in ready:  # there is no other job before this one is answered: it is the end
            os.kill(child, signal.SIGKILL)
            os._exit(0)
        block = os.read(pipe, _BLOCK)
        if not block:
            os.close(pipe)
            return b''.join(blocks)
        blocks.append(block)


def _work(job: Values, limits: Values, work: Callable[[Values], Values], pipe: int) -> NoReturn:
    """Do a job in this process, a child, within its limits, and end."""
    status = 1
    try:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        _limit(limits)
        with os.fdopen(pipe, 'w') as answer:
            answer.write(json.dumps(work(job)))
        status = 0
    finally:
        os._exit(status)


def _limit(limits: Values) -> None:
    with suppress(AttributeError, OSError):  # no Linux: then it ends by its limits
        ctypes.CDLL(None).prctl(_PARENT_DIED, signal.SIGKILL)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
        signal.signal(number, signal.SIG_DFL)
    seconds = limits['seconds']
    signal.alarm(CLOCK * seconds)
    for kind, soft, hard in (
        (resource.RLIMIT_CORE, 0, 0),
        (resource.RLIMIT_CPU, seconds, seconds + _GRACE),
        (resource.RLIMIT_AS, limits['bytes'], limits['bytes']),
    ):
        with suppress(ValueError, OSError):  # a lower limit holds already, or there is no such one
            resource.setrlimit(kind, (soft, hard))
