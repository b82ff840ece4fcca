# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Reading CARMEN logs: text with one message a line, packed by bz2 or gzip or not.

    FLASER n r_1 ... r_n  x y theta  odom_x odom_y odom_theta  stamp host logger_stamp
    ROBOTLASER1 type start_angle field_of_view resolution maximum_range accuracy remission_mode
        n r_1 ... r_n  m remission_1 ... remission_m  x y theta  odom_x odom_y odom_theta
        tv rv forward side axis  stamp host logger_stamp

If a log has both kinds, the more frequent one is read. A line has n ranges [m], in FLASER over 180
degrees (for even n the first and last ray are half a step inside), the poses of the laser and of
the robot by wheel odometry, and the stamp of the message [s]. A range may be NaN.
"""

import bz2
import gzip
import math
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans.points import Mount, Scan
from l1slam_ros.io.bounded import check_unpacked
from l1slam_ros.io.files import LARGEST, counted, stamp_from_text
from l1slam_ros.io.scans.laser_log import LaserLog
from l1slam_ros.io.scans.log_stamps import rising

_OPEN: dict[str, Callable[[Path, str], Any]] = {'.bz2': bz2.open, '.gz': gzip.open}
# [m] The laser of CARMEN gives this range, or more, if nothing is in range.
_FAR = 80.0
# Fractions of the largest range, see `_farthest`; and the least count of that range.
_TOP = 0.98
_BELOW = 0.88
_OFTEN = 20
# [m], [rad] Variation of the pose of a fixed laser, by rounding and because its pose is older.
_FIXED = np.array((0.05, 0.05, 0.05))
# A longer line is not a message of a laser.
_LONGEST = 1 << 18


@dataclass(frozen=True)
class _Line:
    """A scan, and the poses of laser and robot by wheel odometry, (3,) each."""

    scan: Scan
    laser: Array
    robot: Array


def read_carmen(path: Path) -> LaserLog:
    """
    Read a log; scans whose lines are damaged are left out.

    Raises
    ------
    FileError : it cannot be read, holds no scans, or has more damaged ones than others.

    """
    damage: list[str] = []
    found: dict[bytes, list[_Line]] = {kind: [] for kind in _READ}
    wrong = 0
    for number, line in _lines(path, damage):
        kind = line[: line.find(b' ')]
        if kind not in _READ:
            continue
        try:
            found[kind].append(_READ[kind](line.split()))
        except (ValueError, IndexError, ArithmeticError):
            wrong += 1
            if wrong == 1:
                damage.append(f'line {number}: expected {_EXPECTED[kind]}; found {line[:40]!r}')
    lines = max(found.values(), key=len)
    if wrong >= max(len(lines), 1):
        raise FileError(path, damage[0])
    if not lines:
        raise FileError(path, 'holds no FLASER or ROBOTLASER1 line; expected a CARMEN log with '
                        'laser scans')
    if wrong > 1:
        damage.append(f'{wrong:,} scans are damaged like that')
    return _log(lines, f'{path}: {"; ".join(damage)}' if damage else '')


def _log(lines: list[_Line], damage: str) -> LaserLog:
    said = []
    stamps, rows, back = rising(np.array([line.scan.stamp for line in lines], np.int64))
    if back:
        said.append(f'the clock was set back by {back * 1e-9:.1f} s in all; stamps are shifted '
                    'to undo that')
    if out := len(lines) - len(rows):
        said.append(f'{counted(out, "scan")} left out: their stamps are not in the order of the '
                    'file')
    scans = [line.scan for line in lines]
    if (farthest := _farthest(scans)) < np.inf:
        said.append(f'ranges of {farthest:.2f} m and more are taken to mean "nothing in range"')
    scans = [replace(scans[row], stamp=stamp, range_max=min(farthest, scans[row].range_max))
             for row, stamp in zip(rows, stamps.tolist(), strict=True)]
    robots = np.array([line.robot for line in lines])
    mount = se2.between(robots, np.array([line.laser for line in lines]))
    middle = np.median(mount, axis=0)
    if (np.median(abs(mount - middle), axis=0) > _FIXED).any():
        said.append('the pose of the laser on the robot varies; it is taken to be the pose of '
                    'the robot')
        middle = np.zeros(3)
    return LaserLog(scans, robots[rows], Mount(*middle.tolist()), tuple(said), damage)


def _farthest(scans: list[Scan]) -> float:
    """
    Return the range [m] that means "nothing in range" although no limit says so, or infinity.

    Lasers give one value, the greatest, if they see nothing. Real surfaces near the largest range
    are fewer than at shorter ranges, and not at one distance.
    """
    ranges = np.concatenate([scan.ranges[scan.ranges < scan.range_max] for scan in scans])
    last = ranges.max(initial=0.0)
    most = np.unique(ranges[ranges >= _TOP * last], return_counts=True)[1].max(initial=0)
    below = ((ranges >= _BELOW * last) & (ranges < _TOP * last)).sum()
    return float(_TOP * last) if most > max(below, _OFTEN) else np.inf


def _lines(path: Path, damage: list[str]) -> Iterator[tuple[int, bytes]]:
    """Yield the lines with their numbers; append to `damage` if the file ends too early."""
    opened = _OPEN.get(path.suffix.lower(), Path.open)
    number = unpacked = 0
    size = path.stat().st_size
    try:
        with opened(path, 'rb') as file:
            while line := file.readline(_LONGEST):
                number += 1
                unpacked += len(line)
                check_unpacked(path, size, unpacked)
                yield number, line
    except (OSError, EOFError, zlib.error) as error:
        if not number:
            raise FileError(path, f'cannot be read: {error}') from error
        damage.append(f'cannot be read beyond line {number:,}: {error}')


def _flaser(words: list[bytes]) -> _Line:
    count = int(words[1])
    # 181 rays are at whole degrees, both ends included; 180 or 360 rays are half a step inside.
    step = math.pi / (count - 1 if count % 2 else count)
    return _line(words[2:], count, -0.5 * step * (count - 1), step, _FAR, 0, 0)


def _robotlaser(words: list[bytes]) -> _Line:
    start, _, step, farthest = np.array(words[2:6], float).tolist()
    count = int(words[8])
    remissions = int(words[9 + count])
    if not (math.isfinite(start) and math.isfinite(step) and step) or remissions < 0:
        raise ValueError
    return _line(words[9:], count, start, step, min(farthest, _FAR) if farthest > 0 else _FAR,
                 1 + remissions, 5)


_READ: dict[bytes, Callable[[list[bytes]], _Line]] = {
    b'FLASER': _flaser, b'ROBOTLASER1': _robotlaser}
_EXPECTED = {
    b'FLASER': 'FLASER, a number of ranges, so many ranges [m], six numbers of poses and a stamp '
    '[s]',
    b'ROBOTLASER1': 'ROBOTLASER1, seven numbers of the laser, a number of ranges, so many ranges '
    '[m], a number of remissions, so many of these, eleven numbers of the robot and a stamp [s]'}


def _line(words: list[bytes], count: int, start: float, step: float, farthest: float, skipped: int,
          after: int) -> _Line:
    """Parse a line; words : from the ranges on; skipped, after : numbers of words around poses."""
    first = count + skipped
    ranges = np.array(words[:count], float)
    poses = np.array(words[first : first + 6], float)
    stamp = stamp_from_text(words[first + 6 + after].decode())
    if count < 2 or len(poses) < 6 or not (abs(poses) <= LARGEST).all():
        raise ValueError
    return _Line(Scan(stamp, ranges, start, step, 0.0, farthest), poses[:3],
                 poses[3:])
