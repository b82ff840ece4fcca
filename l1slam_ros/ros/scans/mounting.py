# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The frames of the robot, and the pose of the laser, from an option or from /tf_static."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry import se3
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans.points import Mount
from l1slam_ros.io.messages.conversion import checked_pose3
from l1slam_ros.ros.scans.options import ScanLoopsOptions

# [s] How long to wait for the pose of the laser on /tf_static.
_MOUNTING = 2.0
# More links than this from a laser to a robot are a cycle.
_LINKS = 100
# Least cosine between the axis of the laser and the vertical: else the scans are no floor plan.
_LEVEL = 0.9


class StaticTransforms:
    """The content of /tf_static: each frame's pose in its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}

    def add(self, message: Any) -> None:
        """Add a tf2_msgs/TFMessage; malformed transforms are left out."""
        for one in message.transforms:
            try:
                pose3 = checked_pose3(one.transform.translation, one.transform.rotation)
            except MessageError:
                continue
            self._parents[one.child_frame_id.removeprefix('/')] = (
                one.header.frame_id.removeprefix('/'), pose3)

    def mount(self, base: str, laser: str) -> Mount | None:
        """
        Return the pose of a laser's frame in that of the robot; None if it is unknown.

        Raises
        ------
        MessageError : the laser does not scan parallel to the floor.

        """
        pose = se3.from_pose3(np.array([[0.0, 0, 0, 0, 0, 0, 1]]))
        frame = laser
        for _ in range(_LINKS):
            if frame == base:
                return _mount(laser, se3.to_pose3(pose)[0])
            if frame not in self._parents:
                return None
            frame, pose3 = self._parents[frame]
            pose = se3.compose(se3.from_pose3(pose3[None]), pose)
        return None


class RobotFrames:
    """
    The names of the robot's frames, from messages, and the pose of the laser.

    Parameters
    ----------
    options : returns the current options
    logger : to say where the laser is
    static : whether /tf_static is subscribed to

    Attributes
    ----------
    base : of the robot
    wheels : in which its odometry is
    laser : of the scans
    mount : where the laser is in `base`; None: not known yet

    """

    def __init__(self, options: Callable[[], ScanLoopsOptions], logger: Any, static: bool):
        self._options, self._logger = options, logger
        self._transforms = StaticTransforms() if static else None
        self.base = options().base_frame
        self.wheels = ''
        self.laser = ''
        self.mount: Mount | None = None
        # [s] When the pose of the laser was first looked for.
        self._asked = 0.0

    def hear_static(self, message: Any) -> None:
        """Add a tf2_msgs/TFMessage of /tf_static."""
        if self._transforms is not None:
            self._transforms.add(message)

    def hear_odometry(self, wheels: str, child: str) -> None:
        """
        Set the two frames of an odometry message; the first message names the robot's frame.

        Raises
        ------
        MessageError : it is the odometry of another frame.

        """
        self.wheels = wheels
        frame = child.removeprefix('/')
        self.base = self.base or frame or 'base_link'
        if frame not in (self.base, ''):
            raise MessageError('child_frame', f'odometry of {frame!r}; expected that of '
                               f'{self.base!r}')

    def find_mount(self) -> bool:
        """
        Look for the pose of the laser; return whether it was found in this call.

        Raises
        ------
        MessageError : the laser does not scan parallel to the floor.

        """
        if self.mount is not None or not self.laser or not self.base:
            return False
        now = time.monotonic()
        self._asked = self._asked or now
        mount = self._options().mount()
        how = 'as laser_pose says'
        if mount is None and self.laser == self.base:
            mount = Mount()
            how = 'for that is the frame of the scans'
        if mount is None and self._transforms is not None:
            mount = self._transforms.mount(self.base, self.laser)
            how = 'as /tf_static says'
            if mount is None and now - self._asked < _MOUNTING:
                return False
        if mount is None:
            mount = Mount()
            how = 'for neither laser_pose nor /tf_static says otherwise'
        upside_down = ', upside down' if mount.upside_down else ''
        self._logger.info(f'the laser {self.laser!r} is at x {mount.x:g} m, y {mount.y:g} m, yaw '
                          f'{mount.yaw:g} rad{upside_down} of {self.base!r}, {how}')
        self.mount = mount
        return True


def _mount(laser: str, pose3: Array) -> Mount:
    """Return the mount of a laser at a pose (7,), from the directions of its x and z axes."""
    x, y, z, w = pose3[3:]
    ahead = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z)
    up = 1 - 2 * (x * x + y * y)
    if abs(up) < _LEVEL:
        raise MessageError('laser_pose', f'the z axis of {laser!r} is not vertical: its cosine is '
                           f'{up:.2g}; expected a laser that scans parallel to the floor')
    return Mount(float(pose3[0]), float(pose3[1]), float(np.arctan2(ahead[1], ahead[0])), up < 0)
