# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Publishing the pose of a robot at the rate of its odometry, and map -> odom, by a timer, too.

The transform is published on `map_to_odom`, and on /tf if tf2_msgs is installed.
"""

import math
import time
from collections import deque

from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.node import Node

from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.running.snapshot import Robot
from l1slam_ros.io.files import LAST_STAMP, NANOSECONDS
from l1slam_ros.io.messages.serialisation import pose_bytes, transform_bytes
from l1slam_ros.io.node_options import NodeOptions
from l1slam_ros.ros.parameters import NodeParameters

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the ROS wheels on PyPI have none
    TFMessage = None

_LATELY = 20
# [ns] Assumed period of the odometry before its second message.
_FIRST_GUESS = NANOSECONDS // 5
# The next message may come later than the usual period, by this factor [1].
_SPARE = 1.5
# [ns] Longest time by which the period of the odometry extends the stamps. For odometry with a
# longer period, look-ups would otherwise interpolate far between an old and a new transform.
_FURTHEST = 2 * NANOSECONDS
# A transform is published with odometry unless the last one reaches nearly as far [1].
_NEARLY = 0.9


class Horizon:
    """
    Decides how far ahead of the newest odometry a transform is stamped.

    A node that receives odometry looks up its stamp at once, before the transform caused by this
    message is published. So the previous transform must reach that stamp, one odometry period
    ahead. That period is the longest but one of the last twenty, as the odometry may have paused
    once, and a half of it is added.
    """

    def __init__(self) -> None:
        self._intervals = deque([_FIRST_GUESS], _LATELY)
        self._newest = 0

    def note(self, stamp: int) -> None:
        """Add the stamp of an odometry message [ns]; an older stamp begins anew."""
        if stamp < self._newest:
            self._intervals = deque([_FIRST_GUESS], _LATELY)
        elif 0 < self._newest < stamp:
            self._intervals.append(stamp - self._newest)
        self._newest = stamp

    def ahead(self, tolerance: float) -> int:
        """Return how far to stamp ahead [ns]; at least `tolerance` [s]."""
        usual = sorted(self._intervals)[-2:][0]
        return max(int(tolerance * NANOSECONDS), min(int(_SPARE * usual), _FURTHEST))


class RobotPublisher:
    """
    Publishes the pose of a robot in the map, and map -> odom.

    The transform is stamped ahead of the newest odometry, see `Horizon`.

    Parameters
    ----------
    node : to publish from
    backend : which has the pose of the robot
    parameters : of the node, with the current options
    number, name : of the robot; its topics and frames begin with the name, if that is not empty

    """

    def __init__(self, node: Node, backend: Backend, parameters: NodeParameters[NodeOptions],
                 number: int = 0, name: str = ''):
        self._backend = backend
        self._parameters = parameters
        self.number = number
        self.name = name
        self._pose = node.create_publisher(PoseStamped, f'{self.prefix}pose', 10)
        self._transform = node.create_publisher(
            TransformStamped, f'{self.prefix}map_to_odom', 10)
        self._tf = None
        if parameters.options.publish_tf and TFMessage is not None:
            self._tf = node.create_publisher(TFMessage, '/tf', 100)
        self._horizon = Horizon()
        self._newest = self._stamp = self._before = 0
        self._due = 0.0
        # The newest as a pose of the manifold, and as it is published.
        self._last = (backend.manifold.identity(0),) * 2

    @property
    def prefix(self) -> str:
        """The prefix of its topics and frames."""
        return f'{self.name}/' if self.name else ''

    @property
    def odom_frame(self) -> str:
        """The frame of its odometry."""
        return f'{self.prefix}{self._parameters.options.odom_frame}'

    def map_frame(self, joined: bool) -> str:
        """Return the frame of its map; joined : its map is that of the first robot."""
        own = '' if joined else self.prefix
        return f'{own}{self._parameters.options.map_frame}'

    def answer(self) -> None:
        """
        Publish the pose of the robot, and the transform if it is due.

        The transform comes first: other nodes that received this odometry are about to look
        it up.
        """
        robot = self._look()
        manifold = self._backend.manifold
        if robot is None:  # the map was emptied meanwhile
            return
        if robot.stamp != self._before and self._stamp < robot.stamp + _NEARLY * self._ahead():
            self._publish(robot)
        pose = manifold.compose(robot.map_to_odom, robot.odometry)
        self._pose.publish(pose_bytes(
            self.map_frame(robot.joined), robot.stamp, manifold.to_pose3(pose)[0]))

    def forget(self) -> None:
        """Publish no transform until odometry with another stamp comes: time has jumped."""
        self._before = self._newest

    def tick(self) -> float:
        """
        Publish the transform if it is due; return the time until it is due again [s], or inf.

        It is also due if odometry is newer than the stamp of the last transform.
        """
        robot, now = self._look(), time.monotonic()
        if robot is None or robot.stamp == self._before:
            return math.inf
        # The period may have been shortened.
        self._due = min(self._due, now + self._parameters.options.transform_period)
        if now >= self._due or robot.stamp > self._stamp:
            self._publish(robot)
        return self._due - now

    def _look(self) -> Robot | None:
        robot = self._backend.robot(self.number)
        if robot is not None:
            if robot.stamp < self._newest:
                self._stamp = 0  # time itself went back
            self._newest = robot.stamp
            self._horizon.note(robot.stamp)
        return robot

    def _ahead(self) -> int:
        return self._horizon.ahead(self._parameters.options.transform_tolerance)

    def _publish(self, robot: Robot) -> None:
        """Publish the current transform."""
        self._before = 0
        if robot.map_to_odom is not self._last[0]:
            self._last = (robot.map_to_odom,
                          self._backend.manifold.to_pose3(robot.map_to_odom)[0])
        if not self._stamp:
            # The first one is also published at the stamp of the odometry itself.
            self._stamp = robot.stamp
            self._send(robot)
        # tf2 ignores a second transform of one time, and warns of it.
        self._stamp = min(max(robot.stamp + self._ahead(), self._stamp + 1), LAST_STAMP)
        self._send(robot)
        now = time.monotonic()
        late = now - self._due
        period = self._parameters.options.transform_period
        self._due = now + period - (late if 0 <= late < period else 0.0)

    def _send(self, robot: Robot) -> None:
        said = self.map_frame(robot.joined), self.odom_frame, self._stamp, self._last[1]
        self._transform.publish(transform_bytes(*said))
        if self._tf is not None:
            self._tf.publish(transform_bytes(*said, in_sequence=True))
