# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Converting the messages of `scan_loops` to records, and covariances back."""

import math
import struct
from contextlib import suppress
from typing import Any

import numpy as np
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.scans.points import Scan
from l1slam_ros.io.files import NANOSECONDS
from l1slam_ros.io.messages.conversion import stamp_of

# Least and largest number of rays of a scan.
_FEWEST, _MOST = 2, 100_000
_LITTLE_ENDIAN = b'\0\1'
_ROWS = np.array(se2.COVARIANCE_ROWS)


def scan_in(message: Any, range_max: float) -> Scan:
    """
    Convert a sensor_msgs/LaserScan; range_max : [m] a limit besides its own, 0: none.

    Raises
    ------
    MessageError : its stamp is invalid, or it has no rays.

    """
    stamp, count = stamp_of(message.header), len(message.ranges)
    numbers = (message.angle_min, message.angle_increment, message.range_min, message.range_max,
               message.time_increment)
    if not _FEWEST <= count <= _MOST or any(map(math.isnan, numbers)) or not (
            0 < abs(message.angle_increment) * (count - 1) <= 4 * math.pi):
        raise MessageError('scan', f'a scan of {count} rays every '
                           f'{message.angle_increment:g} rad; expected {_FEWEST} or more within a '
                           'turn')
    farthest = [limit for limit in (message.range_max, range_max) if limit > 0]
    increment = message.time_increment if 0 < message.time_increment < 1 else 0.0
    return Scan(stamp, np.array(message.ranges, float), message.angle_min,
                message.angle_increment, max(message.range_min, 0.0),
                min(farthest, default=math.inf), increment)


def path_in(data: bytes) -> tuple[str, Indices, Array]:
    """
    Return frame, stamps (n,) [ns] and poses (n, 3) of a serialised nav_msgs/Path.

    It is read by its layout if that is the one of `path_bytes`: rclpy's deserialisation takes some
    hundred times as long, and each update sends the whole path.
    """
    with suppress(struct.error, ValueError):
        if (found := _path_parts(data)) is not None:
            frame, stamps, pose3 = found
            return frame, stamps, se2.from_pose3(pose3)
    message = deserialize_message(data, Path)
    stamps = np.array([pose.header.stamp.sec * NANOSECONDS + pose.header.stamp.nanosec
                       for pose in message.poses], np.int64)
    pose3 = np.array([(p.position.x, p.position.y, p.position.z, p.orientation.x, p.orientation.y,
                       p.orientation.z, p.orientation.w)
                      for p in (pose.pose for pose in message.poses)]).reshape(-1, 7)
    return message.header.frame_id, stamps, se2.from_pose3(pose3)


def _path_parts(data: bytes) -> tuple[str, Indices, Array] | None:
    """Return frame, stamps and poses (n, 7) of a path; None if its poses differ in layout."""
    if bytes(data[:2]) != _LITTLE_ENDIAN:
        return None
    (length,) = struct.unpack_from('<I', data, 12)
    frame = bytes(data[16 : 15 + length]).decode()
    place = _aligned(16 + length, 4)
    (count,) = struct.unpack_from('<I', data, place)
    if not count:
        return None
    seconds, nanoseconds, own = struct.unpack_from('<iII', data, place + 4)
    # The numbers of a pose and the header of the next: see `path_bytes`.
    begin = _aligned(place + 16 + own, 8)
    record = np.dtype([('pose', '<f8', 7), ('seconds', '<i4'), ('nanoseconds', '<u4'),
                       ('length', '<u4'), ('frame', f'V{own + -(own + 12) % 8}')])
    records = np.frombuffer(bytes(data[begin:]) + bytes(record.itemsize - 56), record, count)
    if (records['length'][:-1] != own).any():
        return None
    stamps = np.empty(count, np.int64)
    stamps[0] = seconds * NANOSECONDS + nanoseconds
    stamps[1:] = records['seconds'][:-1].astype(np.int64) * NANOSECONDS + (
        records['nanoseconds'][:-1])
    return frame, stamps, records['pose'].astype(float)


def covariance_in(message: Any) -> tuple[int, Array]:
    """
    Return the stamp [ns] and covariance (3, 3) of a geometry_msgs/PoseWithCovarianceStamped.

    Raises
    ------
    MessageError : its stamp or its covariance is invalid.

    """
    stamp = stamp_of(message.header)
    covariance = np.array(message.pose.covariance).reshape(6, 6)[_ROWS[:, None], _ROWS]
    if not np.isfinite(covariance).all():
        raise MessageError('not_finite', 'a covariance that is not finite; expected one')
    return stamp, covariance


def whole(covariance: Array) -> Array:
    """Return the covariance (6, 6) of a message for one of the plane, (3, 3)."""
    found = np.zeros((6, 6))
    found[_ROWS[:, None], _ROWS] = covariance
    return found


def _aligned(place: int, size: int) -> int:
    """Return the next multiple of a size, counted from behind the first four bytes."""
    return place + (4 - place) % size
