# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The first solve on a machine, and one whose cache of compiled code is damaged."""

import json
import os
import subprocess
import sys

from worlds import made

SOLVE = 'import sys; from l1slam_ros.cli.main import main; sys.exit(main(sys.argv[1:]))'


def solved(graph, cache):
    """Return what a process that solves says, and what it says of its progress."""
    done = subprocess.run([sys.executable, '-c', SOLVE, 'solve', graph, '--no-robust', '--json'],
                          env={**os.environ, 'NUMBA_CACHE_DIR': str(cache)}, timeout=280,
                          capture_output=True, text=True, check=True)
    return {**json.loads(done.stdout), 'seconds': 0}, done.stderr


def test_a_cold_start_compiles_once_and_what_is_damaged_again(tmp_path):
    graph, cache = made(tmp_path / 'graph.g2o', 60, 100), tmp_path / 'cache'
    found, said = solved(graph, cache)
    assert 'compiling, once on this machine' in said
    assert solved(graph, cache) == (found, '')
    # Half of one file is there, one is of something else, one differs by a bit.
    first, other, last = (next(cache.glob(f'*.{name}')) for name in ('se2', 'symbolic', 'blocks'))
    whole = first.read_bytes()
    first.write_bytes(whole[:len(whole) // 2])
    other.write_text('nothing of ours')
    whole = bytearray(last.read_bytes())
    whole[len(whole) // 2] ^= 4
    last.write_bytes(whole)
    again, said = solved(graph, cache)
    assert again == found and 'Traceback' not in said
    assert solved(graph, cache) == (found, '')
