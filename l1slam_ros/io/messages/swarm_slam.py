# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Reading the graph of Swarm-SLAM: keyframes with odometry, loops within and between robots.

The topic of a message names its robot: `/r0/cslam/keyframe_odom`. Keyframes have the symbols of
GTSAM as ids, with the letter a for r0. Only loops with `success` are used. A loop is the second
keyframe, seen from the first, with a covariance in some versions.
"""

import re
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry import se3
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.io.files import counted
from l1slam_ros.io.graphs.robots import symbol
from l1slam_ros.io.messages.conversion import odometry_sample
from l1slam_ros.io.messages.edge_graph import Edge, EdgeGraph, Told

KEYFRAME = 'cslam_common_interfaces/msg/KeyframeOdom'
WITHIN = 'cslam_common_interfaces/msg/IntraRobotLoopClosure'
BETWEEN = 'cslam_common_interfaces/msg/InterRobotLoopClosure'
_ROBOT = re.compile(r'(?:^|/)r(\d+)/')
_ROBOTS = 26


class SwarmSlam(EdgeGraph):
    """The graph of all robots whose messages are received."""

    def __init__(self) -> None:
        super().__init__()
        # Robot -> number and pose (1, 7) of its last keyframe.
        self._last: dict[int, tuple[int, Array]] = {}

    def _told(self, message: Any, topic: str) -> Iterator[Told]:
        if hasattr(message, 'odom'):
            yield from self._step(message, _robot_of(topic))
        elif message.success and hasattr(message, 'robot0_id'):
            yield _loop_told(message, _number(message.robot0_id, message.robot0_keyframe_id),
                             _number(message.robot1_id, message.robot1_keyframe_id))
        elif message.success:
            robot = _robot_of(topic)
            yield _loop_told(message, _number(robot, message.keyframe0_id),
                             _number(robot, message.keyframe1_id))

    def _step(self, message: Any, robot: int) -> Iterator[Told]:
        """Yield the motion from a robot's last keyframe to this one."""
        sample = odometry_sample(message.odom)
        number = _number(robot, message.id)
        pose = sample.pose3[None]
        last = self._last.get(robot)
        self._stamps[number] = sample.stamp
        self._last[robot] = number, pose
        # After a restart of the odometry the motion is unknown.
        if last is not None and not getattr(message, 'tracking_reset', False):
            x, y, z, *quaternion = se3.between(last[1], pose)[0].tolist()
            yield Told(last[0], number, False, SimpleNamespace(x=x, y=y, z=z),
                       SimpleNamespace(**dict(zip('xyzw', quaternion, strict=True))),
                       np.zeros((6, 6)))

    def _used(self) -> list[Edge]:
        return [edge for edge in super()._used() if self._is_known(edge)]

    def _is_known(self, edge: Edge) -> bool:
        return edge.i in self._stamps and edge.j in self._stamps

    def sentences(self) -> list[str]:
        """Return a sentence with the number of loops of unknown keyframes, if there are any."""
        lost = sum(edge is not None and not self._is_known(edge)
                   for edge in self._edges.values())
        return [f'{counted(lost, "loop")} of keyframes without odometry not used'] if lost else []


def _robot_of(topic: str) -> int:
    """Return the number of the robot in the name of a topic; 0 if there is none."""
    found = _ROBOT.search(topic)
    return int(found[1]) if found else 0


def _number(robot: int, keyframe: int) -> int:
    if robot >= _ROBOTS:
        raise MessageError('robot', f'a keyframe of robot {robot}; expected 0 to {_ROBOTS - 1}')
    return symbol(chr(ord('a') + robot), keyframe)


def _loop_told(message: Any, i: int, j: int) -> Told:
    if hasattr(message, 'transform'):
        pose = message.transform
        return Told(i, j, True, pose.translation, pose.rotation, np.zeros((6, 6)))
    pose = message.pose.pose
    return Told(i, j, True, pose.position, pose.orientation,
                np.array(message.pose.covariance, float).reshape(6, 6))
