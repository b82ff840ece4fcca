# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The inputs of the node: converting the messages of all topics for the back end; see `intake`.

The topics of a robot with a name begin with that name. Its frames may begin with it or not.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from l1slam_ros.core.errors import L1SlamError, MessageError
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.io.files import quoted
from l1slam_ros.io.messages import conversion
from l1slam_ros.io.messages.edge_graph import EdgeGraph
from l1slam_ros.io.messages.front_ends import FRONT_ENDS
from l1slam_ros.io.node_options import NodeOptions
from l1slam_ros.ros.robot import RobotPublisher
from l1slam_ros.ros.threads.failures import Failures
from l1slam_ros.ros.threads.intake import Intake

# If this many messages wait, poses are published only for the last odometry: each publication
# releases Python's lock and waits for it again, and the pose is out of date by then.
_ANSWERED = 5
_REPEAT_WARNING = 5.0  # [s]
# Number of unknown robots that the log names.
_MOST_STRANGERS = 20


class Inputs:
    """
    Gives messages to the back end, and counts those that cannot be used.

    Parameters
    ----------
    node : to subscribe with
    backend : to append to
    options : of the node
    failures : records unexpected errors
    robots : publish their pose after a sample of odometry, unless more messages wait; their
        `tick` is called after messages, and again after the number of seconds that it returns

    Attributes
    ----------
    intake : receives the messages
    refused : cause -> number of messages that could not be used

    """

    def __init__(self, node: Node, backend: Backend, options: NodeOptions, failures: Failures,
                 robots: Sequence[RobotPublisher]):
        self._node = node
        self._backend = backend
        self._robots = robots
        self._map_frame, self._odom_frame = options.map_frame, options.odom_frame
        self._unanswered: set[RobotPublisher] = set()
        # Unknown robots that the log has named.
        self._strangers: set[str] = set()
        self.refused: Counter[str] = Counter()
        self.intake = Intake(node, failures, self._answer, self._tick)
        for robot in robots:
            self._subscribe(robot)

    @property
    def traffic(self) -> dict[str, Any]:
        """The traffic on each topic, by its name."""
        return self.intake.traffic

    def _subscribe(self, robot: RobotPublisher) -> None:
        """Subscribe to the topics of a robot."""
        for name in conversion.LOOP_TOPICS:
            self.intake.subscribe(PoseWithCovarianceStamped, f'{robot.prefix}{name}',
                                  self._guarded(partial(self._on_loop, robot, name)))
        # Pose graphs of other front ends, where their messages are installed.
        for front_end in FRONT_ENDS:
            use = partial(self._on_pose_graph, front_end.graph(), robot=robot.number)
            for name, msgtype in front_end.topics.items():
                package, _, kind = msgtype.split('/')
                # An older release of the package may not have all of the messages.
                with suppress(ImportError, AttributeError):
                    self.intake.subscribe(getattr(import_module(f'{package}.msg'), kind),
                                          f'{robot.prefix}{name}', use)
        # Last: some DDS give no times of arrival, and loops may come before their odometry.
        self.intake.subscribe(Odometry, f'{robot.prefix}odom',
                              self._guarded(partial(self._on_odometry, robot)), raw=True)

    def _guarded(self, use: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return a callback that uses messages, and counts those that cannot be used."""
        def guard(content: Any) -> None:
            try:
                use(content)
            except L1SlamError as error:
                self._refuse(error)

        return guard

    def _on_odometry(self, robot: RobotPublisher, data: bytes) -> None:
        frame, sample = conversion.odometry_in(data)
        if self._own(robot, frame) not in (self._odom_frame, ''):
            self._node.get_logger().warning(
                f'the odometry has the frame {quoted(frame)}, but {self._map_frame} -> '
                f'{robot.odom_frame} is published; expected odom_frame to be its name',
                once=True)
        if robot.prefix:
            sample = replace(sample, frame=self._own(robot, sample.frame))
        traffic = self.traffic[f'{robot.prefix}odom']
        if traffic.mixed:
            self._node.get_logger().warning(
                f'messages of several publishers come by turns on {robot.prefix}odom, and the map '
                'takes them for one motion; expected one publisher', once=True)
        if traffic.other_source:
            sample = replace(sample, other_source=True)
        if self._backend.add_odometry(sample, robot.number):
            self._unanswered.add(robot)
        if self.intake.backlog < _ANSWERED:
            self._answer()

    def _own(self, robot: RobotPublisher, frame: str) -> str:
        """Return a frame of a robot without the prefix of the robot's name."""
        return frame.removeprefix('/').removeprefix(robot.prefix)

    def _answer(self) -> None:
        for robot in self._robots:
            if robot in self._unanswered:
                self._unanswered.remove(robot)
                robot.answer()

    def _tick(self) -> float:
        return min((robot.tick() for robot in self._robots), default=math.inf)

    def _on_loop(self, robot: RobotPublisher, name: str, message: Any) -> None:
        other = robot
        if robot.prefix and name != conversion.ABSOLUTE:
            other = self._reference(robot, message.header.frame_id)
            message.header.frame_id = self._own(other, message.header.frame_id)
        loop = conversion.loop_in(name, message, self._backend.base_frame_of(other.number).name,
                                  self._map_frame, ordered=other is robot)
        self._backend.add_loop(replace(
            loop, robot=robot.number, reference_robot=other.number))

    def _reference(self, robot: RobotPublisher, frame: str) -> RobotPublisher:
        """
        Return the robot that the reference frame of a loop names, by default the sender.

        Raises
        ------
        MessageError : cause `robot`: it names an unknown robot.

        """
        frame = frame.removeprefix('/')
        for other in self._robots:
            if frame.startswith(other.prefix):
                return other
        if '/' not in frame:
            return robot
        raise MessageError('robot', f'frame {quoted(frame)} of a loop names another robot; '
                           f'expected one of {", ".join(one.name for one in self._robots)}')

    def _on_pose_graph(self, graphs: EdgeGraph, message: Any, robot: int = 0) -> None:
        for found in graphs.take(message):
            try:
                if not isinstance(found, LoopClosure):
                    raise found
                self._backend.add_loop(replace(found, robot=robot))
            except L1SlamError as error:
                self._refuse(error)

    def _refuse(self, error: L1SlamError) -> None:
        cause = error.cause if isinstance(error, MessageError) else 'unusable'
        self.refused[cause] += 1
        if cause == 'robot':
            self._tell_of_stranger(str(error))
        else:
            self._node.get_logger().warning(
                f'refused: {error}', throttle_duration_sec=_REPEAT_WARNING)

    def _tell_of_stranger(self, sentence: str) -> None:
        """Log once for each unknown robot why its loops are refused."""
        known = len(self._strangers)
        stranger = sentence.partition('@')[0]
        if stranger in self._strangers or known > _MOST_STRANGERS:
            return
        self._strangers.add(stranger)
        if known == _MOST_STRANGERS:
            sentence = f'loops name more than {known} other robots; more are counted alone'
        self._node.get_logger().warning(f'refused: {sentence}')
