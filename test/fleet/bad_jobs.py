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


def prepared(job):
    """Answer with the status of what a job of `batch` solves, and if numba was needed."""
    return {**batching.solve_one(job), 'numba': 'numba' in sys.modules}


def bomb(job):
    kept = [bytearray(10**9) for _ in range(100)]
    return {'status': len(kept)}


def endless(job):
    while True:
        pass


def clock(job):
    signal.raise_signal(signal.SIGALRM)


def crash(job):
    os.kill(os.getpid(), signal.SIGSEGV)


def stop(job):
    os.kill(os.getpid(), signal.SIGSTOP)


def crash_once(job):
    output = Path(job['output'])
    if not output.exists():
        output.touch()
        crash(job)
    return {'status': 'converged'}
