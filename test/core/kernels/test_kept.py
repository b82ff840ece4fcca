# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Machine code that is kept of loops: the same as numba's, and nothing at all if it is not sound."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from l1slam_ros.core import kernels
from l1slam_ros.core.geometry import se3
from l1slam_ros.core.kernels.compiled import Loop
from l1slam_ros.core.kernels.kept import link, objects
from l1slam_ros.io.compilation import STEPS, fill_cache, with_space

TESTS = Path(__file__).parents[2]
# Calls loops both ways, the first times that each is called with arguments of some types.
BOTH = """
import collections
import copy
from l1slam_ros.core.kernels.compiled import Loop

def told(value):
    parts = value if isinstance(value, tuple) else (value,)
    return [(type(part), getattr(part, 'dtype', None), np.shape(part), np.asarray(part).tobytes())
            for part in parts]

def types(arguments):
    return tuple((getattr(one, 'dtype', type(one)), np.ndim(one),
                  len(one) if isinstance(one, tuple) else 0) for one in arguments)

def both(loop, *arguments):
    if calls[loop, types(arguments)] >= 3:
        return kept(loop, *arguments)
    calls[loop, types(arguments)] += 1
    copies = copy.deepcopy(arguments)
    result, other = kept(loop, *arguments), loop.dispatcher(*copies)
    assert told(result) == told(other), loop
    for one, copied in zip(arguments, copies):
        assert told(one) == told(copied), loop
    return result

calls, kept = collections.Counter(), Loop.__call__
Loop.__call__ = both
"""
COUNTED = """
for loop in {loop for module in MODULES for loop in vars(module).values()
             if getattr(loop, 'takes', ()) or getattr(loop, 'takes_in_space', ())}:
    called = {what for one, what in calls if one is loop}
    print(loop.__module__.split('.')[-1], loop.__name__, len(called), len(loop.linked),
          len(loop.takes) + len(loop.takes_in_space))
"""


@pytest.fixture(scope='module', autouse=True)
def full_cache():
    fill_cache(lambda done, total: None, lambda: False, with_space(STEPS, se3))


def run(code, **settings):
    done = subprocess.run([sys.executable, '-X', 'faulthandler', '-c', code], text=True,
                          capture_output=True, timeout=300, cwd=TESTS,
                          env={**os.environ, **settings})
    assert done.returncode == 0, done.stderr
    return done.stdout.split()
