# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Odometry decoded from its bytes says what rclpy makes of them, and is refused when damaged."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message

from l1slam_ros.core.errors import MessageError
from l1slam_ros.io.messages.conversion import odometry_in, odometry_sample


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


@pytest.mark.parametrize('frame', ['', 'odom', 'robot/odom'])
@pytest.mark.parametrize('child', ['', 'base_link'])
def test_it_is_the_message_that_ros_sent(rng, frame, child):
    sent = message(rng, frame, child)
    (found, ours), theirs = odometry_in(serialize_message(sent)), odometry_sample(sent)
    assert (found, ours.frame) == (frame, child)
    assert ours.stamp == theirs.stamp == 12_000_000_345
    for name in ('pose3', 'covariance', 'twist_covariance'):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


def test_whatever_is_cut_off_is_refused(rng):
    data = serialize_message(message(rng))
    for length in range(len(data)):
        with pytest.raises(MessageError, match='odometry of .*; expected CDR') as refused:
            odometry_in(data[:length])
        assert refused.value.cause == 'encoding'


def test_nonsense_never_raises_anything_else(rng):
    data = serialize_message(message(rng))
    for _ in range(2000):
        spoilt = bytearray(data)
        for place in rng.integers(0, 48, 3):
            spoilt[place] = rng.integers(256)
        try:
            *_, sample = odometry_in(bytes(spoilt))
        except MessageError:
            continue
        assert sample.twist_covariance.shape == (6, 6)


def test_bytes_in_the_other_order_say_the_same(rng):
    """A writer on a machine whose bytes are the other way round."""
    codec = pytest.importorskip('rosbags.typesys')
    types = codec.get_typestore(codec.Stores.ROS2_JAZZY)
    little = serialize_message(message(rng))
    told = types.deserialize_cdr(little, 'nav_msgs/msg/Odometry')
    big = bytes(types.serialize_cdr(told, 'nav_msgs/msg/Odometry', little_endian=False))
    assert big[1] == 0 and little[1] == 1
    (frame, ours), (other, theirs) = odometry_in(little), odometry_in(big)
    assert (frame, ours.stamp, ours.frame) == (other, theirs.stamp, theirs.frame)
    for name in ('pose3', 'covariance', 'twist_covariance'):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


@pytest.mark.parametrize('begin', ['0003', '0007', 'ff01', '0100'])
def test_what_is_no_plain_cdr_is_refused(rng, begin):
    data = bytearray(serialize_message(message(rng)))
    data[:2] = bytes.fromhex(begin)
    with pytest.raises(MessageError, match='expected CDR'):
        odometry_in(bytes(data))
