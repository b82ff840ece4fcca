# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Jobs for processes of their own: those that end badly, and one that says what it needs."""

import os
import signal
import sys
from pathlib import Path

from l1slam_ros.cli import batching
from l1slam_ros.fleet.starter import serve


def begin():
    serve(lambda: None, lambda job: globals()[job['arguments'][0]](Path(job['output'])))


def begin_prepared():
    """Answer with the status of what a job of `batch` solves, and if numba was needed."""
    def work(job):
        return {**batching._solve(job), 'numba': 'numba' in sys.modules}

    serve(batching._prepare, work)


def bomb(output):
    kept = [bytearray(10**9) for _ in range(100)]
    return {'status': len(kept)}


def endless(output):
    while True:
        pass


def clock(output):
    signal.raise_signal(signal.SIGALRM)


def crash(output):
    os.kill(os.getpid(), signal.SIGSEGV)


def crash_once(output):
    if not output.exists():
        output.touch()
        crash(output)
    return {'status': 'converged'}


def end_all_once(output):
    """As where the machine is short of memory and its kernel picks the parent."""
    if not output.exists():
        output.touch()
        os.kill(os.getppid(), signal.SIGKILL)
    return {'status': 'converged'}
