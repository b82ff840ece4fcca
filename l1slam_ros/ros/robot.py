# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Where the robot is: as map -> odom and on `pose`, with its odometry; the former on a clock, too.

The transform is on `map_to_odom` always, on /tf where tf2_msgs is installed.
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
# [ns] Taken for the time to the second message of the odometry; seldom is it more.
_FIRST_GUESS = NANOSECONDS // 5
# The next message may come later than lately, by so much of that time [1].
_SPARE = 1.5
# [ns] Odometry that comes more seldom than every 1.3 s is covered by the tolerance alone: until
# the newest stamp that is out, what a look-up finds lies between an old transform and the new one.
_FURTHEST = 2 * NANOSECONDS
# A transform goes out with odometry unless one that is out reaches nearly as far [1].
_NEARLY = 0.9


class Horizon:
    """
    How far ahead of the newest odometry a transform is to be stamped.

    Who hears of a message of the odometry looks up its stamp at once, when the transform that this
    message will cause is still to come. So the one before must reach to it: as far as from one
    message to the next. That time is the longest but one of the last twenty, for odometry may have
    stopped once, and half of it again.
    """

    def __init__(self) -> None:
        self._intervals = deque([_FIRST_GUESS], _LATELY)
        self._newest = 0

    def note(self, stamp: int) -> None:
        """Note the stamp of odometry that has come [ns]; one that is older begins anew."""
        if stamp < self._newest:
            self._intervals = deque([_FIRST_GUESS], _LATELY)
        elif 0 < self._newest < stamp:
            self._intervals.append(stamp - self._newest)
        self._newest = stamp

    def ahead(self, tolerance: float) -> int:
        """Return how far [ns], `tolerance` [s] at least."""
        usual = sorted(self._intervals)[-2:][0]
        return max(int(tolerance * NANOSECONDS), min(int(_SPARE * usual), _FURTHEST))


class RobotPublisher:
    """
    Publishes the robot in the map, and where the odometry frame is there.

    The transform is stamped ahead of the newest odometry, see `Horizon`.

    Parameters
    ----------
    node : to publish from
    backend : which knows where the robot is
    parameters : of the node, with the options as they are now
    number, name : of the robot; its topics and frames are below its name, empty: it has none

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
        """What the names of its topics and frames begin with."""
        return f'{self.name}/' if self.name else ''

    @property
    def odom_frame(self) -> str:
        """The frame of its odometry."""
        return f'{self.prefix}{self._parameters.options.odom_frame}'

    def map_frame(self, joined: bool) -> str:
        """Return the frame of its map, joined : which is that of the first robot."""
        own = '' if joined else self.prefix
        return f'{own}{self._parameters.options.map_frame}'

    def answer(self) -> None:
        """
        Publish where the robot is now.

        First the transform: who has heard of this odometry, too, is about to look it up, and what
        comes next is to find this one there.
        """
        robot = self._look()
        manifold = self._backend.manifold
        if robot is None:  # the map has been emptied meanwhile
            return
        if robot.stamp != self._before and self._stamp < robot.stamp + _NEARLY * self._ahead():
            self._publish(robot)
        pose = manifold.compose(robot.map_to_odom, robot.odometry)
        self._pose.publish(pose_bytes(
            self.map_frame(robot.joined), robot.stamp, manifold.to_pose3(pose)[0]))

    def forget(self) -> None:
        """Publish no transform until there is other odometry: its stamps are of another time."""
        self._before = self._newest

    def tick(self) -> float:
        """
        Publish the transform if it is time; return when to call again [s], or infinity.

        It is time, too, when odometry that nobody answered is newer than the last transform.
        """
        robot, now = self._look(), time.monotonic()
        if robot is None or robot.stamp == self._before:
            return math.inf
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
        """Publish the transform as it is now."""
        self._before = 0
        if robot.map_to_odom is not self._last[0]:
            self._last = (robot.map_to_odom,
                          self._backend.manifold.to_pose3(robot.map_to_odom)[0])
        if not self._stamp:
            # Before the first there is nothing to look up.
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
