# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Publishing the map whenever it has changed.

To compute and send all keyframes of a large map takes longer than an update. A thread of its own
does that then, with pauses, and sends the newest map each time.
"""

import threading
import time
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile

from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.running.improve import Improvement
from l1slam_ros.core.running.snapshot import Snapshot
from l1slam_ros.io.messages.serialisation import path_bytes, pose_bytes
from l1slam_ros.io.node_options import NodeOptions
from l1slam_ros.ros.diagnostics import Diagnostics
from l1slam_ros.ros.loop_status import LoopStatus
from l1slam_ros.ros.markers import GraphMarkers
from l1slam_ros.ros.parameters import NodeParameters
from l1slam_ros.ros.robot import RobotPublisher
from l1slam_ros.ros.threads.failures import Failures

# Number of keyframes from which a map is large: some 10 ms to publish. Its thread rests for
# this many times as long as it works.
_LARGE, _REST = 10_000, 3


class MapPublisher:
    """
    Publishes `path`, `pose_with_covariance`, `graph` and `loop_status`.

    Parameters
    ----------
    node : to publish from
    backend : whose map
    parameters : of the node
    diagnostics : gets the updates, and the jumps of the robots
    robots : each with a path of its own
    failures : records errors of the thread for large maps

    """

    def __init__(self, node: Node, backend: Backend, parameters: NodeParameters[NodeOptions],
                 diagnostics: Diagnostics, robots: Sequence[RobotPublisher], failures: Failures):
        self._backend = backend
        self._diagnostics = diagnostics
        self._robots = robots
        self._failures = failures
        self._one = threading.Lock()
        self._woken, self._ending = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._frame = parameters.options.map_frame
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._paths = [node.create_publisher(Path, f'{robot.prefix}path', latched)
                       for robot in robots]
        self.covariances = [node.create_publisher(
            PoseWithCovarianceStamped, f'{robot.prefix}pose_with_covariance', 10)
            for robot in robots]
        self._markers = GraphMarkers(node)
        self._loop_status = LoopStatus(node, parameters.options.names)
        # The revision that was published last, and how many keyframes there were.
        self._published = self._keyframes = 0

    def tell(self, improvement: Improvement | None = None) -> None:
        """
        Publish what is new; improvement : the result of the last update, or None.

        A large map is published soon, by another thread.
        """
        if improvement is not None:
            self._diagnostics.note(improvement)
        if self._thread is None and self._keyframes > _LARGE:
            self._thread = threading.Thread(
                target=self._keep_publishing, name='path', daemon=True)
            self._thread.start()
        if self._thread is None:
            self._publish_news()
        else:
            self._woken.set()

    def close(self, seconds: float) -> bool:
        """End the thread, if there is one; return whether it ended within `seconds`."""
        self._ending.set()
        self._woken.set()
        if self._thread is not None:
            self._thread.join(seconds)
        return self._thread is None or not self._thread.is_alive()

    def _keep_publishing(self) -> None:
        publish = self._failures.guarded('publishing', self._publish_news)
        while not self._ending.is_set():
            self._woken.wait()
            # Before publishing, or a change during that would be lost.
            self._woken.clear()
            began = time.monotonic()
            publish()
            self._ending.wait(_REST * (time.monotonic() - began))

    def _publish_news(self) -> None:
        with self._one:  # the last call by an update and the first by the thread may overlap
            revisions = self._backend.revisions
            if revisions.map > self._published:
                self._publish_map()
            elif revisions.now > self._published:
                # The map is the same, but a loop may be waiting or have expired.
                self._loop_status.publish(self._backend.loop_states())
            elif self._markers.behind:
                self._markers.publish(self._frame, self._newest(), self._backend.snapshot())
            self._published = revisions.now

    def _publish_map(self) -> None:
        now = self._backend.snapshot()
        poses = now.poses
        loops = now.loop_states()
        self._keyframes = len(poses)
        if not np.isfinite(poses).all() or not np.isfinite(now.map_to_odom).all():
            raise ArithmeticError('a pose of the map is not finite: it is not published')
        for robot, path, covariance in zip(
                self._robots, self._paths, self.covariances, strict=True):
            self._publish_robot(now, robot, path, covariance)
        self._loop_status.publish(loops)
        self._markers.publish(self._frame, self._newest(), now)

    def _publish_robot(self, now: Snapshot, one: RobotPublisher, path: Publisher,
                       covariance: Publisher) -> None:
        """Publish the path of a robot; a robot without a name has all keyframes."""
        manifold = self._backend.manifold
        robot = self._backend.robot(one.number)
        if robot is not None:
            before, after = (manifold.compose(transform, robot.odometry)
                             for transform in self._backend.moved(one.number))
            self._diagnostics.note_jump(manifold, before, after, one.prefix)
        keyframes = np.arange(len(now.poses))
        poses = now.drawn
        joined = True
        if one.name:
            keyframes, poses = now.poses_in_map(one.number)
            joined = len(keyframes) > 0 and now.robot_maps[one.number].joined
            if not len(keyframes) and not path.get_subscription_count():
                return
        stamps = now.stamps[keyframes]
        frame = one.map_frame(joined)
        stamp = robot.stamp if robot is not None else 0
        path.publish(path_bytes(frame, stamp, stamps, manifold.to_pose3(poses)))
        if covariance.get_subscription_count() and len(poses):
            # The map of an unjoined robot is fixed at the robot's first keyframe.
            known = self._backend.marginal_covariance(
                int(keyframes[-1]), None if joined else int(keyframes[0]))
            # None: this map does not have it.
            if known is not None:
                covariance.publish(pose_with_covariance(
                    frame, int(stamps[-1]), manifold, poses[-1:], known))

    def _newest(self) -> int:
        """Return the stamp of the newest odometry [ns], 0 where there is none."""
        robots = (self._backend.robot(one.number) for one in self._robots)
        return max((robot.stamp for robot in robots if robot is not None), default=0)


def pose_with_covariance(frame: str, stamp: int, manifold: Manifold, pose: Array,
                         covariance: Array) -> bytes:
    """
    Return a serialised PoseWithCovarianceStamped of a pose (1, p).

    covariance : (d, d) in the axes of the pose; it is converted to the axes of the frame, as in
    ROS; components that the manifold does not have are zero
    """
    pose3 = manifold.to_pose3(pose)
    turn = pose3 * [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]
    Ad = manifold.adjoint(manifold.from_pose3(turn))[0]
    rows = np.array(manifold.COVARIANCE_ROWS)
    whole = np.zeros((6, 6))
    whole[rows[:, None], rows] = Ad @ covariance @ Ad.T
    return pose_bytes(frame, stamp, pose3[0], whole)
