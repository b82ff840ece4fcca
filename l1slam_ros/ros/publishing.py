# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The map on its topics, as often as there is something new in it."""

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header

from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.running.improve import Improvement
from l1slam_ros.io.files import NANOSECONDS
from l1slam_ros.io.messages.serialisation import path_bytes, pose_bytes
from l1slam_ros.io.node_options import NodeOptions
from l1slam_ros.ros.diagnostics import Diagnostics
from l1slam_ros.ros.loop_status import LoopStatus
from l1slam_ros.ros.markers import GraphMarkers
from l1slam_ros.ros.parameters import NodeParameters


class MapPublisher:
    """
    Publishes `path`, `pose_with_covariance`, `graph` and `loop_status`.

    Parameters
    ----------
    node : to publish from
    backend : whose map
    parameters : of the node
    diagnostics : told of updates, and of how far they moved the robot

    """

    def __init__(self, node: Node, backend: Backend, parameters: NodeParameters[NodeOptions],
                 diagnostics: Diagnostics):
        self._backend, self._diagnostics = backend, diagnostics
        self._frame = parameters.options.map_frame
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._path = node.create_publisher(Path, 'path', latched)
        self.covariance = node.create_publisher(
            PoseWithCovarianceStamped, 'pose_with_covariance', 10)
        self._markers, self._loop_status = GraphMarkers(node), LoopStatus(node)
        # The revision that was published last.
        self._published = 0

    def tell(self, improvement: Improvement | None = None) -> None:
        """Publish what is new; improvement : what the last update did, None: nothing."""
        if improvement is not None:
            self._diagnostics.note(improvement)
        revisions = self._backend.revisions
        if revisions.map > self._published:
            self._publish_map()
        elif revisions.now > self._published:
            # Nothing new in the map, but a loop can have come for later, or expired.
            self._loop_status.publish(self._backend.loop_states())
        elif self._markers.behind:
            self._markers.publish(self._frame, self._newest(), self._backend.snapshot())
        self._published = revisions.now

    def _publish_map(self) -> None:
        now, manifold = self._backend.snapshot(), self._backend.manifold
        poses, loops = now.poses, now.loop_states()
        if not np.isfinite(poses).all() or not np.isfinite(now.map_to_odom).all():
            raise ArithmeticError('a pose of the map is not finite: it is not published')
        robot = self._backend.robot()
        if robot is not None:
            before, after = (manifold.compose(transform, robot.odometry)
                             for transform in self._backend.moved())
            self._diagnostics.note_jump(manifold, before, after)
        stamp = self._newest()
        self._path.publish(path_bytes(self._frame, stamp, now.stamps, manifold.to_pose3(poses)))
        self._loop_status.publish(loops)
        self._markers.publish(self._frame, stamp, now)
        if self.covariance.get_subscription_count() and len(poses):
            covariance = self._backend.marginal_covariance(len(poses) - 1)
            # None: a later map knows it, if any.
            if covariance is not None:
                self.covariance.publish(pose_with_covariance(
                    self._frame, int(now.stamps[-1]), manifold, poses[-1:], covariance))

    def _newest(self) -> int:
        """Return the stamp of the newest odometry [ns], 0 where there is none."""
        robot = self._backend.robot()
        return robot.stamp if robot is not None else 0


def pose_with_covariance(frame: str, stamp: int, manifold: Manifold, pose: Array,
                         covariance: Array) -> bytes:
    """
    Return a serialised PoseWithCovarianceStamped: a pose (1, p), and how well it is known.

    covariance : (d, d) in the axes of the pose, where ROS has those of the frame; what the
    manifold has no components for is known
    """
    pose3 = manifold.to_pose3(pose)
    turn = pose3 * [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]
    Ad = manifold.adjoint(manifold.from_pose3(turn))[0]
    rows, whole = np.array(manifold.COVARIANCE_ROWS), np.zeros((6, 6))
    whole[rows[:, None], rows] = Ad @ covariance @ Ad.T
    return pose_bytes(frame, stamp, pose3[0], whole)


def header(frame: str, stamp: int) -> Header:
    """Return a header with its stamp [ns]."""
    seconds, nanoseconds = divmod(int(stamp), NANOSECONDS)
    return Header(frame_id=frame, stamp=Time(sec=seconds, nanosec=nanoseconds))
