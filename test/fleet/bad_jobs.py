# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Recordings that end the process which reads them, by their names."""

import os
import signal

# The `sitecustomize` of such a process.
BAD_JOBS = """
import os
import signal
import sys


def bomb(path):
    kept = [bytearray(10**9) for _ in range(100)]


def quiet(path):
    os._exit(1)


def endless(path):
    while True:
        pass


def clock(path):
    signal.raise_signal(signal.SIGALRM)


def crash(path):
    os.kill(os.getpid(), signal.SIGSEGV)


def crash_once(path):
    if not os.path.exists(path + '.crashed'):
        os.close(os.open(path + '.crashed', os.O_CREAT))
        crash(path)


def opened(event, about):
    path = str(about[0]) if event == 'open' else ''
    what, _, suffix = os.path.basename(path).partition('.')
    if suffix == 'g2o' and what in globals() and 'l1slam_ros.fleet.child' in sys.modules:
        globals()[what](path)


sys.addaudithook(opened)
"""


def stop(job):
    os.kill(os.getpid(), signal.SIGSTOP)
