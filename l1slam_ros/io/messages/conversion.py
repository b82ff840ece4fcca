# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Converting ROS messages of rclpy or rosbags to records, by their attributes; this needs no ROS.

A message that cannot be used raises `MessageError` with one of these causes:

    encoding     the bytes are not a message
    stamp        zero (never set), negative, or not a time
    not_finite   NaN or infinity in the pose
    range        the position is too far away to be meaningful
    quaternion   its norm is far from 1
    frame        a loop whose frame is not `<base_frame>@<sec>.<nanosec, 9 digits>`, an absolute
                 pose in another frame than that of the map
    order        a loop whose reference is not earlier than its stamp

Covariances are passed on unchecked: `graph_builder` decides whether to use them.
"""

import math
import re
import struct
from types import SimpleNamespace
from typing import Any

import numpy as np

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import silent_components
from l1slam_ros.core.graph.measurements import (
    FASTEST,
    LoopClosure,
    OdometrySample,
    sound_pose3,
)
from l1slam_ros.io.files import LAST_STAMP, NANOSECONDS, quoted, stamp_text

ABSOLUTE = 'absolute_poses'
LOOP_TOPICS = ('loop_closures', 'trusted_loop_closures', 'false_loop_closures', ABSOLUTE)
# Numbers in a nav_msgs/Odometry: pose and its covariance, twist and its covariance.
_ODOMETRY_ENTRIES = 7 + 36 + 6 + 36
_REFERENCE_FRAME = re.compile(
    r'/?(?P<base>.+)@(?P<seconds>[0-9]{1,10})\.(?P<nanoseconds>[0-9]{9})')


def odometry_sample(message: Any) -> OdometrySample:
    """
    Return a nav_msgs/Odometry message as a sample of odometry.

    Raises
    ------
    MessageError : it cannot be used.

    """
    return OdometrySample(
        stamp_of(message.header),
        _pose3(message.pose.pose),
        _covariance(message.pose.covariance),
        _covariance(message.twist.covariance),
        message.child_frame_id,
        (_size(message.twist.twist.linear), _size(message.twist.twist.angular)))


def odometry_in(data: bytes) -> tuple[str, OdometrySample]:
    """
    Return the frame of a serialised nav_msgs/Odometry, and its sample.

    The bytes are read by their layout, in a quarter of the time of rclpy's deserialisation.

    Raises
    ------
    MessageError : it is cut, is not CDR, or cannot be used.

    """
    try:
        stamp, frame, child, entries = _odometry_parts(data)
    except (struct.error, IndexError, ValueError) as error:
        raise MessageError('encoding', f'odometry of {len(data)} bytes that begin with '
                           f'{data[:4].hex()}; expected CDR') from error
    # x y z, quaternion, covariance; velocity, turn rate, covariance.
    pose, covariance, twist, twist_covariance = np.split(entries, (7, 43, 49))
    return frame, OdometrySample(
        _checked_stamp(*stamp), sound_pose3(tuple(pose[:3].tolist()), tuple(pose[3:].tolist())),
        _covariance(covariance), _covariance(twist_covariance), child,
        (_length(*twist[:3].tolist()), _length(*twist[3:].tolist())))


def _odometry_parts(data: bytes) -> tuple[tuple[int, int], str, str, Array]:
    """
    Return stamp, frame, child frame and the 85 numbers of a nav_msgs/Odometry in CDR (bytes).

    CDR begins with four bytes that give the byte order; each value is at a multiple of its
    own size from there. A string is its length with the closing zero, then its characters.
    """
    if data[0] or data[1] > 1:
        raise ValueError('no plain CDR')
    order = '<' if data[1] else '>'
    seconds, nanoseconds, length = struct.unpack_from(f'{order}iII', data, 4)
    frame, end = _text(data, 16, length)
    place = 4 + -(-(end - 4) // 4) * 4
    child, end = _text(data, place + 4, *struct.unpack_from(f'{order}I', data, place))
    place = 4 + -(-(end - 4) // 8) * 8
    entries = np.frombuffer(data, f'{order}f8', _ODOMETRY_ENTRIES, place).astype(float)
    return (seconds, nanoseconds), frame, child, entries


def _text(data: bytes, place: int, length: int) -> tuple[str, int]:
    """Return the string at `place`, and the place behind it; length : with its closing zero."""
    end = place + length
    if not length or data[end - 1]:
        raise ValueError('no string')
    return bytes(data[place: end - 1]).decode(), end


def loop_closure(message: Any, base_frame: str, trusted: bool,
                 ordered: bool = True) -> LoopClosure:
    """
    Return the loop closure in a geometry_msgs/PoseWithCovarianceStamped.

    Parameters
    ----------
    message : its `header.frame_id` names the earlier time, see `reference_frame_id`
    base_frame : the frame that must be named with it; empty: any
    trusted : whether a person or a marker vouches for it
    ordered : the reference must be earlier than the stamp; between two robots it need not be

    Raises
    ------
    MessageError : it cannot be used.

    """
    return LoopClosure(*_ends(message, base_frame, ordered), _pose3(message.pose.pose),
                       _covariance(message.pose.covariance), trusted)


def false_loop(message: Any, base_frame: str, ordered: bool = True) -> LoopClosure:
    """
    Return a loop closure that strikes out the loop of its two times, named as in `loop_closure`.

    The pose of the message is not read and may be left empty.

    Raises
    ------
    MessageError : it does not name two times.

    """
    return LoopClosure(*_ends(message, base_frame, ordered), np.array((0.0, 0, 0, 0, 0, 0, 1)),
                       np.zeros((6, 6)), struck=True)


def absolute_pose(message: Any, map_frame: str) -> LoopClosure:
    """
    Return the absolute pose of the robot in a geometry_msgs/PoseWithCovarianceStamped.

    If its covariance says that the rotation is not measured, the quaternion is not read.

    Parameters
    ----------
    message : its `header.frame_id` is the map frame
    map_frame : the name that this must be; empty: any

    Raises
    ------
    MessageError : it cannot be used.

    """
    stamp = stamp_of(message.header)
    frame = message.header.frame_id.removeprefix('/')
    if not frame or frame != (map_frame or frame):
        raise MessageError('frame', f'frame {quoted(frame)} of an absolute pose; expected '
                           f'{map_frame or "that of the map"}')
    covariance = _covariance(message.pose.covariance)
    position, rotation = message.pose.pose.position, message.pose.pose.orientation
    if silent_components(covariance[None], absolute=True)[0, 3:].all():
        rotation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    return LoopClosure(None, stamp, checked_pose3(position, rotation), covariance)


def loop_in(topic: str, message: Any, base_frame: str, map_frame: str,
            ordered: bool = True) -> LoopClosure:
    """
    Return the loop or absolute pose in a message on one of `LOOP_TOPICS`.

    base_frame, map_frame, ordered : see the functions above

    Raises
    ------
    MessageError : it cannot be used.

    """
    if topic == ABSOLUTE:
        return absolute_pose(message, map_frame)
    if topic == 'false_loop_closures':
        return false_loop(message, base_frame, ordered)
    return loop_closure(message, base_frame, topic == 'trusted_loop_closures', ordered)


def stamped_pose(message: Any) -> tuple[int, Array]:
    """
    Return the stamp [ns] and x y z qx qy qz qw (7,) of a message with a pose or a transform.

    A PoseStamped, PoseWithCovarianceStamped or TransformStamped of geometry_msgs, or an Odometry.

    Raises
    ------
    MessageError : it cannot be used.

    """
    if hasattr(message, 'transform'):
        pose3 = checked_pose3(message.transform.translation, message.transform.rotation)
    else:
        pose3 = _pose3(getattr(message.pose, 'pose', message.pose))
    return stamp_of(message.header), pose3


def reference_frame_id(base_frame: str, stamp: int) -> str:
    """Return the name of the robot's frame at a time [ns]: `<base_frame>@<sec>.<9 digits>`."""
    return f'{base_frame}@{stamp_text(stamp)}'


def stamp_of(header: Any) -> int:
    """
    Return the stamp of a std_msgs/Header [ns].

    Raises
    ------
    MessageError : it is zero, negative or not a time.

    """
    return _checked_stamp(int(header.stamp.sec), int(header.stamp.nanosec))


def _checked_stamp(seconds: int, nanoseconds: int) -> int:
    stamp = seconds * NANOSECONDS + nanoseconds
    if seconds < 0 or not 0 <= nanoseconds < NANOSECONDS or stamp == 0:
        raise MessageError('stamp', f'stamp {seconds} s {nanoseconds} ns; '
                           'expected a time after 0 with less than 1000000000 ns')
    return stamp


def checked_pose3(t: Any, q: Any) -> Array:
    """
    Return translation and quaternion as one array (7,), the quaternion normalised.

    Raises
    ------
    MessageError : they are not a pose.

    """
    return sound_pose3((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))


def _ends(message: Any, base_frame: str, ordered: bool) -> tuple[int, int]:
    """Return reference and stamp of a loop [ns]."""
    stamp = stamp_of(message.header)
    reference = reference_stamp(message.header.frame_id, base_frame)
    if ordered and reference >= stamp:
        raise MessageError('order', f'reference {stamp_text(reference)} of a loop; '
                           f'expected one earlier than its stamp {stamp_text(stamp)}')
    return reference, stamp


def reference_stamp(frame_id: str, base_frame: str) -> int:
    """
    Return the stamp [ns] that a reference frame names.

    base_frame : the robot's; empty: any

    Raises
    ------
    MessageError : it names none, or another frame.

    """
    match = _REFERENCE_FRAME.fullmatch(frame_id)
    expected = f'{base_frame or "<base_frame>"}@<sec>.<nanosec, 9 digits>'
    if match is None or (
            stamp := int(match['seconds'] + match['nanoseconds'])) > LAST_STAMP:
        raise MessageError('frame', f'frame {quoted(frame_id)} of a loop; expected {expected}')
    if base_frame and match['base'] != base_frame:
        raise MessageError('frame', f'frame {quoted(frame_id)} of a loop is of '
                           f'{quoted(match["base"])}; expected {expected}')
    return stamp


def _pose3(pose: Any) -> Array:
    """Return x y z qx qy qz qw (7,) of a geometry_msgs/Pose, the quaternion normalised."""
    return checked_pose3(pose.position, pose.orientation)


def _size(vector: Any) -> float:
    """Return the length of a geometry_msgs/Vector3; 0 if it is too large for a twist."""
    return _length(vector.x, vector.y, vector.z)


def _length(*components: float) -> float:
    length = math.hypot(*components)
    return length if length <= FASTEST else 0.0


def _covariance(entries: Any) -> Array:
    """Return 36 row-major entries as an array (6, 6), copied, as messages may be reused."""
    return np.array(entries, float).reshape(6, 6)
