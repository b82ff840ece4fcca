# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What the node hears: messages of every topic, of each robot -> the back end; see `intake`.

A robot that has a name has its topics below it. Its frames may begin with the name, or not.
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

# Odometry behind which so much waits is not answered, but for the last: there is no time for it, a
# publication gives Python up and waits for its turn, and the robot is elsewhere by now.
_ANSWERED = 5
_REPEAT_WARNING = 5.0  # [s]
# So many robots that nobody named are told of by name.
_MOST_STRANGERS = 20


class Inputs:
    """
    Appends messages to the back end; what cannot be used is counted.

    Parameters
    ----------
    node : to subscribe with
    backend : to append to
    options : of the node
    failures : where to tell what nobody foresaw
    robots : answer a sample of their odometry that is used, but not if more wait behind it; their
        `tick` is called after messages, and again after as many seconds as it returns

    Attributes
    ----------
    intake : hands messages over
    refused : cause -> how many messages could not be used

    """

    def __init__(self, node: Node, backend: Backend, options: NodeOptions, failures: Failures,
                 robots: Sequence[RobotPublisher]):
        self._node = node
        self._backend = backend
        self._robots = robots
        self._map_frame, self._odom_frame = options.map_frame, options.odom_frame
        self._unanswered: set[RobotPublisher] = set()
        # Robots that nobody named, and that was said.
        self._strangers: set[str] = set()
        self.refused: Counter[str] = Counter()
        self.intake = Intake(node, failures, self._answer, self._tick)
        for robot in robots:
            self._subscribe(robot)

    @property
    def traffic(self) -> dict[str, Any]:
        """How the messages of each topic come, by its name."""
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
                # Of an older release of the package, too, that has not all of the messages.
                with suppress(ImportError, AttributeError):
                    self.intake.subscribe(getattr(import_module(f'{package}.msg'), kind),
                                          f'{robot.prefix}{name}', use)
        # Last: not every DDS says when a message came, and a loop may come before its odometry.
        self.intake.subscribe(Odometry, f'{robot.prefix}odom',
                              self._guarded(partial(self._on_odometry, robot)), raw=True)

    def _guarded(self, use: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return what uses messages, and counts those that cannot be."""
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
        if self.traffic[f'{robot.prefix}odom'].other_source:
            sample = replace(sample, other_source=True)
        if self._backend.add_odometry(sample, robot.number):
            self._unanswered.add(robot)
        if self.intake.backlog < _ANSWERED:
            self._answer()

    def _own(self, robot: RobotPublisher, frame: str) -> str:
        """Return a frame of a robot without the robot's name."""
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
        Return the robot that the reference frame of a loop names, else the one that sent it.

        Raises
        ------
        MessageError : `robot`, it names one that the node does not know.

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
        """Say of a robot that nobody named, once, why its loops are refused."""
        known = len(self._strangers)
        stranger = sentence.partition('@')[0]
        if stranger in self._strangers or known > _MOST_STRANGERS:
            return
        self._strangers.add(stranger)
        if known == _MOST_STRANGERS:
            sentence = f'loops name more than {known} other robots; more are counted alone'
        self._node.get_logger().warning(f'refused: {sentence}')
