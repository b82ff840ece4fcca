# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The example front end, told of scans, makes the back end's map straight."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from headers import without_header

pytest.importorskip('rclpy')

from node_bench import header, odometry, poses_of
from sensor_msgs.msg import LaserScan

EXAMPLE = Path(__file__).parents[2] / 'config' / 'front_end.py'
RAYS = 360


def scan(stamp, yaw, place):
    """Return what a robot sees that looks along `yaw` from the middle of a room of its own."""
    angle = 2 * np.pi * np.arange(RAYS) / RAYS + yaw
    message = LaserScan(header=header('base_link', stamp), angle_increment=2 * np.pi / RAYS)
    message.ranges = (3 + place + np.sin(angle) + 0.5 * np.cos(3 * angle)).tolist()
    return message


def test_the_example_closes_a_loop_when_the_robot_is_back(bench):
    example = runpy.run_path(str(EXAMPLE))
    assert len(without_header(EXAMPLE).splitlines()) < 50
    b, front_end = bench(**{'robust.enabled': False}), example['FrontEnd']()
    b.executor.add_node(front_end)
    scans = b.peer.create_publisher(LaserScan, 'scan', 10)
    b.until(lambda: scans.get_subscription_count()
            and front_end.loops.get_subscription_count(), 'all are connected')
    # Out and back; the odometry says 0.4 m too much, and does not see the turn of 30 degrees.
    for k, x in enumerate([0.0, 5.0, 10.0, 5.0, 0.4]):
        stamp = (1 + 6 * k) * 10**9
        for step in range(5, 0, -1):  # no pause in the odometry
            b.send('/odom', odometry(stamp - step * 10**9, x - 0.1 * step))
        b.send('/odom', odometry(stamp, x))
        scans.publish(scan(stamp, np.pi / 6 if k == 4 else 0.0, x if k < 4 else 0.0))
    b.until(lambda: b.states()['accepted'] == 2, 'both loops are in the graph')
    assert [*b.loops()] == [(7 * 10**9, 19 * 10**9), (10**9, 25 * 10**9)]
    b.until(lambda: len(b.path().poses) and np.allclose(
        poses_of(b.path())[-1], [0, 0, np.pi / 6], atol=0.05), 'the map knows where it ends')
    b.executor.remove_node(front_end)
    front_end.destroy_node()
