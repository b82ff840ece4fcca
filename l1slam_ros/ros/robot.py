# SPDX-License-Identifier: Apache-2.0
"""
Where the robot is: on `pose` with its odometry, and as map -> odom on a clock.

The transform is on `map_to_odom` always, on /tf where tf2_msgs is installed.
"""

import math
import time

from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.node import Node

from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.running.snapshot import Robot
from l1slam_ros.io.files import LAST_STAMP, NANOSECONDS
from l1slam_ros.io.messages.serialisation import pose_bytes, transform_bytes
from l1slam_ros.ros.parameters import NodeParameters

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the ROS wheels on PyPI have none
    TFMessage = None


class RobotPublisher:
    """
    Publishes the robot in the map, and where the odometry frame is there.

    The transform is stamped ahead of the newest odometry: a look-up at that time succeeds so, as
    long as the next transform comes within the tolerance; with a stamp of its own it would fail
    until then.

    Parameters
    ----------
    node : to publish from
    backend : which knows where the robot is
    parameters : of the node, with the options as they are now

    """

    def __init__(self, node: Node, backend: Backend, parameters: NodeParameters):
        self._backend, self._parameters = backend, parameters
        self._pose = node.create_publisher(PoseStamped, 'pose', 10)
        self._transform = node.create_publisher(TransformStamped, 'map_to_odom', 10)
        self._tf = None
        if parameters.options.publish_tf and TFMessage is not None:
            self._tf = node.create_publisher(TFMessage, '/tf', 100)
        self._newest = self._stamp = self._before = 0
        self._due = 0.0
        # The newest as a pose of the manifold, and as it is published.
        self._last = (backend.manifold.identity(0),) * 2

    def answer(self) -> None:
        """Publish where the robot is now."""
        robot, manifold = self._backend.robot(), self._backend.manifold
        if robot is not None:  # else the map has been emptied meanwhile
            pose = manifold.compose(robot.map_to_odom, robot.odometry)
            self._pose.publish(pose_bytes(
                self._parameters.options.map_frame, robot.stamp, manifold.to_pose3(pose)[0]))

    def forget(self) -> None:
        """Publish no transform until there is other odometry: its stamps are of another time."""
        self._before = self._newest

    def tick(self) -> float:
        """
        Publish the transform if it is time; return when to call again [s], or infinity.

        It is time, too, when odometry has come that is newer than the last transform: a bag that
        is played fast, or odometry that comes seldom, outruns the tolerance within a period.
        """
        robot, now = self._backend.robot(), time.monotonic()
        if robot is None or robot.stamp == self._before:
            return math.inf
        if now >= self._due or robot.stamp > self._stamp:
            self._publish(robot)
            late, period = now - self._due, self._parameters.options.transform_period
            self._due = now + period - (late if 0 <= late < period else 0.0)
        return self._due - now

    def _publish(self, robot: Robot) -> None:
        """Publish the transform as it is now."""
        options = self._parameters.options
        self._before = 0
        if robot.stamp < self._newest:
            self._stamp = 0  # time itself went back
        self._newest = robot.stamp
        # tf2 ignores a second transform of one time, and warns of it.
        self._stamp = min(max(robot.stamp + int(options.transform_tolerance * NANOSECONDS),
                              self._stamp + 1), LAST_STAMP)
        if robot.map_to_odom is not self._last[0]:
            self._last = (robot.map_to_odom,
                          self._backend.manifold.to_pose3(robot.map_to_odom)[0])
        said = options.map_frame, options.odom_frame, self._stamp, self._last[1]
        self._transform.publish(transform_bytes(*said))
        if self._tf is not None:
            self._tf.publish(transform_bytes(*said, in_sequence=True))
