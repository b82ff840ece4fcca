# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What memory is free: of the machine, of control groups of both versions, of the process."""

import re

import pytest
from command import solve_json

KILO = 1024
MACHINE = {'/proc/meminfo': 'MemTotal: 9 kB\nMemAvailable:    400 kB\n'}


def group(line, folder, limit, used, kept):
    """Return the files of a control group with 300 kB, 200 of which are used, 100 for no need."""
    return MACHINE | {
        '/proc/self/cgroup': f'9:pids:/elsewhere\n{line}\n',
        f'{folder}/{limit}': f'{300 * KILO}\n', f'{folder}/{used}': f'{200 * KILO}\n',
        f'{folder}/memory.stat': f'rss 1\n{kept} {100 * KILO}\n'}


SECOND = 'memory.max', 'memory.current', 'inactive_file'
FIRST = 'memory.limit_in_bytes', 'memory.usage_in_bytes', 'total_inactive_file'


@pytest.mark.parametrize('files, free', [
    (MACHINE, 400),
    (MACHINE | {'/proc/self/cgroup': '0::/a/b\n', '/sys/fs/cgroup/a/memory.max': 'max\n'}, 400),
    # The limit of a group above counts, also of one that is not seen from here.
    (group('0::/a/b', '/sys/fs/cgroup/a', *SECOND), 200),
    (group('4:memory:/a/b', '/sys/fs/cgroup/memory/a', *FIRST), 200),
    (group('0::/not/seen/from/here', '/sys/fs/cgroup', *SECOND), 200),
    (MACHINE | {'/proc/self/limits': f'Max address space      {300 * KILO}  unlimited  bytes\n',
                '/proc/self/status': 'Name:\tone\nVmSize:\t 50 kB\n'}, 250)])
def test_a_solve_may_take_most_of_what_is_free(capsys, world, machine, files, free):
    machine(files)
    warning, = solve_json(capsys, world, '--outer', 1, code=4)['warnings']
    said = re.search(r'of memory, and (\S+) GB are free', warning)
    assert float(said[1]) == pytest.approx(0.9 * free * KILO / 1e9, rel=0.01)
