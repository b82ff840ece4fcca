# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Once the cache is full nothing is compiled any more: a robot would stand still meanwhile."""

import subprocess
import sys

from worlds import made

# Solves a graph by each norm; prints whether what compiles was loaded for it.
SOLVE = """
import sys
from l1slam_ros.cli.main import main

for norm in 'l1', 'l2', 'huber':
    for robust in '--robust', '--no-robust':
        assert main(['solve', sys.argv[1], '--norm', norm, robust, '--quiet']) in (0, 4)
assert main(['solve', sys.argv[1], '--solver', 'primal-dual', '--no-robust', '--quiet']) == 0
print('numba' in sys.modules)
"""


def test_what_compiles_is_not_loaded_once_the_cache_is_full(tmp_path):
    path = made(tmp_path / 'world.g2o', 100, 200, '--false-loops', 10)
    for _ in range(2):  # the first one may be the first on this machine
        done = subprocess.run([sys.executable, '-c', SOLVE, path], capture_output=True, text=True,
                              timeout=240)
        assert done.returncode == 0, done.stderr
    assert done.stdout == 'False\n' and 'compiling' not in done.stderr
