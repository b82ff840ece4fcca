# SPDX-License-Identifier: Apache-2.0
"""
A nav_msgs/Odometry straight from its bytes: in a tenth of the time that rclpy takes for it.

CDR, as ROS 2 puts messages on the wire: four bytes say the byte order, then each number stands at
a multiple of its size, a string behind its length, with a closing zero.
"""

import struct

import numpy as np

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.graph.measurements import OdometrySample
from l1slam_ros.io.messages.conversion import sound_pose3, sound_stamp

# The second byte of the four: plain CDR, most or least significant byte first.
_ORDERS = {0: '>', 1: '<'}
# Position, orientation; then the covariance of the pose, the twist, and its covariance.
_DOUBLES = 7 + 36 + 6 + 36


def odometry(data: bytes) -> tuple[str, OdometrySample]:
    """
    Return whose odometry some bytes are, by its `child_frame_id`, and what they say.

    Raises
    ------
    MessageError : they break off, or are no CDR, or cannot be used.

    """
    order = _ORDERS.get(data[1]) if len(data) > 4 and not data[0] else None
    if order is None:
        raise MessageError('encoding', f'odometry that begins with {data[:4].hex()}; expected CDR')
    try:
        seconds, nanoseconds, length = struct.unpack_from(order + 'iII', data, 4)
        child_at = 16 + length + -length % 4
        (length,) = struct.unpack_from(order + 'I', data, child_at)
        end = child_at + 4 + length
        child = data[child_at + 4 : end - 1].decode(errors='replace')
        # Eight bytes count from behind the first four.
        numbers = np.frombuffer(data, order + 'f8', _DOUBLES, end + (4 - end) % 8).astype(float)
    except (struct.error, ValueError) as error:
        raise MessageError('encoding', f'odometry of {len(data)} bytes; expected more') from error
    x, y, z, *quaternion = numbers[:7].tolist()
    return child, OdometrySample(
        sound_stamp(seconds, nanoseconds), sound_pose3((x, y, z), tuple(quaternion)),
        numbers[7:43].reshape(6, 6), numbers[49:].reshape(6, 6))
