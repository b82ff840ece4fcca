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

from collections import deque

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
# What wheels are off by is learnt from so many steps. That they are right counts as so much way
# [m], squared: four steps of half a metre, for one slips by twice what wheels are off by for good.
_STEPS = 100
_AS_SAID = 4 * 0.5**2
# [rad] Turns by so much and more tell a laser that hangs.
_A_TURN = 0.1
# By scans most of so many turns are the other way. Wheels that lose a sign do so now and then.
_TURNS = 20
HANGS = ('most turns are by scans the other way than by the wheels: is the laser upside down? '
         'Then its pose should say so; the map is in a mirror')


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


class Calibration:
    """
    Learns how far the robot goes for each metre that the wheels count, and how much it turns.

    Wheels that are worn, or configured wrong by some percent, err alike on each metre. Errors
    like that add up, wherever scans do not show how far the robot goes, or how it turns. They are
    found by least squares over the last `_STEPS` steps that scans measured, and a few without any
    error.

    Source: recursive least squares with exponential forgetting; Ljung, "System Identification",
    1999, section 11.2.
    """

    def __init__(self) -> None:
        # The way for each metre, and the turn [rad/m], to be added to what wheels say; weights.
        self._added = np.zeros(2)
        self._weight = np.full(2, _AS_SAID)
        # What the wheels turned in this step [rad]; which of the last turns scans have opposite.
        self._turned = 0.0
        self._opposite: deque[bool] = deque(maxlen=_TURNS)

    def begin_step(self) -> None:
        """Let what comes be of another step."""
        self._turned = 0.0

    def follow(self, motion: Array) -> Array:
        """Go on by a motion (3,) of the wheels; return it as it is taken to have been."""
        self._turned += float(motion[2])
        return self.corrected(motion)

    def corrected(self, motion: Array) -> Array:
        """Return a motion (3,) of the wheels without what it is off by."""
        x, y, turned = motion
        scale = 1.0 + self._added[0]
        return np.array((scale * x, scale * y, turned + self._added[1] * x))

    def learn(self, told: Array, moved: Array, sure: tuple[bool, bool]) -> None:
        """
        Learn of a step.

        told, moved : (3,) by the wheels, corrected, and by scans; sure : whether scans measured
        how far it went, and how it turned
        """
        square = float(told[0] ** 2 + told[1] ** 2)
        off = (moved[:2] @ told[:2] - square, told[0] * se2.wrap(moved[2] - told[2]))
        for k, most in enumerate((_WAY, _TURN_OF_WAY)):
            if sure[k]:
                self._weight[k] = (1.0 - 1.0 / _STEPS) * self._weight[k] + square
                self._added[k] += np.clip(off[k], -most * square, most * square) / self._weight[k]

    def said_of_turn(self, moved: Array) -> str:
        """Return what is to be said where by scans, (3,), the robot turns the other way."""
        turns = self._turned, float(moved[2])
        if min(abs(turns[0]), abs(turns[1])) < _A_TURN:
            return ''
        self._opposite.append(turns[0] * turns[1] < 0)
        if 2 * sum(self._opposite) <= _TURNS:
            return ''
        self._opposite.clear()
        return HANGS


def wheel_covariance(motion: Array) -> Array:
    """Return the covariance of a motion (3,) of the wheels, (3, 3) in the axes of its end."""
    way = float(np.hypot(motion[0], motion[1]))
    turn = abs(float(motion[2]))
    along = (_WAY * way) ** 2 + (_ASIDE * turn) ** 2 + _STEP**2
    heading = (_TURN * turn) ** 2 + (_TURN_OF_WAY * way) ** 2 + _STEP_TURN**2
    return np.diag((along, along, heading))
