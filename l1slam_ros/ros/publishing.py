# SPDX-License-Identifier: Apache-2.0
"""Poses -> messages: pure functions of arrays and stamps."""

import struct

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from std_msgs.msg import Header

from l1slam_ros.core.geometry.manifold import Array, Indices

_SECOND = 1_000_000_000
# CDR, little endian; what follows is aligned relative to the end of these four bytes.
_ENCAPSULATION = b'\x00\x01\x00\x00'


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
    start: bytes = _header(frame, stamp)
    start += b'\0' * (-len(start) % 4) + struct.pack('<I', len(stamps))
    if not len(stamps):
        return _ENCAPSULATION + start
    start += _header(frame, int(stamps[0]))
    start += b'\0' * (-len(start) % 8)
    name = _string(frame)
    record = np.dtype([('pose', '<f8', 7), ('seconds', '<i4'), ('nanoseconds', '<u4'),
                       ('frame', f'V{len(name) + (-len(name) - 8) % 8}')])
    records = np.zeros(len(stamps), record)
    records['pose'] = pose3
    seconds, nanoseconds = np.divmod(stamps, _SECOND)
    records['seconds'][:-1] = seconds[1:]
    records['nanoseconds'][:-1] = nanoseconds[1:]
    records['frame'] = np.void(name.ljust(record['frame'].itemsize, b'\0'))
    body: bytes = records.tobytes()
    return _ENCAPSULATION + start + body[: -(record.itemsize - 56)]


def pose_bytes(frame: str, stamp: int, pose3: Array) -> bytes:
    """Return a serialised geometry_msgs/PoseStamped: one pose (7,) at one time [ns]."""
    start = _header(frame, stamp)
    return b''.join((_ENCAPSULATION, start, b'\0' * (-len(start) % 8), pose3.tobytes()))


def transform_stamped(parent: str, child: str, stamp: int, pose3: Array) -> TransformStamped:
    """Return the pose (7,) of the child frame in the parent frame as a transform."""
    message = TransformStamped(header=header(parent, stamp), child_frame_id=child)
    translation, rotation = message.transform.translation, message.transform.rotation
    translation.x, translation.y, translation.z = pose3[:3].tolist()
    rotation.x, rotation.y, rotation.z, rotation.w = pose3[3:].tolist()
    return message


def header(frame: str, stamp: int) -> Header:
    """Return a header with its stamp [ns]."""
    seconds, nanoseconds = divmod(int(stamp), _SECOND)
    return Header(frame_id=frame, stamp=Time(sec=seconds, nanosec=nanoseconds))


def _string(text: str) -> bytes:
    """Return a CDR string: its length with the closing zero, its characters."""
    data = text.encode() + b'\0'
    return struct.pack('<I', len(data)) + data


def _header(frame: str, stamp: int) -> bytes:
    seconds, nanoseconds = divmod(stamp, _SECOND)
    return struct.pack('<iI', seconds, nanoseconds) + _string(frame)
