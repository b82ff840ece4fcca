# SPDX-License-Identifier: Apache-2.0
"""Odometry decoded from its bytes says what rclpy makes of them, and is refused when damaged."""

import struct

import numpy as np
import pytest

pytest.importorskip('rclpy')

from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from rosbags.typesys import Stores, get_typestore

from l1slam_ros.core.errors import MessageError
from l1slam_ros.io.messages import conversion
from l1slam_ros.io.messages.conversion import odometry_sample


def message(rng, frame='odom', child='base_link'):
    message = Odometry(child_frame_id=child)
    message.header.frame_id = frame
    message.header.stamp.sec, message.header.stamp.nanosec = 12, 345
    p, q = message.pose.pose.position, message.pose.pose.orientation
    p.x, p.y, p.z = rng.normal(size=3)
    q.x, q.y, q.z, q.w = (0.1, 0.5, 0.5, 0.7)
    message.pose.covariance = rng.normal(size=36)
    message.twist.twist.linear.x = 17.0
    message.twist.covariance = rng.normal(size=36)
    return message


def assert_same(decoded, message):
    (child, ours), theirs = decoded, odometry_sample(message)
    assert child == message.child_frame_id
    assert ours.stamp == theirs.stamp == 12_000_000_345
    for name in ('pose3', 'covariance', 'twist_covariance'):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


# Padding depends on the lengths of both names: every remainder modulo 8 is tried.
@pytest.mark.parametrize('frame', ['', *('robot/odom'[:k] for k in range(2, 10))])
@pytest.mark.parametrize('child', ['', *('robot/base'[:k] for k in range(2, 10))])
def test_it_is_the_message_that_ros_sent(rng, frame, child):
    sent = message(rng, frame, child)
    assert_same(conversion.odometry_in(serialize_message(sent)), sent)


def test_another_byte_order_is_read_too(rng):
    store, sent = get_typestore(Stores.ROS2_JAZZY), message(rng)
    ours = store.deserialize_cdr(bytes(serialize_message(sent)), 'nav_msgs/msg/Odometry')
    data = bytes(store.serialize_cdr(ours, 'nav_msgs/msg/Odometry', little_endian=False))
    assert data[1] == 0
    assert_same(conversion.odometry_in(data), sent)


def test_whatever_is_cut_off_is_refused(rng):
    data = serialize_message(message(rng))
    needed = len(data)
    for length in range(needed):
        with pytest.raises(MessageError) as refused:
            conversion.odometry_in(data[:length])
        assert refused.value.cause == 'encoding'


def test_nonsense_never_raises_anything_else(rng):
    data = bytearray(serialize_message(message(rng)))
    for _ in range(2000):
        spoilt = bytearray(data)
        for place in rng.integers(0, 48, 3):
            spoilt[place] = rng.integers(256)
        try:
            _, sample = conversion.odometry_in(bytes(spoilt))
        except MessageError:
            continue
        assert sample.twist_covariance.shape == (6, 6)
    struct.pack_into('<I', data, 12, 2**32 - 1)
    with pytest.raises(MessageError, match='expected more'):
        conversion.odometry_in(bytes(data))
