# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The process of one job, seen from inside.

In: on standard input one line of JSON, the job, its limits and the function that does it. Out: on
standard output empty lines while the process lives, then what the function returned, as JSON. It
ends when its standard input does, as then nobody waits for it.
"""

import json
import os
import resource
import select
import signal
import sys
import threading
from contextlib import suppress
from importlib import import_module
from typing import IO, Any, NoReturn

# What a job is, and what it answers: values of JSON.
Values = dict[str, Any]
# By the clock a job may take so many times as long as on the processor: then it hangs.
CLOCK = 10
# [s] Between the signal that the processor's time is up, and the one that nobody can catch.
_GRACE = 5
# So many signs of life in the time after which a process without any is taken for stalled.
_SIGNS = 10


def main() -> NoReturn:
    """Do the job that standard input names, and end."""
    status = 1
    try:
        asked = json.loads(sys.stdin.readline())
        parent, answer = os.dup(0), os.fdopen(os.dup(1), 'wb')
        nowhere = os.open(os.devnull, os.O_RDWR)
        for descriptor in range(3):
            os.dup2(nowhere, descriptor)
        limits = asked['limits']
        _limit(limits)
        threading.Thread(target=_live, args=(answer, parent, limits['stall'] / _SIGNS),
                         daemon=True).start()
        work = getattr(import_module(asked['module']), asked['function'])
        answer.write(json.dumps(work(asked['job'])).encode())
        answer.flush()
        status = 0
    finally:
        os._exit(status)


def _live(answer: IO[bytes], parent: int, period: float) -> None:
    """Write an empty line each period [s]; end this process when its parent has ended."""
    while not select.select([parent], [], [], period)[0]:
        answer.write(b'\n')
        answer.flush()
    os._exit(1)


def _limit(limits: Values) -> None:
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
