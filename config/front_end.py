# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A front end: copy it, and put your scan matcher in the place of `match`."""

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

APART, EVERY = 10.0, 1.0  # [s] between scans that are compared, and that are kept


def match(before, now):
    """Return x, y, yaw of the robot seen from where it was, and sigmas; None: not that place."""
    off = [np.abs(np.roll(now.ranges, k) - before.ranges).mean() for k in range(len(now.ranges))]
    turn = int(np.argmin(off))
    step = now.angle_increment
    return ((0.0, 0.0, turn * step), (0.05, 0.05, step)) if off[turn] < 0.05 else None


class FrontEnd(Node):
    """Tells the back end of places that it knows again."""

    def __init__(self):
        super().__init__('front_end')
        self.kept = []
        self.loops = self.create_publisher(PoseWithCovarianceStamped, 'loop_closures', 100)
        self.create_subscription(LaserScan, 'scan', self._on_scan, 10)

    def _on_scan(self, now):
        time = now.header.stamp.sec + now.header.stamp.nanosec * 1e-9
        for then, before in self.kept:
            if time - then >= APART and (found := match(before, now)):
                ((x, y, yaw), sigmas), reference = found, before.header.stamp
                loop = PoseWithCovarianceStamped()
                loop.header.stamp = now.header.stamp
                loop.header.frame_id = f'base_link@{reference.sec}.{reference.nanosec:09d}'
                position, orientation = loop.pose.pose.position, loop.pose.pose.orientation
                position.x, position.y = x, y
                orientation.z, orientation.w = np.sin(yaw / 2), np.cos(yaw / 2)
                loop.pose.covariance[[0, 7, 35]] = np.square(sigmas)
                self.loops.publish(loop)
        if not self.kept or time - self.kept[-1][0] >= EVERY:
            self.kept.append((time, now))


if __name__ == '__main__':
    rclpy.init()
    rclpy.spin(FrontEnd())
