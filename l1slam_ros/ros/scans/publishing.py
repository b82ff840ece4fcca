# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Publishing `scan_odom`, `loop_closures` and, with tf2_msgs, the frame of the wheel odometry."""

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans.loops import ScanLoop
from l1slam_ros.core.scans.submaps import Keyframe
from l1slam_ros.io.files import NANOSECONDS
from l1slam_ros.io.messages.conversion import reference_frame_id
from l1slam_ros.io.messages.serialisation import odometry_bytes, pose_bytes, transform_bytes
from l1slam_ros.ros.scans.messages import whole
from l1slam_ros.ros.scans.options import ScanLoopsOptions

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the ROS wheels on PyPI have none
    TFMessage = None

# [ns] How far a transform is stamped ahead, as it is the newest until the next scan is matched.
_AHEAD = NANOSECONDS // 5


class ScanPublisher:
    """
    Publishes the results of the front end.

    Parameters
    ----------
    node : to publish from
    options : of the node

    """

    def __init__(self, node: Node, options: ScanLoopsOptions):
        self._frame = options.odom_frame
        self._odometry = node.create_publisher(Odometry, 'scan_odom', 100)
        self._loops = node.create_publisher(PoseWithCovarianceStamped, 'loop_closures', 1000)
        self._tf = None
        if options.publish_tf and TFMessage is not None:
            self._tf = node.create_publisher(TFMessage, '/tf', 100)

    def odometry(self, base: str, stamp: int, pose: Array, covariance: Array) -> None:
        """Publish a pose (3,), and the covariance (3, 3) of the motion since the one before."""
        self._odometry.publish(odometry_bytes(
            self._frame, base, stamp, se2.to_pose3(pose[None])[0], whole(covariance)))

    def wheels_frame(self, frame: str, stamp: int, pose: Array, wheels: Array) -> None:
        """Publish where the frame of the wheels is, which say `wheels` (3,) at `pose` (3,)."""
        if self._tf is not None:
            offset = se2.compose(pose[None], se2.inverse(wheels[None]))
            self._tf.publish(transform_bytes(
                self._frame, frame, stamp + _AHEAD, se2.to_pose3(offset)[0], in_sequence=True))

    def loop(self, base: str, keyframes: list[Keyframe], loop: ScanLoop) -> None:
        """Publish a loop between two keyframes."""
        reference, stamp = keyframes[loop.i].stamp, keyframes[loop.j].stamp
        measured = np.asarray(loop.measurement, float)
        self._loops.publish(pose_bytes(
            reference_frame_id(base, reference), stamp, se2.to_pose3(measured[None])[0],
            whole(loop.covariance)))
