# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Bytes that the node reads and writes are what ROS makes of them, whatever their padding."""

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from messages import TYPES
from node_bench import EVERY_MESSAGE, call, odometry, poses_of, put, stamp_of
from rclpy.serialization import serialize_message
from records import information_of, read

ODOMETRY = 'nav_msgs/msg/Odometry'
NS = 10**9


def other_order(data):
    """Return odometry as a machine writes it whose bytes are the other way round."""
    big = bytes(TYPES.serialize_cdr(TYPES.deserialize_cdr(data, ODOMETRY), ODOMETRY,
                                    little_endian=False))
    assert big[1] == 0 and data[1] == 1
    return big


# Padding depends on the lengths of both frames: every remainder modulo 8 is tried.
@pytest.mark.parametrize('base', ['b', 'ba', 'bas', 'base', 'base_link'])
def test_odometry_says_what_ros_makes_of_it(bench, tmp_path, base):
    path = tmp_path / 'map.g2o'
    b = bench(save_path=str(path), autosave_period=0.0, **EVERY_MESSAGE)
    for k in range(9):
        message = odometry((k + 1) * NS + 345, 1.5 * k, base)
        message.header.frame_id = 'robot/odom'[:k + 1]
        put(message.pose.pose, (1.5 * k, -0.25 * k, 0.0), (0, 0, np.sin(k / 8), np.cos(k / 8)))
        message.pose.covariance = (np.diag([0.01, 0.02, 1, 1, 1, 0.04]) * (k + 1)).ravel()
        message.twist.twist.linear.x = 17.0
        data = serialize_message(message)
        b.send('/odom', [message, data, other_order(data)][k % 3])
    found = poses_of(b.map_of(9))
    assert b.path().poses[-1].header.stamp.nanosec == 345 and not b.refused()
    np.testing.assert_allclose(found[:, :2], np.outer(np.arange(9), (1.5, -0.25)), atol=1e-9)
    np.testing.assert_allclose(found[:, 2], np.arange(9) / 4, atol=1e-9)
    b.rest()
    assert call(b, 'save').success
    covariances = np.linalg.inv(information_of(read(path).graph))
    np.testing.assert_allclose(
        covariances, np.arange(2, 10)[:, None, None] * np.diag([0.01, 0.02, 0.04]), atol=1e-12)


def test_whatever_is_cut_off_or_nonsense_is_refused_and_nothing_else_happens(bench, rng):
    b = bench()
    b.send('/odom', odometry(NS, 0.0))
    data = serialize_message(odometry(2 * NS, 1.0))
    cuts = [data[:length] for length in range(8, len(data), 7)]
    other = [bytes.fromhex(begin) + data[2:] for begin in ('0003', '0007', 'ff01', '0100')]
    for spoilt in (*cuts, *other):
        b.send('/odom', spoilt)
    b.until(lambda: b.refused() == {'encoding': len(cuts) + len(other)}, 'all are refused')
    for _ in range(300):
        spoilt = bytearray(data)
        for place in rng.integers(4, 48, 3):
            spoilt[place] = rng.integers(256)
        b.send('/odom', bytes(spoilt))
    # What is still on its way when the map begins anew may be of any time.
    sent = 1 + len(cuts) + len(other) + 300
    b.until(lambda: b.count('odom.received') + b.count('odom.lost') >= sent, 'all have come')
    call(b, 'reset')
    b.send('/odom', odometry(3 * NS, 0.0))
    b.send('/odom', odometry(4 * NS, 1.0))
    b.map_of(2)


# Every remainder modulo 8.
@pytest.mark.parametrize('frame', ['map_of_robot'[:k] for k in range(1, 9)])
def test_ros_reads_path_pose_and_transform_as_they_were_meant(bench, frame):
    b = bench(map_frame=frame, odom_frame='odom_frame'[:len(frame) + 2], **EVERY_MESSAGE)
    b.drive(0, 2)
    b.map_of(2)
    b.until(lambda: len(b.received['pose']) == 2 and b.received['map_to_odom'], 'all is there')
    path, pose, transform = (b.received[name][-1] for name in ('path', 'pose', 'map_to_odom'))
    assert {one.header.frame_id for one in (path, pose, transform, *path.poses)} == {frame}
    assert [stamp_of(one.header) for one in path.poses] == [NS, 2 * NS]
    assert stamp_of(pose.header) == 2 * NS
    np.testing.assert_allclose(poses_of(path), [(0, 0, 0), (1, 0, 0)], atol=1e-9)
    assert isinstance(pose, PoseStamped) and pose.pose.position.x == pytest.approx(1)
    assert transform.child_frame_id == 'odom_frame'[:len(frame) + 2]
    assert transform.transform.rotation.w == pytest.approx(1)
