# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Bytes of a message made without its objects are the message that ROS reads."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message
from rosbags.typesys import Stores, get_typestore

from l1slam_ros.io.messages.serialisation import path_bytes, pose_bytes, transform_bytes


def numbers(pose):
    p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


# Padding depends on the length of the frame's name: every remainder modulo 8 is tried.
@pytest.mark.parametrize('frame', ['', *('map_of_robot1'[:k] for k in range(1, 14))])
@pytest.mark.parametrize('n', [0, 1, 2, 5])
def test_ros_reads_the_path_that_was_meant(rng, frame, n):
    stamps = 10**18 + np.arange(n) * 123_456_789
    pose3 = rng.normal(size=(n, 7))
    path = deserialize_message(path_bytes(frame, 5_000_000_007, stamps, pose3), Path)
    assert path.header.frame_id == frame
    assert (path.header.stamp.sec, path.header.stamp.nanosec) == (5, 7)
    assert [p.header.frame_id for p in path.poses] == [frame] * n
    assert [p.header.stamp.sec * 10**9 + p.header.stamp.nanosec
            for p in path.poses] == stamps.tolist()
    assert [numbers(p.pose) for p in path.poses] == pose3.tolist()


@pytest.mark.parametrize('frame', ['', *('map_of_robot1'[:k] for k in range(1, 14))])
def test_ros_reads_the_pose_that_was_meant(rng, frame):
    pose3 = rng.normal(size=7)
    pose = deserialize_message(pose_bytes(frame, 5_000_000_007, pose3), PoseStamped)
    assert (pose.header.frame_id, numbers(pose.pose)) == (frame, pose3.tolist())
    assert (pose.header.stamp.sec, pose.header.stamp.nanosec) == (5, 7)


@pytest.mark.parametrize('parent', ['', *('map_of_robot1'[:k] for k in range(1, 9))])
@pytest.mark.parametrize('child', ['', 'o', 'od', 'odo', 'odom'])
def test_ros_reads_the_transform_that_was_meant(rng, parent, child):
    pose3 = rng.normal(size=7)
    read = deserialize_message(
        transform_bytes(parent, child, 5_000_000_007, pose3), TransformStamped)
    t, r = read.transform.translation, read.transform.rotation
    assert [t.x, t.y, t.z, r.x, r.y, r.z, r.w] == pose3.tolist()
    assert (read.header.frame_id, read.child_frame_id) == (parent, child)
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == (5, 7)
    # tf2_msgs is not everywhere: a library that needs no such package reads the sequence.
    types = get_typestore(Stores.ROS2_JAZZY)
    (one,) = types.deserialize_cdr(transform_bytes(parent, child, 5_000_000_007, pose3, True),
                                   'tf2_msgs/msg/TFMessage').transforms
    assert (one.header.frame_id, one.child_frame_id) == (parent, child)
    assert one.transform.rotation.w == pose3[6]
