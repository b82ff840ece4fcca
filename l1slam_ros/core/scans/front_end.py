# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The scan front end: scans and the wheels' poses in, keyframes, odometry and loops out.

    points      a scan becomes points with normals
    odometry    matched with the last few keyframes: where the robot is; is it a keyframe?
    loops       keyframes whose surroundings are known ask which earlier place they are

It knows no back end: whoever has one tells it with `place` where the keyframes lie in the map.
"""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.options import Options
from l1slam_ros.core.scans.loops import LoopFinder, LoopOptions, ScanLoop
from l1slam_ros.core.scans.odometry import ScanKeyframes, ScanOdometry, Step
from l1slam_ros.core.scans.points import Mount, Scan, points_of
from l1slam_ros.core.scans.submaps import Keyframe
from l1slam_ros.core.scans.wheels import Wheels

# Where so many comparisons wait, two are made at a time, and no keyframe asks for more.
_MANY = 8


@dataclass(frozen=True)
class FrontEndOptions(Options):
    """Everything the scan front end can be told."""

    keyframe: ScanKeyframes = ScanKeyframes()
    loop: LoopOptions = LoopOptions()


class ScanFrontEnd:
    """
    Makes odometry and loops of scans.

    Parameters
    ----------
    options : see `FrontEndOptions`
    mount : where the laser is on the robot

    """

    def __init__(self, options: FrontEndOptions = FrontEndOptions(),  # noqa: B008
                 mount: Mount = Mount()):  # noqa: B008
        self._mount = mount
        self._odometry = ScanOdometry(options.keyframe)
        self._finder = LoopFinder(self._odometry.keyframes, options.loop)
        self._poses, self._spread = np.zeros((0, 3)), np.zeros((0, 2))
        self._due: deque[int] = deque()
        self._wheels = Wheels()

    @property
    def keyframes(self) -> list[Keyframe]:
        """All keyframes so far."""
        return self._odometry.keyframes

    def add(self, scan: Scan, wheels: Array) -> Step:
        """Follow the robot to a scan; wheels : (3,) its pose by the wheels at the scan's stamp."""
        jump = self._wheels.follow(scan.stamp, wheels)
        points = points_of(scan, self._mount, self._wheels.during(scan))
        step = self._odometry.add(scan.stamp, points, self._wheels.pose)
        return replace(step, said='; '.join(filter(None, (jump, step.said)))) if jump else step

    def begin_drive(self, mount: Mount) -> None:
        """Let the next scan be the first of another drive, by a laser mounted like this."""
        self._mount = mount
        self._wheels = Wheels()
        self._odometry.end_drive()

    def place(self, poses: Array, spread: Array) -> None:
        """
        Hear where the first keyframes lie in the map.

        poses : (n, 3); spread : (n, 2) standard deviation of where each lies from the last of them
        [m], [rad]; infinite: not known
        """
        self._poses, self._spread = poses, spread

    @property
    def waiting(self) -> int:
        """How many keyframes are still to ask, and how many comparisons are still to be made."""
        return len(self._due) + self._finder.waiting

    def loops(self) -> list[ScanLoop]:
        """
        Look for loops for a while; return those found.

        To be called after each scan, and while there is nothing else to do: comparisons of
        keyframes take longer than anything else, so that they wait for each other, and one is made
        at a call, two only where many wait.
        """
        self._due.extend(self._finder.due().tolist())
        self._ask(_MANY)
        return self._finder.find(1 if self._finder.waiting < _MANY else 2)

    def last_loops(self) -> list[ScanLoop]:
        """Make all comparisons that wait, for no scan will come; return the loops found."""
        self._ask(np.inf)
        return self._finder.find(self._finder.waiting)

    def _ask(self, most: float) -> None:
        """Let keyframes ask, until so many comparisons wait."""
        if not self._due or self._finder.waiting >= most:
            return
        poses, spread = self._in_map()
        while self._due and self._finder.waiting < most:
            self._finder.ask(self._due.popleft(), poses, spread)

    def _in_map(self) -> tuple[Array, Array]:
        """Return all keyframes in the map (n, 3), those not placed by odometry, and `spread`."""
        known = len(self._poses)
        odometry = np.array([keyframe.pose for keyframe in self.keyframes])
        if not known:
            return odometry, np.zeros((len(odometry), 2))
        start = np.broadcast_to(odometry[known - 1], odometry[known:].shape)
        last = np.broadcast_to(self._poses[-1], odometry[known:].shape)
        new = se2.compose(last, se2.between(start, odometry[known:]))
        spread = np.concatenate((self._spread, np.zeros((len(new), 2))))
        return np.concatenate((self._poses, new)), spread
