# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Serialising poses to ROS messages (CDR, little endian) from arrays and stamps, without ROS.

For bags, and for messages that are large or published often: making the message objects takes
too long.
"""

import struct
from typing import TYPE_CHECKING

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.io.files import NANOSECONDS

if TYPE_CHECKING:  # it takes the compiled core along
    from l1slam_ros.core.scans.points import Scan

_ENCAPSULATION = b'\x00\x01\x00\x00'


def cdr(*parts: tuple[int, bytes | memoryview]) -> bytes:
    """Return a serialised message; each part begins at a multiple of its number of bytes."""
    data = bytearray()
    for multiple, part in parts:
        data += bytes(-len(data) % multiple)
        data += part
    return _ENCAPSULATION + data


def string_bytes(text: str) -> bytes:
    """Return a CDR string: its length with the closing zero, its characters."""
    data = text.encode() + b'\0'
    return struct.pack('<I', len(data)) + data


def header_bytes(frame: str, stamp: int) -> bytes:
    """Return a std_msgs/Header in CDR; stamp [ns]."""
    seconds, nanoseconds = divmod(stamp, NANOSECONDS)
    return struct.pack('<iI', seconds, nanoseconds) + string_bytes(frame)


def path_bytes(frame: str, stamp: int, stamps: Indices, pose3: Array) -> bytes:
    """
    Return a serialised nav_msgs/Path, made from one structured array: no object per pose.

    Each PoseStamped is a header (seconds, nanoseconds, length and characters of the frame) padded
    to a multiple of 8, then seven doubles. All poses after the first start at a multiple of 8
    and have one layout. Records are therefore cut one header later: (doubles of pose k, header
    of pose k + 1); the header of the first pose, whose padding differs, goes in front, and the
    last record's header is cut off.

    Parameters
    ----------
    frame : the frame of the path and of each pose
    stamp : of the path's own header [ns]
    stamps : (n,) of the poses [ns]
    pose3 : (n, 7) x y z qx qy qz qw

    """
    start = (4, header_bytes(frame, stamp)), (4, struct.pack('<I', len(stamps)))
    if not len(stamps):
        return cdr(*start)
    name = string_bytes(frame)
    record = np.dtype([('pose', '<f8', 7), ('seconds', '<i4'), ('nanoseconds', '<u4'),
                       ('frame', f'V{len(name) + (-len(name) - 8) % 8}')])
    records = np.zeros(len(stamps), record)
    records['pose'] = pose3
    seconds, nanoseconds = np.divmod(stamps, NANOSECONDS)
    records['seconds'][:-1] = seconds[1:]
    records['nanoseconds'][:-1] = nanoseconds[1:]
    records['frame'] = np.void(name.ljust(record['frame'].itemsize, b'\0'))
    body = memoryview(records.tobytes())[: -(record.itemsize - 56)]
    return cdr(*start, (4, header_bytes(frame, int(stamps[0]))), (8, body))


def pose_bytes(frame: str, stamp: int, pose3: Array, covariance: Array | None = None) -> bytes:
    """
    Return a serialised geometry_msgs/PoseStamped: one pose (7,) at one time [ns].

    covariance : (6, 6); with it the message is a PoseWithCovarianceStamped
    """
    rest = b'' if covariance is None else covariance.tobytes()
    return cdr((4, header_bytes(frame, stamp)), (8, pose3.tobytes() + rest))


def odometry_bytes(frame: str, child: str, stamp: int, pose3: Array, covariance: Array) -> bytes:
    """Return a serialised nav_msgs/Odometry: a pose (7,), its covariance (6, 6), no velocity."""
    # It begins like a TransformStamped.
    return transform_bytes(frame, child, stamp, np.concatenate(
        (pose3, covariance.ravel(), np.zeros(6 + 36))))


def scan_bytes(frame: str, scan: 'Scan') -> bytes:
    """Return a serialised sensor_msgs/LaserScan without intensities."""
    last = scan.angle_min + scan.angle_increment * (len(scan.ranges) - 1)
    numbers = (scan.angle_min, last, scan.angle_increment, scan.time_increment, 0.0,
               scan.range_min, scan.range_max)
    return cdr((4, header_bytes(frame, scan.stamp)), (4, struct.pack('<7f', *numbers)),
               (4, struct.pack('<I', len(scan.ranges))),
               (4, scan.ranges.astype('<f4').tobytes()), (4, struct.pack('<I', 0)))


def transform_bytes(parent: str, child: str, stamp: int, pose3: Array,
                    in_sequence: bool = False) -> bytes:
    """
    Return a serialised geometry_msgs/TransformStamped: the pose (7,) of the child in the parent.

    in_sequence : as a sequence of one transform, which is a tf2_msgs/TFMessage
    """
    return cdr((4, struct.pack('<I', 1) if in_sequence else b''), (4, header_bytes(parent, stamp)),
               (4, string_bytes(child)), (8, pose3.tobytes()))
