# SPDX-License-Identifier: Apache-2.0
"""Bytes of a Path made without its objects are the Path that ROS reads."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message

from l1slam_ros.ros.publishing import path_bytes, pose_bytes, transform_stamped


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


def test_a_pose_and_a_transform_hold_the_same_numbers():
    pose3 = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.4])
    pose = deserialize_message(pose_bytes('map', 2_000_000_003, pose3), PoseStamped)
    transform = transform_stamped('map', 'odom', 2_000_000_003, pose3)
    assert numbers(pose.pose) == pose3.tolist()
    t, r = transform.transform.translation, transform.transform.rotation
    assert [t.x, t.y, t.z, r.x, r.y, r.z, r.w] == pose3.tolist()
    assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'odom')
    assert pose.header.stamp == transform.header.stamp
    assert (pose.header.stamp.sec, pose.header.stamp.nanosec) == (2, 3)
