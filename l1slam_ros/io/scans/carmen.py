# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
CARMEN logs: text, one message a line, the logs of the field.

    FLASER n r_1 ... r_n  x y theta  odom_x odom_y odom_theta  stamp host logger_stamp

n ranges [m] over 180 degrees (the first and last ray half a step inside where n is even), the
pose of the laser and of the robot by the wheels, and the message's stamp [s]. Of all else in the
file only `PARAM robot_frontlaser_offset` is used. Compressed by bz2 or gzip, or plain.
"""

import bz2
import gzip
import math
from bisect import bisect_left
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.scans.points import Mount, Scan
from l1slam_ros.io.scans.laser_log import LaserLog

_OPEN: dict[str, Callable[[Path, str], Any]] = {'.bz2': bz2.open, '.gz': gzip.open}
# [m] CARMEN's laser says so, or more, where nothing is in range.
_FAR = 80.0
# A longer line is no message of a laser.
_LONGEST = 1 << 18
_SCAN = b'FLASER'


def read_carmen(path: Path) -> LaserLog:
    """
    Read a log.

    Raises
    ------
    FileError : it cannot be read, a line is damaged, or it holds no scans.

    """
    scans: list[Scan] = []
    wheels: list[list[float]] = []
    offsets: list[float] = []
    for number, line in _lines(path):
        if line.startswith(_SCAN + b' '):
            scan, robot, offset = _scan(path, number, line)
            scans.append(scan)
            wheels.append(robot)
            offsets.append(offset)
    if not scans:
        raise FileError(path, 'holds no FLASER line; expected a CARMEN log with laser scans')
    kept = _in_order([scan.stamp for scan in scans])
    out = len(scans) - len(kept)
    skipped = (f'{out:,} scans left out: their stamps are not in the order of the file',)
    return LaserLog([scans[k] for k in kept], np.array(wheels)[kept],
                    Mount(x=float(np.median(offsets))), skipped if out else ())


def _in_order(stamps: list[int]) -> list[int]:
    """Return the most places whose stamps rise: those left out were stamped late or early."""
    ends: list[int] = []  # of runs of each length the one that ends at the lowest stamp
    before = [-1] * len(stamps)
    for k, stamp in enumerate(stamps):
        at = bisect_left(ends, stamp, key=lambda end: stamps[end])
        before[k] = ends[at - 1] if at else -1
        ends[at : at + 1] = [k]
    kept, k = [], ends[-1]
    while k >= 0:
        kept.append(k)
        k = before[k]
    return kept[::-1]


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    opened = _OPEN.get(path.suffix.lower(), Path.open)
    try:
        with opened(path, 'rb') as file:
            number = 0
            while line := file.readline(_LONGEST):
                number += 1
                yield number, line
    except (OSError, EOFError) as error:
        raise FileError(path, f'cannot be read: {error}') from error


def _scan(path: Path, number: int, line: bytes) -> tuple[Scan, list[float], float]:
    """Return a scan, the robot's pose (3,) by the wheels, and how far ahead the laser is [m]."""
    words = line.split()
    try:
        count = int(words[1])
        values = np.array(words[2 : count + 8], float)
        stamp = round(float(words[count + 8]) * 1e9)
        if len(values) != count + 6 or count < 2 or not np.isfinite(values).all():
            raise ValueError
    except (ValueError, IndexError, OverflowError) as error:
        raise FileError(
            path, f'line {number}: expected FLASER, a number of ranges, so many ranges [m], six '
            f'numbers of poses and a stamp [s]; found {line[:40]!r}') from error
    ranges, laser, robot = values[:count], values[count : count + 3], values[count + 3 :]
    step = math.pi / count
    # 181 rays are at whole degrees, both ends included; 180 or 360 are half a step inside.
    if count % 2:
        step = math.pi / (count - 1)
    first = -0.5 * step * (count - 1)
    ahead = math.cos(robot[2]) * (laser[0] - robot[0]) + math.sin(robot[2]) * (
        laser[1] - robot[1])
    return Scan(stamp, ranges, first, step, 0.0, _FAR), robot.tolist(), float(ahead)
