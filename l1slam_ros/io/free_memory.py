# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How much memory this process can still take: of the machine, its control groups and its own limit.

In: files of Linux in /proc and /sys. Out: bytes; infinite where there are no such files.
"""

import ctypes
import math
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_ROOT = Path('/')
# Below the folder of a group: its limit and what it uses, of version 2 and of version 1; and what
# of that is kept for files and given back when it is needed.
_LIMITS = (('memory.max', 'memory.current', 'inactive_file'),
           ('memory.limit_in_bytes', 'memory.usage_in_bytes', 'total_inactive_file'))
# Settings of glibc's mallopt: how many arrays may be memory of their own; the size from which one
# is; and from how many bytes on what is free at the end is given back. By default glibc raises the
# last two, to tens of megabytes a thread.
_MMAP_MAX = -4
_MMAP_THRESHOLD = -3
_TRIM_THRESHOLD = -1
_KEPT = 2**30
# [bytes] From this size on NumPy asks for huge pages: fresh ones cost as little as reused ones.
_HUGE = 2**22


def free_memory(root: Path = _ROOT) -> float:
    """Return the bytes that a process can take; root : of the file system."""
    match = re.search(r'^MemAvailable:\s+([0-9]+) kB', _text(root / 'proc/meminfo'), re.MULTILINE)
    available = 1024.0 * int(match[1]) if match else math.inf
    return min([available, _left_of_address_space(root),
                *(_left(folder) for folder in _groups(root))])


def keep_freed_memory() -> None:
    """
    Let the process keep what is freed for its next arrays.

    An array of some megabytes is else new memory of the system each time: to be given its pages
    takes longer than the sums that it is for.
    """
    _set({_MMAP_MAX: 0, _TRIM_THRESHOLD: _KEPT})


def give_back_freed_memory() -> None:
    """Let a process that runs for long, with a map, give back what is freed of large arrays."""
    # The ratio that glibc itself keeps between the two.
    _set({_MMAP_THRESHOLD: _HUGE, _TRIM_THRESHOLD: 2 * _HUGE})


def _set(options: dict[int, int]) -> None:
    """Set options of `mallopt`, as far as the C library is glibc."""
    with suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        for option, value in options.items():
            mallopt(option, value)


def _left_of_address_space(root: Path) -> float:
    """Return what a limit of the process's own leaves [B]."""
    match = re.search(r'^Max address space +([0-9]+)', _text(root / 'proc/self/limits'),
                      re.MULTILINE)
    taken = re.search(r'^VmSize:\s+([0-9]+) kB', _text(root / 'proc/self/status'), re.MULTILINE)
    return float(int(match[1]) - (1024 * int(taken[1]) if taken else 0)) if match else math.inf


def _groups(root: Path) -> Iterator[Path]:
    """Yield the folder of each control group of memory that this process is in."""
    for line in _text(root / 'proc/self/cgroup').splitlines():
        _, _, rest = line.partition(':')
        controllers, _, name = rest.partition(':')
        mounted = {'': 'sys/fs/cgroup', 'memory': 'sys/fs/cgroup/memory'}.get(controllers)
        if mounted is None:
            continue
        top = root / mounted
        folder = top / name.strip('/')
        # A container sees its own group as the root, whatever its name is outside.
        yield top
        while folder != top and top in folder.parents:
            yield folder
            folder = folder.parent


def _left(folder: Path) -> float:
    """Return what the limit of a control group leaves [B]."""
    for limit, used, kept in _LIMITS:
        most = _text(folder / limit).strip()
        if most.isdigit():
            match = re.search(rf'^{kept} ([0-9]+)', _text(folder / 'memory.stat'), re.MULTILINE)
            return float(int(most) - int(_text(folder / used) or 0)
                         + (int(match[1]) if match else 0))
    return math.inf


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ''
