# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Whether a step of the odometry is the robot's motion.

In: a sample, the one before, and how the robot has moved of late. Out: whether the robot can have
gone so far and turned so much in that time, by how fast it moved before, by what its twist says,
and, once the next sample is there, by how fast it moves after. The more signs there are that the
odometry began again, the less a step may be off:

    no sign             five times as fast as the robot moves, or as one that nobody saw
    begins anew         its pose is where odometry begins, its publisher is another one, or its
                        covariance has grown and does anew: half as much again as the robot moves;
                        after a silence no further from where it was going than half of that way
    after a silence     three quarters of the way off where it was going

Nobody can tell what the robot did in the step that is too long after a silence, or where samples
are missing and it made next to no way, though it moved all the time before and after; nor in any
after which the odometry may have begun again: that is as uncertain as the robot may have moved.
A robot that seems to stand in a silence every few seconds is one whose stamps come in heaps.
"""

import math
from collections import deque
from itertools import pairwise

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.graph.measurements import FASTEST, SHORTEST_STEP, OdometrySample

# [m/s], [rad/s] A robot that nobody saw may have gone, and turned, so fast.
UNSEEN, UNSEEN_TURN = 1.0, 1.0
# So many steps tell how the robot moves.
_RECENT = 16
# Without a sign of a restart a step may be so many times as long as the robot moves ...
_FAR = 5.0
# ... and at least so far [m]: nearer, it bends the map by less than a keyframe.
_NEAR = 0.5
# With a sign, or after a silence, so many times; next to nothing is such a part.
_SOME, _NOTHING = 1.5, 0.25
# [m], [rad] Odometry begins so near to the identity, and may be so far off whatever the robot did.
_SLACK = 0.1
# [rad/s] Any robot may begin to turn so fast.
_TURN = 0.5
# Of the way that it goes in a silence, a robot may be off by such a part of it.
_OFF = 0.5
# A covariance that begins anew is such a part of the one before, at most.
_ANEW = 0.25
# Where it was going in a silence, it may have turned off by such a part of the way.
_WIDE = 0.75
# A sample is missing after so many times the usual time; and many are, which is a silence, after
# so many times, and so long [s]: what the robot did meanwhile, nobody saw.
_ONE = 1.5
_MANY = 5.0
SILENCE = 0.5
# [m] A robot turns about so short a radius, whatever its speed.
_TIGHT = 1.0
# [m/s] Slower, a robot stands; and in a longer silence [s] any may have stood.
_STANDS, _STOPS = 0.1, 10.0
# [s] Stamps are off by so much.
_JITTER = 0.01
# [m], [rad] The identity, after its way through a quaternion.
_EXACT = 1e-9


class Point:
    """
    A sample, its pose (1, p) in the frame of its message, and its position [m].

    seconds : since the sample before; doubt : the cause it was held for, else empty; gap : why no
    motion is known from the sample before, unsure : why it is hardly known, else empty; unseen :
    how far the robot may have gone [m] meanwhile; reach : see `RecentMotion.reach`; anew : the
    only sample before it was a stray; variance : of the position, as it is stated [m2].
    """

    __slots__ = ('anew', 'doubt', 'gap', 'pose', 'position', 'reach', 'sample', 'seconds',
                 'stamp', 'unseen', 'unsure', 'variance')

    def __init__(self, manifold: Manifold, sample: OdometrySample):
        self.sample = sample
        self.stamp = sample.stamp
        self.pose: Array = manifold.from_pose3(sample.pose3[None])
        self.position: list[float] = manifold.positions(self.pose)[0].tolist()
        self.doubt = self.gap = self.unsure = ''
        self.unseen = 0.0
        self.anew = False
        self.seconds = 0.0
        self.reach = 0.0, 0.0
        self.variance: float = sum(sample.covariance.diagonal()[:3].tolist())


def is_identity(manifold: Manifold, pose: Array) -> bool:
    """Tell whether a pose (1, p) is where odometry begins."""
    return bool(abs(manifold.local(manifold.identity(1), pose)).max() < _EXACT)


class Step:
    """
    From one sample to another, by their poses.

    seconds; tangent : (1, d); metres, radians : its length and angle; span : seconds, or what
    jitter of stamps may make of nothing; variance : of the position at its end, as stated [m2]
    """

    __slots__ = ('metres', 'radians', 'seconds', 'span', 'tangent', 'variance')

    def __init__(self, manifold: Manifold, last: Point, point: Point):
        self.variance = point.variance
        self.seconds = (point.stamp - last.stamp) * 1e-9
        self.tangent = manifold.local(last.pose, point.pose)
        length, angle = manifold.motion(self.tangent)
        self.metres, self.radians = float(length[0]), float(angle[0])
        self.span = max(self.seconds, SHORTEST_STEP)

    @property
    def is_possible(self) -> bool:
        """Whether any vehicle is so fast."""
        return self.metres <= FASTEST * self.span


class RecentMotion:
    """
    How the robot has moved in the last few steps.

    Parameters
    ----------
    manifold : what the poses live on

    """

    def __init__(self, manifold: Manifold):
        self._manifold = manifold
        self._steps: deque[Step] = deque(maxlen=_RECENT)
        # What `pace` and `_usual` are by these steps; None: to be worked out.
        self._paced: tuple[float, float] | None = None
        self._usually: float | None = None
        self._fastest_turn = _TURN  # of all steps [rad/s]
        # The last silence in which it made next to no way, and how long ago that was [s].
        self._stood = 0.0
        self._since = 0.0

    def forget(self) -> None:
        """Begin with no step."""
        self._steps.clear()
        self._paced = self._usually = None
        self._stood = 0.0

    def hear(self, step: Step) -> None:
        """Take in how long a step took, whatever the robot did meanwhile; before `add`."""
        self._since += step.seconds
        if self._since > _STOPS:
            self._stood = 0.0
        if step.seconds > max(SILENCE, self._stood / _ONE) and (
                step.metres < _NOTHING * self.pace()[0] * step.seconds):
            self._stood = step.seconds
            self._since = 0.0

    def add(self, step: Step) -> None:
        """Take a step in that the robot has made."""
        self._steps.append(step)
        self._paced = self._usually = None
        self._fastest_turn = max(self._fastest_turn, step.radians / step.span)

    @property
    def longest(self) -> float:
        """The longest step [m]."""
        return max((step.metres for step in self._steps), default=0.0)

    def pace(self) -> tuple[float, float]:
        """Return how fast the robot moves [m/s] and turns [rad/s]: in the mean, or now if more."""
        if not self._steps:
            return 0.0, 0.0
        if self._paced is None:
            last = self._steps[-1]
            span = max(sum([step.seconds for step in self._steps]), SHORTEST_STEP)
            metres, radians = ([step.metres for step in self._steps],
                               [step.radians for step in self._steps])
            self._paced = (max(sum(metres) / span, last.metres / last.span),
                           max(sum(radians) / span, last.radians / last.span))
        return self._paced

    @property
    def _usual(self) -> float:
        """The usual time from one sample to the next [s], some of which may come at once."""
        if self._usually is None:
            usual = sorted([step.seconds for step in self._steps])
            self._usually = max(usual[len(usual) // 2], sum(usual) / len(usual)) if usual else 0.0
        return self._usually

    def is_silence(self, seconds: float) -> bool:
        """Tell whether so long passes between two samples only where many are missing."""
        return seconds > max(SILENCE, _MANY * self._usual)

    def is_missing(self, seconds: float) -> bool:
        """Tell whether so long passes between two samples only where one is missing at least."""
        return seconds > max(SHORTEST_STEP, self._usual) * _ONE

    def jumps(self, last: Point, point: Point, step: Step, after: Step | None = None) -> bool:
        """
        Tell whether no robot makes a step, or this one does not.

        after : what it does next, where that is known
        """
        if not step.is_possible:
            return True
        speed, turn = self._paces(last, point, after)
        if not self._steps and after is None:
            return False  # nothing is known of it yet
        if step.metres > _NEAR and step.metres > _FAR * max(speed, UNSEEN) * step.span:
            return True
        if not self._begins_anew(last, point):
            return False
        metres = step.metres
        radians = step.radians
        off = _SOME
        if self.is_silence(step.seconds):
            metres, radians = self._from_expected(last, point, step.seconds)
            off = _OFF
        return (metres > _SLACK + off * speed * step.span
                or radians > _SLACK + off * max(turn, self._fastest_turn) * step.span)

    def unsure(self, last: Point, point: Point, step: Step, after: Step | None = None) -> float:
        """
        Return how far the robot may have gone [m] in a step that says little of it; else 0.

        One of next to nothing, where samples are missing, while it moved on; or one after a
        silence, after which the odometry may have begun again, or is not where it was going.
        What recurs within `_STOPS` is how the samples are stamped, and says little of the robot.
        after : see `jumps`; None: it goes on as before
        """
        if not self._steps or not self.is_missing(step.seconds):
            return 0.0
        speed = self._paces(last, point, after)[0]
        way = speed * step.seconds
        if self._stood_only_then(step, after):
            return way
        if not self.is_silence(step.seconds):
            return 0.0
        if self._begins_anew(last, point):
            return way if way > _SLACK else 0.0
        off = step.metres
        part = _SOME
        if step.seconds < _STOPS:
            off = self._from_expected(last, point, step.seconds, after)[0]
            part = _WIDE
        return max(way, step.metres) if off > _NEAR + part * way else 0.0

    def _stood_only_then(self, step: Step, after: Step | None) -> bool:
        """Tell whether the robot made next to no way in a step, but at all before, and after."""
        if step.seconds < _ONE * self._stood:
            return False  # it does so again and again: its stamps come in heaps
        seconds = [one.seconds for one in self._steps]
        usual = self._usual
        jitters = min(seconds) < usual / _ONE or max(seconds) > usual * _ONE
        if jitters and step.seconds < max(SILENCE, _MANY * max(seconds)):
            return False  # such stamps say as much of any robot
        slow = min(one.metres / max(one.seconds, _JITTER) for one in self._steps)
        if after:
            slow = min(slow, after.metres / max(after.seconds, usual / 2))
        return slow > _STANDS and step.seconds < _STOPS and (
            step.metres < _NOTHING * slow * step.seconds)

    def reach(self, step: Step, is_gap: bool) -> tuple[float, float]:
        """
        Return how far [m] and by what angle [rad] the robot may be off the middle of a step.

        Who goes so far in so long may have been anywhere in an ellipse about both ends. is_gap :
        it is not known where that ended: how far it may have gone. Zeros : no sample is missing.
        """
        if not is_gap and not self.is_missing(step.seconds):
            return 0.0, 0.0
        speed, turn = self.pace()
        turned = max(_SOME * turn, UNSEEN_TURN, speed / _TIGHT) * step.seconds
        if is_gap:
            return _SOME * speed * step.seconds, turned
        way = _SOME * max(speed * step.seconds, step.metres)
        return math.sqrt(way**2 - step.metres**2) / 2, max(turned - step.radians, 0.0) / 2

    def _paces(self, last: Point, point: Point, after: Step | None) -> tuple[float, float]:
        """Return the most that the robot moves [m/s] and turns [rad/s], by all that is known."""
        speed, turn = self.pace()
        found = [(speed, turn), last.sample.speeds, point.sample.speeds]
        if after:
            found.append((after.metres / after.span, after.radians / after.span))
        return max(one[0] for one in found), max(one[1] for one in found)

    def _begins_anew(self, last: Point, point: Point) -> bool:
        """Tell whether there is a sign that the odometry began again."""
        if point.sample.other_source:
            return True
        if math.hypot(*point.position) < _SLACK:
            manifold = self._manifold
            if manifold.motion(manifold.local(manifold.identity(1), point.pose))[1][0] < _SLACK:
                return True
        before, now = last.variance, point.variance
        if not 0 < now < _ANEW * before or len(self._steps) < _RECENT:
            return False
        grown = [step.variance for step in self._steps]
        return grown[0] < grown[-1] and all(a <= b for a, b in pairwise(grown))

    def _from_expected(self, last: Point, point: Point, seconds: float,
                       after: Step | None = None) -> tuple[float, float]:
        """
        Return how far [m] and by what angle [rad] a sample is off where the robot was going.

        after : what it does next, from where it may have come; None: not known
        """
        manifold = self._manifold
        way = np.zeros((1, manifold.TANGENT_SIZE))
        span = 0.0
        for step in reversed(self._steps):
            way, span = way + step.tangent, span + step.seconds
            if span >= SHORTEST_STEP:
                break
        expected = [manifold.retract(last.pose, way / max(span, SHORTEST_STEP) * seconds)]
        found = [point.pose]
        if after:
            expected.append(manifold.retract(point.pose, -after.tangent / after.span * seconds))
            found.append(last.pose)
        length, angle = manifold.motion(manifold.local(
            np.concatenate(expected), np.concatenate(found)))
        return float(length.min()), float(angle.min())
