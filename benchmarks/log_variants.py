# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Logs that differ from a recorded one as logs of others do: what is seldom, short, noisy or wrong.

In: a log with its corrected poses, a random generator. Out: another one, and its corrected poses.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.scans.points import Scan
from l1slam_ros.io.scans.laser_log import LaserLog

# [m] What CARMEN's laser says where nothing is in range, or more.
_NOTHING = 80.0
_SECOND = 10**9


@dataclass(frozen=True)
class TrueLog:
    """A log with its corrected poses, (m, 3) at stamps (m,) [ns]."""

    log: LaserLog
    stamps: Indices
    truth: Array

    def kept(self, rows: Indices) -> 'TrueLog':
        """Return it with some scans only."""
        log = self.log
        return replace(self, log=replace(
            log, scans=[log.scans[row] for row in rows], wheels=log.wheels[rows]))

    def changed(self, change: Callable[[Scan], Scan]) -> 'TrueLog':
        """Return it with each scan changed."""
        return replace(self, log=replace(self.log, scans=list(map(change, self.log.scans))))

    def driven(self, steps: Array) -> 'TrueLog':
        """Return it with other steps of the wheels, (n - 1, 3)."""
        wheels = [self.log.wheels[0]]
        for step in steps:
            wheels.append(se2.compose(wheels[-1][None], step[None])[0])
        return replace(self, log=replace(self.log, wheels=np.array(wheels)))

    @property
    def steps(self) -> Array:
        """The wheels' motion from scan to scan."""
        return se2.between(self.log.wheels[:-1], self.log.wheels[1:])

    @property
    def times(self) -> Indices:
        """The stamps of the scans."""
        return np.array([scan.stamp for scan in self.log.scans])


def _apart(metres: float) -> Callable[[TrueLog, np.random.Generator], TrueLog]:
    def kept(given: TrueLog, _: np.random.Generator) -> TrueLog:
        rows = [0]
        wheels = given.log.wheels
        for k, pose in enumerate(wheels):
            moved = abs(se2.between(wheels[rows[-1]][None], pose[None])[0])
            if np.hypot(moved[0], moved[1]) >= metres or moved[2] >= 0.5:
                rows.append(k)
        return given.kept(np.array(rows))
    return kept


def _of_ranges(change: Callable[[Array, np.random.Generator], Array]
               ) -> Callable[[TrueLog, np.random.Generator], TrueLog]:
    return lambda given, rng: given.changed(
        lambda scan: replace(scan, ranges=change(scan.ranges, rng)))


def _one_ray_of(n: int) -> Callable[[TrueLog, np.random.Generator], TrueLog]:
    return lambda given, _: given.changed(lambda scan: replace(
        scan, ranges=scan.ranges[::n], angle_increment=n * scan.angle_increment))


def _seen_within(metres: float) -> Callable[[TrueLog, np.random.Generator], TrueLog]:
    return _of_ranges(lambda ranges, _: np.where(ranges < metres, ranges, np.inf))


def _backwards(given: TrueLog, _: np.random.Generator) -> TrueLog:
    both = given.times[0] + given.times[-1]
    scans = [replace(scan, stamp=int(both - scan.stamp)) for scan in given.log.scans[::-1]]
    log = replace(given.log, scans=scans, wheels=given.log.wheels[::-1].copy())
    return TrueLog(log, (both - given.stamps)[::-1], given.truth[::-1])


def _mirrored(given: TrueLog, _: np.random.Generator) -> TrueLog:
    aside = np.array((1.0, -1.0, -1.0))
    scans = [replace(scan, ranges=scan.ranges[::-1].copy()) for scan in given.log.scans]
    log = replace(given.log, scans=scans, wheels=given.log.wheels * aside)
    return TrueLog(log, given.stamps, given.truth * aside)


def _worse_wheels(given: TrueLog, rng: np.random.Generator) -> TrueLog:
    """Let them drift by .05 rad/m, count a tenth too much, and stand still ten times for 2 s."""
    steps, times = given.steps, given.times[:-1]
    steps[:, 2] += 0.05 * np.hypot(steps[:, 0], steps[:, 1])
    steps[:, :2] *= 1.1
    for first in rng.choice(times, 10):
        steps[(times >= first) & (times < first + 2 * _SECOND)] = 0.0
    return given.driven(steps)


def _carried(given: TrueLog, _: np.random.Generator) -> TrueLog:
    """
    Leave out the way from a third of the log to its half, which the wheels do not count.

    Where the robot is in the next 10 s is not asked: by then it is noticed.
    """
    return _without(given, len(given.log.scans) // 3, len(given.log.scans) // 2)


def _without(given: TrueLog, first: int, last: int) -> TrueLog:
    """Leave out scans, and the way between them; see `_carried`."""
    steps = given.steps
    steps[first - 1 : last] = 0.0
    rows = np.r_[0:first, last : len(given.log.scans)]
    cut = (given.stamps > given.times[first - 1]) & (
        given.stamps < given.times[last] + 10 * _SECOND)
    return replace(given.driven(steps).kept(rows), stamps=given.stamps[~cut],
                   truth=given.truth[~cut])


def _carried_for(seconds: int) -> Callable[[TrueLog, np.random.Generator], TrueLog]:
    """Leave out some seconds after a third of the log, which the wheels do not count."""
    def carried(given: TrueLog, _: np.random.Generator) -> TrueLog:
        first = len(given.log.scans) // 3
        last = int(np.searchsorted(given.times, given.times[first - 1] + seconds * _SECOND))
        return _without(given, first, last)
    return carried


def _with_gaps(seconds: int) -> Callable[[TrueLog, np.random.Generator], TrueLog]:
    def kept(given: TrueLog, _: np.random.Generator) -> TrueLog:
        since = (given.times - given.times[0]) % (100 * _SECOND)
        return given.kept(np.flatnonzero(
            (since < 30 * _SECOND) | (since >= (30 + seconds) * _SECOND)))
    return kept


def _without_wheels(given: TrueLog, _: np.random.Generator) -> TrueLog:
    return given.driven(np.zeros_like(given.steps))


def _noisy(ranges: Array, rng: np.random.Generator) -> Array:
    off = np.maximum(ranges + 0.05 * rng.standard_normal(len(ranges)), 0.02)
    return np.where(ranges < _NOTHING, off, ranges)


def _random_rays(ranges: Array, rng: np.random.Generator) -> Array:
    anywhere = rng.random(len(ranges)) * np.minimum(ranges, 20.0)
    return np.where(rng.random(len(ranges)) < 0.1, anywhere, ranges)


def _glass(ranges: Array, rng: np.random.Generator) -> Array:
    return np.where(rng.random(len(ranges)) < 0.2, ranges + 6 * rng.random(len(ranges)), ranges)


def _hanging(given: TrueLog, _: np.random.Generator) -> TrueLog:
    """Let the laser hang upside down, which nobody says."""
    return given.changed(lambda scan: replace(scan, ranges=scan.ranges[::-1].copy()))


VARIANTS: dict[str, Callable[[TrueLog, np.random.Generator], TrueLog]] = {
    'as recorded': lambda given, _: given,
    'every fourth scan': lambda given, _: given.kept(np.arange(0, len(given.log.scans), 4)),
    'a scan each .5 m or .5 rad': _apart(0.5),
    'a scan each .75 m or .5 rad': _apart(0.75),
    'a scan each metre or .5 rad': _apart(1.0),
    'a scan each 1.5 m or .5 rad': _apart(1.5),
    'half of the rays': _one_ray_of(2),
    'a quarter of the rays': _one_ray_of(4),
    'nothing seen beyond 5 m': _seen_within(5.0),
    'nothing seen beyond 8 m': _seen_within(8.0),
    '5 cm of noise': _of_ranges(_noisy),
    'a tenth of the rays random': _of_ranges(_random_rays),
    'a fifth of the rays through glass': _of_ranges(_glass),
    'a laser that hangs unsaid': _hanging,
    'backwards in time': _backwards,
    'mirrored': _mirrored,
    'worse wheels': _worse_wheels,
    'carried away': _carried,
    'carried away for 20 s': _carried_for(20),
    'no scans for 5 s of 100': _with_gaps(5),
    'no scans for 20 s of 100': _with_gaps(20),
    'no wheels': _without_wheels,
}
