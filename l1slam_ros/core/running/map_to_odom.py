# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The transform map -> odom of a robot, by the last of its keyframes in the map."""

from typing import NamedTuple

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.online.robot_odometry import RobotOdometry


class Newest(NamedTuple):
    """
    The last keyframe of a robot in the map; later ones follow from it by odometry.

    keyframe : its number among those of the robot, -1: there is none; pose : (1, p) in the map of
    the robot; joined : that is the map of the first robot
    """

    keyframe: int
    pose: Array
    joined: bool = True


class MapToOdom:
    """The transform map -> odom (1, p), and how it has moved; its owner holds a lock."""

    def __init__(self, newest: Newest):
        self.begin(newest)
        # The transform at the previous call of `moved`, and now.
        self._moved: tuple[Array, Array] | None = None

    @property
    def joined(self) -> bool:
        """Whether the map is that of the first robot."""
        return self._newest.joined

    def begin(self, newest: Newest) -> None:
        """Begin with the transform at the end of another map."""
        self._newest = newest
        # Asked for with every sample: worked out when an update or a new offset changes it.
        self._known: tuple[Array, Array] | None = None

    def move(self, robot: RobotOdometry, newest: Newest, now: Array) -> None:
        """Update the transform to the present end of the map; now : what it is there."""
        before = self.now(robot)
        self.begin(newest)
        self._known = robot.offset, now
        self._moved = (self._moved or (before,))[0], now

    def now(self, robot: RobotOdometry) -> Array:
        """Return the transform; robot : whose it is."""
        if self._newest.keyframe < 0:
            return robot.manifold.identity(1)
        if self._known is None or self._known[0] is not robot.offset:
            self._known = robot.offset, _transforms([(robot, self._newest)])
        return self._known[1]

    def moved(self, robot: RobotOdometry) -> tuple[Array, Array]:
        """Return the transform at the previous call of this method, and now."""
        before, after = self._moved or 2 * (self.now(robot),)
        self._moved = None
        return before, after


def move_all(some: list[tuple[MapToOdom, RobotOdometry, Newest]]) -> None:
    """Update transforms of robots to the present ends of their maps."""
    if not some:
        return
    now = _transforms([(robot, newest) for _, robot, newest in some])
    for row, (transform, robot, newest) in enumerate(some):
        transform.move(robot, newest, now[row:row + 1])


def _transforms(ends: list[tuple[RobotOdometry, Newest]]) -> Array:
    """Return the transforms of robots by the ends of their maps, (r, p)."""
    manifold = ends[0][0].manifold
    odometry = np.concatenate([
        robot.track.poses_of(slice(newest.keyframe, newest.keyframe + 1))
        for robot, newest in ends])
    to_kept = manifold.compose(np.concatenate([newest.pose for _, newest in ends]),
                               manifold.inverse(odometry))
    return manifold.compose(to_kept, np.concatenate([robot.offset for robot, _ in ends]))
