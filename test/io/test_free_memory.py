# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What is free: of the machine, of control groups of both versions, of nothing that is told."""

import math
import os
import subprocess
import sys

import pytest

from l1slam_ros.core import memory
from l1slam_ros.io.free_memory import free_memory

GIGA = 2**30
# Arrays of 32 MB, one after the other, and how often memory had to be asked for after the first.
ARRAYS = """
import resource

import numpy as np

from l1slam_ros.io.compilation import load
from l1slam_ros.io.free_memory import keep_freed_memory

def faults():
    np.ones(2**22)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

keep_freed_memory()
# Loads the loops of one step, after which the memory is still kept.
load(['substitution'])
first = faults()
print(max(faults() for _ in range(10)) - first)
"""

# An array of 16 MB, twice; by how much the process is then larger than before, in pages.
GIVEN_BACK = """
from pathlib import Path

import numpy as np

from l1slam_ros.io.free_memory import give_back_freed_memory

def resident():
    return int(Path('/proc/self/statm').read_text().split()[1])

give_back_freed_memory()
first = resident()
for _ in range(2):
    np.ones(2**21)
print(resident() - first)
"""


def machine(root, files):
    """Write files of a machine with 8 GiB available; return its root."""
    for name, text in {'proc/meminfo': f'MemTotal: 9 kB\nMemAvailable:    {8 * 2**20} kB\n',
                       **files}.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def test_of_this_machine_something_is_free():
    assert 0 < free_memory() < math.inf


def test_without_a_limit_it_is_what_the_machine_has(tmp_path):
    assert free_memory(machine(tmp_path, {})) == 8 * GIGA
    group = {'proc/self/cgroup': '0::/a/b\n', 'sys/fs/cgroup/a/memory.max': 'max\n'}
    assert free_memory(machine(tmp_path, group)) == 8 * GIGA


def test_where_nothing_is_told_it_is_without_bound(tmp_path):
    assert free_memory(tmp_path) == math.inf


@pytest.mark.parametrize('line, folder, limit, used, kept', [
    ('0::/a/b', 'sys/fs/cgroup/a', 'memory.max', 'memory.current', 'inactive_file'),
    ('4:memory:/a/b', 'sys/fs/cgroup/memory/a', 'memory.limit_in_bytes', 'memory.usage_in_bytes',
     'total_inactive_file'),
    ('0::/not/seen/from/here', 'sys/fs/cgroup', 'memory.max', 'memory.current', 'inactive_file')])
def test_the_limit_of_a_group_above_counts(tmp_path, line, folder, limit, used, kept):
    root = machine(tmp_path, {
        'proc/self/cgroup': f'9:pids:/elsewhere\n{line}\n', f'{folder}/{limit}': f'{4 * GIGA}\n',
        f'{folder}/{used}': f'{3 * GIGA}\n', f'{folder}/memory.stat': f'rss 1\n{kept} {GIGA}\n'})
    assert free_memory(root) == 2 * GIGA


def test_a_limit_of_the_process_counts(tmp_path):
    root = machine(tmp_path, {
        'proc/self/limits': f'Max address space         {4 * GIGA}  unlimited  bytes\n',
        'proc/self/status': f'Name:\tone\nVmSize:\t {2**20} kB\n'})
    assert free_memory(root) == 3 * GIGA


def test_a_solve_may_take_most_of_it(monkeypatch):
    monkeypatch.setattr(memory, '_reader', memory._reader)
    memory.measure_by(lambda: 10.0)
    assert 8 <= memory.free() < 10


@pytest.mark.skipif('CS_GNU_LIBC_VERSION' not in os.confstr_names, reason='not by glibc')
def test_freed_memory_serves_the_next_array():
    assert printed_by(ARRAYS) < 100


@pytest.mark.skipif('CS_GNU_LIBC_VERSION' not in os.confstr_names, reason='not by glibc')
def test_a_process_that_runs_for_long_gives_arrays_back():
    assert printed_by(GIVEN_BACK) < 500


def printed_by(code):
    """Run Python code in a process of its own; return the number that it prints."""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          check=True)
    return int(done.stdout)
