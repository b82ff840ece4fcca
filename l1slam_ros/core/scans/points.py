# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
From a laser scan to points with normals, in the frame of the robot.

In: ranges as the laser gave them, where it is mounted, and how the robot moved meanwhile. Out:
points at equal distances along what was seen, each with the normal of its surface, and the view:
how far was seen in each direction.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask

# Bearings of a view.
_BEARINGS = 720


@dataclass(frozen=True)
class Scan:
    """
    One turn of a laser.

    stamp : of the first ray [ns]; ranges : (r,) [m]; angle_min, angle_increment : of the rays
    [rad], counter-clockwise; range_min, range_max : ranges outside are of no surface [m];
    time_increment : between rays [s]; velocity : (3,) of the robot while it scanned, by its
    wheels, in its own frame [m/s, m/s, rad/s]; None: nobody has looked
    """

    stamp: int
    ranges: Array
    angle_min: float
    angle_increment: float
    range_min: float = 0.0
    range_max: float = np.inf
    time_increment: float = 0.0
    velocity: Array | None = field(default=None, kw_only=True)

    @property
    def duration(self) -> int:
        """How long it took from the first ray to the last [ns]."""
        return round(1e9 * self.time_increment * (len(self.ranges) - 1))

    def driven(self, start: Array, end: Array, seconds: float) -> 'Scan':
        """Return it with the velocity between two poses (3,), so long one after the other."""
        return replace(self, velocity=se2.between(start[None], end[None])[0] / seconds)


@dataclass(frozen=True)
class Mount:
    """Where the laser is in the robot's frame: x, y [m], yaw [rad]; upside_down : it hangs."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    upside_down: bool = False


@dataclass(frozen=True)
class Points:
    """
    What a scan has seen, in the robot's frame at the scan's stamp.

    xy : (n, 2) [m]; normals : (n, 2) of length 1, turned to the robot, zero where there is none;
    centre : (2,) where the laser was [m]; view : (b,) the nearest range from there in each of b
    equal bearings from 0 to 2 pi [m], infinite where the laser looked and nothing was in range,
    NaN where it did not look
    """

    xy: Array
    normals: Array
    centre: Array
    view: Array

    @property
    def surface(self) -> tuple[Array, Array]:
        """The points that have a normal, and these normals, (k, 2) each."""
        has = have_normal(self.normals)
        return self.xy[has], self.normals[has]

    @cached_property
    def reach(self) -> float:
        """How far from the robot the farthest of them is [m]."""
        return float(np.hypot(*self.xy.T).max(initial=0.0))


def points_of(scan: Scan, mount: Mount = Mount(),  # noqa: B008
              velocity: Array | None = None) -> Points:
    """
    Return the points of a scan.

    velocity : (3,) of the robot while it scanned, in its own frame [m/s, m/s, rad/s]: each ray is
    moved to where its point lies from the robot at the scan's stamp
    """
    ranges = np.ascontiguousarray(scan.ranges, float)
    turn = -1.0 if mount.upside_down else 1.0
    ray = np.arange(0.0, len(ranges))
    angles = mount.yaw + turn * (scan.angle_min + scan.angle_increment * ray)
    reach = np.where(np.isfinite(ranges), ranges, 0.0)
    ends = np.stack((mount.x + reach * np.cos(angles), mount.y + reach * np.sin(angles)), axis=1)
    if velocity is not None and scan.time_increment:
        ends = _at_stamp(ends, velocity, scan.time_increment * ray)
    bearings = np.floor(angles / (2 * np.pi) * _BEARINGS).astype(np.int64) % _BEARINGS
    centre = np.array([mount.x, mount.y])
    xy, normals, view = native.scan_points.points_of(
        ends, ranges, angles, bearings, _BEARINGS, max(scan.range_min, 0.0), scan.range_max,
        abs(scan.angle_increment), centre)
    return Points(xy, normals, centre, view)


def _at_stamp(xy: Array, velocity: Array, seconds: Array) -> Array:
    """Return points seen so many seconds after the stamp, from where the robot was at it."""
    angle = velocity[2] * seconds
    c, s = np.cos(angle), np.sin(angle)
    x = c * xy[:, 0] - s * xy[:, 1] + velocity[0] * seconds
    y = s * xy[:, 0] + c * xy[:, 1] + velocity[1] * seconds
    return np.stack((x, y), axis=1)


def have_normal(normals: Array) -> Mask:
    """Return which of some normals (n, 2) are not zero."""
    return (normals[:, 0] != 0) | (normals[:, 1] != 0)


def transformed(pose: Array, xy: Array) -> Array:
    """Return points (n, 2) of the frame at a pose (3,), in the frame of that pose."""
    return rotated(pose, xy) + pose[:2]


def rotated(pose: Array, vectors: Array) -> Array:
    """Return vectors (n, 2) of the frame at a pose (3,), turned to that of the pose."""
    return vectors @ turn(pose[2])


def turn(angle: float) -> Array:
    """Return what rows of vectors are multiplied by to turn them by an angle [rad], (2, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s], [-s, c]])
