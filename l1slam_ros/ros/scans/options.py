# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The options of `scan_loops`."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from l1slam_ros.core.errors import OptionError
from l1slam_ros.core.names import OF_ROS
from l1slam_ros.core.options import option
from l1slam_ros.core.scans.front_end import FrontEndOptions
from l1slam_ros.core.scans.points import Mount

# Tolerance of the sine of the roll, which is 0 or half a turn.
_ROLL = 0.01


@dataclass(frozen=True)
class ScanLoopsOptions(FrontEndOptions):
    """All options of the node: those of the front end, and its own."""

    PASSED_OVER = OF_ROS

    laser_pose: str = option(
        '', 'pose of the laser in the base frame: x, y [m], yaw [rad], and a roll of 3.1416 if it '
        'hangs upside down; empty: read from /tf_static where tf2_msgs is installed, else zero',
        fixed=True)
    range_max: float = option(
        0.0, "ranges beyond this count as no return; 0: only the scan's own range_max does", 'm',
        0, 1e6)
    scan_wait: float = option(
        2.0, 'how long a scan waits for odometry before and after its stamp, measured in stamps '
        'of later scans; then it expires', 's', 0.01, 60)
    backlog: int = option(
        30, 'largest number of scans that wait to be matched; beyond it every other one is '
        'dropped', '', 1, 100_000)
    base_frame: str = option(
        '', "the robot's frame; empty: the first child_frame_id received on odom", fixed=True)
    odom_frame: str = option(
        'scan_odom', 'frame of scan_odom; it must differ from the frame of odom', fixed=True)
    publish_tf: bool = option(
        True, 'publish odom_frame -> frame of odom on /tf, where tf2_msgs is installed',
        fixed=True)
    map_resolution: float = option(
        0.05, 'edge of a cell of the occupancy grid', 'm', 0.005, 10, fixed=True)
    map_period: float = option(
        2.0, 'shortest time between two publications of the occupancy grid', 's', 0.1, 3600)
    map_path: str = option(
        '', 'the .pgm file that ~/save_map writes; its .yaml is written beside it')

    def __post_init__(self) -> None:
        """Check every field; the laser's pose may be a list, as in ROS, or text."""
        if not isinstance(self.laser_pose, str) and isinstance(self.laser_pose, Iterable):
            object.__setattr__(self, 'laser_pose', ', '.join(map(str, self.laser_pose)))
        super().__post_init__()
        object.__setattr__(self, 'base_frame', self.base_frame.removeprefix('/'))
        object.__setattr__(self, 'odom_frame', self.odom_frame.removeprefix('/'))
        if self.laser_pose:
            self.mount()
        if not self.odom_frame:
            raise OptionError('odom_frame is empty, expected a name')
        if self.map_path and not self.map_path.endswith('.pgm'):
            raise OptionError(f'map_path is {self.map_path!r}, expected the name of a .pgm file')

    def mount(self) -> Mount | None:
        """
        Return the pose of the laser by these options; None if `laser_pose` is empty.

        Raises
        ------
        OptionError : `laser_pose` is not a pose.

        """
        words = self.laser_pose.strip('[]() ').replace(',', ' ').split()
        if not words:
            return None
        expected = 'x, y, yaw and, where it hangs, a roll of 3.1416'
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            numbers = []
        if len(numbers) not in (3, 4) or not all(map(math.isfinite, numbers)):
            raise OptionError(f'laser_pose is {self.laser_pose!r}, expected {expected}')
        x, y, yaw, roll = (*numbers, 0.0)[:4]
        if abs(math.sin(roll)) > _ROLL:
            raise OptionError(f'laser_pose has a roll of {roll:g}, expected {expected}')
        return Mount(x, y, yaw, math.cos(roll) < 0)
