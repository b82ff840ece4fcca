# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What comes in from outside: odometry samples and loop closures, still in three dimensions.

And what is found wrong with them, and made of it: to be counted, logged, told.
"""

import math
from collections import Counter
from dataclasses import dataclass, replace
from numbers import Integral

import numpy as np

from l1slam_ros.core.errors import GraphError, MessageError, require
from l1slam_ros.core.geometry import se3
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import LEAST_VARIANCE
from l1slam_ros.core.graph.factor_graph import FactorGraph

# [m/s] The speed of sound: no vehicle on the ground has been faster (Thrust SSC, 341 m/s). Stamps
# nearer to each other than this [s] may be jitter, and say nothing about speed.
FASTEST, SHORTEST_STEP = 340.0, 0.1
# [s] The longest gap in the stamps of the odometry that is a pause without further evidence.
LONGEST_PAUSE = 60.0
# Two printed digits stay below; an unset or broken quaternion does not.
QUATERNION_NORM_ERROR = 0.1
# [m] No robot's coordinates: beyond, differences of positions lose the millimetre, then overflow.
FARTHEST = 1e9
# [ns] As far from 0 the difference of two stamps still has 64 bits.
_LATEST = 2**62
_SHAPES = {'pose3': (7,), 'covariance': (6, 6), 'twist_covariance': (6, 6)}


@dataclass(frozen=True)
class OdometrySample:
    """
    The pose of the robot in the odometry frame at one time.

    stamp : [ns]; pose3 : (7,) x y z qx qy qz qw [m]; covariance, twist_covariance : (6, 6),
    rows x y z rx ry rz, as they came in the message: `graph_builder` decides what they mean;
    frame : `child_frame_id`, empty: that of the robot; speeds : how fast it moves [m/s] and turns
    [rad/s] by its twist, zeros where that is not filled in; other_source : it is known to be of
    another publisher than the sample before.
    """

    stamp: int
    pose3: Array
    covariance: Array
    twist_covariance: Array
    frame: str = ''
    speeds: tuple[float, float] = (0.0, 0.0)
    other_source: bool = False


@dataclass(frozen=True)
class LoopClosure:
    """
    The pose of the robot at `stamp`, seen from the robot at the earlier `reference_stamp`.

    Without a reference it is an absolute pose, seen from the map frame: GPS, a marker, a person.

    stamps : [ns]; pose3 : (7,) x y z qx qy qz qw [m]; covariance : (6, 6), rows x y z rx ry rz,
    in the axes of the measured pose, those of the map where an absolute pose has no heading: its
    component says nothing if the variance is 0 or less, infinite or above 1e6; trusted : a person
    or a marker vouches for it; struck : it is a person's word that the loop of these stamps is
    false, whatever it measures; robot : the number of the robot whose pose it is;
    reference_robot : of the one from which it is seen, whose stamp the reference is, None: of the
    same.
    """

    reference_stamp: int | None
    stamp: int
    pose3: Array
    covariance: Array
    trusted: bool = False
    struck: bool = False
    robot: int = 0
    reference_robot: int | None = None

    @property
    def robots(self) -> tuple[int, int]:
        """Whose times the two `stamps` are."""
        return self.robot if self.reference_robot is None else self.reference_robot, self.robot

    @property
    def is_absolute(self) -> bool:
        """Whether it has no reference."""
        return self.reference_stamp is None

    @property
    def stamps(self) -> tuple[int, int]:
        """Reference and end [ns]; of an absolute pose its own stamp twice."""
        return self.stamp if self.reference_stamp is None else self.reference_stamp, self.stamp


def in_order(loop: LoopClosure) -> LoopClosure:
    """
    Return a sound loop of one robot as the later keyframe, seen from the earlier one.

    Z becomes Z^-1; X = Z exp(e), so X^-1 = Z^-1 exp(-Ad(Z) e), and C becomes Ad(Z) C Ad(Z)'.

    Raises
    ------
    MessageError : `order`, it leads back and leaves a component unsaid, which is none of the
        turned one.

    """
    reference, (one, other) = loop.reference_stamp, loop.robots
    if reference is None or one != other or reference <= loop.stamp:
        return loop  # robots have clocks of their own
    if not np.isfinite(loop.covariance).all():
        raise MessageError('order', f'a loop from {reference} ns back to {loop.stamp} ns does not '
                           'measure all components; expected its earlier time first')
    pose = sound_pose3(tuple(loop.pose3[:3].tolist()), tuple(loop.pose3[3:].tolist()))[None]
    Ad = se3.adjoint(pose)[0]
    return replace(loop, reference_stamp=loop.stamp, stamp=reference, pose3=se3.inverse(pose)[0],
                   covariance=Ad @ loop.covariance @ Ad.T)


def as_poses(graph: FactorGraph, values: object, what: str) -> Array:
    """
    Return what a caller calls poses as an array (n, p) of numbers, finite or not.

    what : begins the sentence on what is wrong with them, e.g. `poses have`

    Raises
    ------
    GraphError : of another shape, or none of numbers.

    """
    expected = (graph.n_poses, graph.manifold.POSE_SIZE)
    try:
        poses = np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise GraphError(f'{what} entries that are no numbers ({error}), expected the shape '
                         f'{expected}') from error
    if poses.shape != expected:
        raise GraphError(f'{what} the shape {poses.shape}, expected {expected}')
    return poses


def require_sound(what: OdometrySample | LoopClosure, kind: type) -> None:
    """
    Refuse what is no measurement of a kind: it would spoil all after it.

    Raises
    ------
    OptionError : it is something else.
    MessageError : with the cause `stamp`, `shape`, `not_finite`, `range` or `quaternion`.

    """
    require(kind, 'the measurement', what, kind.__name__)
    stamps = what.stamps if isinstance(what, LoopClosure) else (what.stamp,)
    if not all(isinstance(stamp, Integral) and -_LATEST <= stamp <= _LATEST
               for stamp in stamps):
        raise MessageError('stamp', f'stamp {stamps}; expected whole nanoseconds to 2^62')
    for name, expected in _SHAPES.items():
        shape = getattr(getattr(what, name, None), 'shape', None)
        if hasattr(what, name) and shape != expected:
            raise MessageError('shape', f'{name} of shape {shape}; expected an array {expected}')
    pose3 = what.pose3.tolist()
    sound_pose3(tuple(pose3[:3]), tuple(pose3[3:]))


def sound_pose3(position: tuple[float, ...], quaternion: tuple[float, ...]) -> Array:
    """
    Return a pose (7,) of x y z and qx qy qz qw, the quaternion normalised.

    Raises
    ------
    MessageError : it is none, with the cause `not_finite`, `range` or `quaternion`.

    """
    if not all(map(math.isfinite, position + quaternion)):
        raise MessageError('not_finite', f'pose {position} {quaternion}; expected finite numbers')
    if max(map(abs, position)) > FARTHEST:
        raise MessageError('range', f'position {position}; expected it within {FARTHEST:g} m')
    norm = math.hypot(*quaternion)
    if abs(norm - 1.0) > QUATERNION_NORM_ERROR:
        raise MessageError('quaternion', f'quaternion {quaternion} of norm {norm:g}; expected 1')
    return np.array((*position, *(component / norm for component in quaternion)))


class Notes:
    """
    Per cause, how often it came and the first time in words.

    Attributes
    ----------
    refused : cause -> how many messages were not used for it
    warned : cause -> how many were used otherwise than they said
    told : of those the causes that make another map of all that comes

    """

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()
        self.warned: Counter[str] = Counter()
        self.told: Counter[str] = Counter()
        self._first: dict[str, str] = {}
        self._unsaid: dict[str, str] = {}

    def refuse(self, cause: str, sentence: str) -> None:
        """Count a message that is not used; the sentence says what was found and expected."""
        self.refused[cause] += 1
        self._note(cause, sentence)

    def warn(self, cause: str, sentence: str) -> None:
        """Count a message that is used otherwise than it says; the sentence says how."""
        self.warned[cause] += 1
        self._note(cause, sentence)

    def tell(self, cause: str, sentence: str) -> None:
        """Count what makes another map of all that comes: it is news each time."""
        self.warn(cause, sentence)
        self.told[cause] += 1
        self._unsaid[cause] = sentence

    def warn_bounds(self, what: str, stamp: int, bounded: list[tuple[float, float]],
                    most: float) -> None:
        """Count variances that are used otherwise than stated: found and used."""
        for found, used in bounded:
            self.warn(f'{what}_variance', f'variance {found:g} of {what} at {stamp} ns; expected '
                      f'{LEAST_VARIANCE:g} to {most:g}; {used:g} is used')

    def news(self) -> list[str]:
        """Return a sentence of each cause that is new, or was told of, since the last call."""
        news = self._unsaid
        self._unsaid = {}
        return list(news.values())

    def sentences(self) -> list[str]:
        """Return one sentence per cause: how often, and the first of them."""
        refused = [f'{count} message{"s" if count > 1 else ""} refused: {self._first[cause]}'
                   for cause, count in self.refused.items()]
        return refused + [self._first[cause] + (f' ({count} times in all)' if count > 1 else '')
                          for cause, count in self.warned.items()]

    def _note(self, cause: str, sentence: str) -> None:
        if cause not in self._first:
            self._first[cause] = self._unsaid[cause] = sentence
