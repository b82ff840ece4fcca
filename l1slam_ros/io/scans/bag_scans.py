# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Reading the laser scans of a bag, the wheel odometry at their stamps, and the pose of the laser.

That pose is read from /tf_static, from the robot's frame (the `child_frame_id` of the odometry) to
that of the scans; without it the laser is taken to be at the robot's origin, with a warning.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from l1slam_ros.core.errors import FileError, MessageError
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.scans.points import Mount, Scan
from l1slam_ros.io.bags.reader import bag_summary, read_messages
from l1slam_ros.io.files import counted
from l1slam_ros.io.messages.conversion import odometry_sample, stamp_of
from l1slam_ros.io.scans.laser_log import LaserLog, wheels_at
from l1slam_ros.io.scans.log_stamps import not_falling, set_forward

SCAN = 'sensor_msgs/msg/LaserScan'
_STATIC = '/tf_static'


def read_bag_scans(path: Path, odom_topic: str, scan_topic: str) -> LaserLog:
    """
    Read the scans of a bag.

    Raises
    ------
    FileError : the bag cannot be read, or has no scans, or no odometry around any.

    """
    taken = _Taken()
    damage: list[str] = []
    for message in read_messages(path, (odom_topic, scan_topic, _STATIC), damage.append):
        taken.take(message.topic == scan_topic, message)
    if not taken.scans:
        others = [topic.name for topic in bag_summary(path).topics if topic.msgtype == SCAN]
        raise FileError(path, f'no scans on {scan_topic}; expected {SCAN}' + (
            f', which is on {", ".join(others)}' if others else ''))
    if len(taken.stamps) < 2:
        raise FileError(path, f'{counted(len(taken.stamps), "message")} of odometry on '
                        f'{odom_topic}; expected 2 or more')
    stamps, scans, shifted = taken.in_order()
    rows = not_falling(stamps.tolist())
    # Of messages with one stamp the first is used: nothing lies between them.
    rows = rows[np.unique(stamps[rows], return_index=True)[1]]
    stamps, poses = stamps[rows], np.array(taken.poses)[rows]
    wheels, found = wheels_at(stamps, poses, np.array([scan.stamp for scan in scans]))
    if not len(found):
        raise FileError(path, f'no scan on {scan_topic} lies between two messages on '
                        f'{odom_topic}; expected stamps of one clock')
    out = len(taken.scans) - len(found)
    skipped = [f'{counted(out, "scan")} left out: no odometry surrounds them'] if out else []
    mount, said = taken.mount()
    used = [scans[row] for row in found]
    ends = np.array([min(scan.stamp + max(scan.duration, 0), stamps[-1]) for scan in used])
    ahead, _ = wheels_at(stamps, poses, ends)
    used = [scan.driven(start, end, (last - scan.stamp) * 1e-9) if last > scan.stamp else scan
            for scan, start, end, last in zip(used, wheels, ahead, ends.tolist(), strict=True)]
    return LaserLog(used, wheels, mount, (*shifted, *skipped, *said, *taken.refused),
                    '; '.join(damage))


class _Taken:
    """The scans, odometry and transforms that were read so far."""

    def __init__(self) -> None:
        self.scans: list[Scan] = []
        self.stamps: list[int] = []
        self.poses: list[Array] = []
        # Of each scan, how many messages of odometry stand before it in the bag.
        self._before: list[int] = []
        self.refused: list[str] = []
        self._frame = self._base = ''
        self._transforms: dict[str, tuple[str, Array]] = {}

    def take(self, is_scan: bool, message: Any) -> None:
        """Add a message; the first malformed one is reported."""
        try:
            if message.topic == _STATIC:
                for found in message.data.transforms:
                    self._transforms[found.child_frame_id] = (
                        found.header.frame_id, _pose3(found.transform))
            elif is_scan:
                self._frame = message.data.header.frame_id.removeprefix('/')
                self.scans.append(scan_of(message.data))
                self._before.append(len(self.stamps))
            else:
                sample = odometry_sample(message.data)
                self._base = sample.frame.removeprefix('/')
                self.stamps.append(sample.stamp)
                self.poses.append(se2.from_pose3(sample.pose3[None])[0])
        except (MessageError, AttributeError, TypeError, ValueError) as error:
            sentence = f'a message on {message.topic} is refused: {error}'
            if sentence not in self.refused:
                self.refused.append(sentence)

    def in_order(self) -> tuple[Indices, list[Scan], tuple[str, ...]]:
        """Return the stamps of the odometry, the scans in order, and what is said of them."""
        stamps = np.array(self.stamps, np.int64)
        going_on, back = set_forward(stamps)
        if not back:
            return stamps, sorted(self.scans, key=lambda scan: scan.stamp), ()
        # A scan is of the same clock as the odometry before it.
        shifts = (going_on - stamps)[np.maximum(np.array(self._before) - 1, 0)]
        scans = [replace(scan, stamp=scan.stamp + shift)
                 for scan, shift in zip(self.scans, shifts.tolist(), strict=True)]
        return going_on, [scans[row] for row in not_falling([scan.stamp for scan in scans])], (
            f'the clock was set back by {back * 1e-9:.1f} s in all; stamps are shifted to undo '
            'that',)

    def mount(self) -> tuple[Mount, tuple[str, ...]]:
        """Return the pose of the laser on the robot, and sentences on it."""
        pose = se3.identity(1)
        frame = self._frame
        for _ in self._transforms:
            if frame in (self._base, '') or frame not in self._transforms:
                break
            frame, transform = self._transforms[frame]
            pose = se3.compose(transform[None], pose)
        if frame != self._base and self._frame:
            return Mount(), (
                f'{_STATIC} does not lead from {self._base!r} to {self._frame!r}; the laser is '
                'taken to be where the robot is',)
        R = se3.rotation(pose)[0]
        return Mount(float(pose[0, 0]), float(pose[0, 1]), math.atan2(R[1, 0], R[0, 0]),
                     bool(R[2, 2] < 0)), ()


def scan_of(message: Any) -> Scan:
    """
    Return what a sensor_msgs/LaserScan says.

    Raises
    ------
    ValueError : it is not a scan.

    """
    ranges = np.asarray(message.ranges, float)
    values = [float(value) for value in (
        message.angle_min, message.angle_increment, message.range_min, message.range_max,
        message.time_increment)]
    if len(ranges) < 2 or not all(map(math.isfinite, values[:2])) or not values[1]:
        raise ValueError(f'a scan of {counted(len(ranges), "ray")}, every {values[1]} rad')
    return Scan(stamp_of(message.header), ranges, *values)


def _pose3(transform: Any) -> Array:
    t, q = transform.translation, transform.rotation
    return np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w])
