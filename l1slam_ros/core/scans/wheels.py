# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The wheels' odometry as one way: where a driver begins anew it jumps, and the robot does not.

In: the robot's pose by the wheels at stamps that ascend. Out: the same way without jumps, and how
fast the robot moves. In place of a jump it goes on as it moved before; scans say the rest.
"""

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans.points import Scan

# A step is a jump if it goes further than this [m], and faster than this [m/s], and so many times
# as far as the robot went before: wheels that slip, or turn at once, do none.
_FAR = 1.0
_FAST = 3.0
_TIMES = 5.0
# Wheels: part of the way and of the turn, turn for each metre, and of each scan [m, rad].
_WAY = 0.3
_TURN = 0.2
_TURN_OF_WAY = 0.3
_STEP = 0.01
_STEP_TURN = 0.01
# [m] So far from where it is said to be a laser may sit: what it moves when the robot turns.
_ASIDE = 0.1
# A scale is learnt from so many steps. That it is 1 counts as so much way [m], squared: four steps
# of half a metre, for a step's slip has twice the deviation of what wheels are off for good.
_STEPS = 100
_AS_SAID = 4 * 0.5**2
# A step is taken to be off by such a part at most.
_SLIP = 0.15


class Wheels:
    """
    Follows the wheels.

    Attributes
    ----------
    pose : (3,) of the robot, where jumps are left out
    velocity : (3,) of the robot in its own axes [m/s, m/s, rad/s]; None where it is not known

    """

    def __init__(self) -> None:
        self.pose: Array = np.zeros(3)
        self.velocity: Array | None = None
        self._last: tuple[int, Array] | None = None

    def follow(self, stamp: int, wheels: Array) -> str:
        """Go on to a pose (3,) by the wheels at a stamp [ns]; return what is to be said of it."""
        before, self._last = self._last, (stamp, wheels)
        if before is None:
            self.pose = wheels
            return ''
        seconds = (stamp - before[0]) * 1e-9
        moved = se2.between(before[1][None], wheels[None])[0]
        said = ''
        if self.velocity is not None and _is_jump(moved, self.velocity, seconds):
            moved = seconds * self.velocity
            said = 'the wheels jump further than a robot moves; it is taken to go on as before'
        elif seconds > 0:
            self.velocity = moved / seconds
        self.pose = se2.compose(self.pose[None], moved[None])[0]
        return said

    def during(self, scan: Scan) -> Array | None:
        """Return the velocity (3,) while a scan lasted: what it says, unless the wheels jumped."""
        seconds = 1e-9 * scan.duration
        usual, said = self.velocity, scan.velocity
        if said is None or (usual is not None and _is_jump(seconds * said, usual, seconds)):
            return usual
        return said


def _is_jump(moved: Array, velocity: Array, seconds: float) -> bool:
    """Return whether a robot cannot have moved so, (3,), that had such a velocity (3,) before."""
    usual = seconds * float(np.hypot(*velocity[:2]))
    return bool(np.hypot(*moved[:2]) > max(_FAR, _FAST * seconds, _TIMES * usual))


class WheelScale:
    """
    Learns how far the robot goes for each metre that the wheels count.

    A scale that is wrong is an error that adds up, wherever scans do not show how far it goes: of
    wheels worn or configured by some percent, it is most of their error. It is found by least
    squares over the last `_STEPS` steps that scans measured, and a few that say 1.

    Source: recursive least squares with exponential forgetting; Ljung, "System Identification",
    1999, section 11.2.
    """

    def __init__(self) -> None:
        self._scale = 1.0
        self._weight = _AS_SAID

    def corrected(self, motion: Array) -> Array:
        """Return a motion (3,) of the wheels with its way to scale."""
        return motion * (self._scale, self._scale, 1.0)

    def learn(self, told: Array, moved: Array) -> None:
        """Learn of a step that the wheels, to scale, told, (3,), and how far scans measured it."""
        square = float(told[0] ** 2 + told[1] ** 2)
        if square == 0.0:
            return
        # What the wheels counted was less by the scale.
        off = float(np.clip((moved[:2] @ told[:2]) / square - 1.0, -_SLIP, _SLIP)) * self._scale
        self._weight = (1.0 - 1.0 / _STEPS) * self._weight + square
        self._scale += off * square / self._weight


def wheel_covariance(motion: Array) -> Array:
    """Return the covariance of a motion (3,) of the wheels, (3, 3) in the axes of its end."""
    way = float(np.hypot(motion[0], motion[1]))
    turn = abs(float(motion[2]))
    along = (_WAY * way) ** 2 + (_ASIDE * turn) ** 2 + _STEP**2
    heading = (_TURN * turn) ** 2 + (_TURN_OF_WAY * way) ** 2 + _STEP_TURN**2
    return np.diag((along, along, heading))
