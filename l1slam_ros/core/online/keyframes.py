# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
When motion makes a keyframe, and how uncertain that motion is.

In: the relative pose of each odometry message to the one before. Out: whether a keyframe is due,
and the motion since the last keyframe with its covariance.
"""

import math
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry import noise, se3
from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.graph.measurements import OdometrySample
from l1slam_ros.core.options import Options, option

# Ten steps of 5 cm count as half a metre, though rounding may make their sum a little less.
_ALMOST = 1 - 1e-9
# So many messages without a keyframe are summed up at once: memory for more is not needed.
_SUMMED = 512


@dataclass(frozen=True)
class KeyframeOptions(Options):
    """Which motion makes a keyframe: any one threshold; 0 switches one off; all 0: any message."""

    translation: float = option(
        0.5, 'distance from the last keyframe at which a new one is made; 0: off', 'm', 0, 1e6)
    rotation: float = option(
        0.2, 'turn since the last keyframe at which a new one is made; 0: off', 'rad', 0, 1e6)
    period: float = option(
        0.0, 'time since the last keyframe after which a new one is made; 0: off', 's', 0, 1e9)


@dataclass(frozen=True)
class OdometryOptions(Options):
    """Where the covariance of the odometry comes from."""

    covariance_source: str = option(
        'model', 'where the covariance of the odometry comes from. model: from the sigmas and '
        'floors below; increment: pose.covariance is that of the motion since the previous '
        'message; twist: twist.covariance times the square of the time since the previous '
        'message', '', choices=('model', 'increment', 'twist'))
    sigma_translation: float = option(
        0.05, 'model: standard deviation of the position per metre travelled', 'm/m', 0, 1e6)
    sigma_rotation: float = option(
        0.05, 'model: standard deviation of the heading per radian turned', 'rad/rad', 0, 1e6)
    floor_translation: float = option(
        0.02, 'model: standard deviation of the position that any motion has, added in '
        'quadrature', 'm', 1e-9, 1e6)
    floor_rotation: float = option(
        0.02, 'model: standard deviation of the heading that any motion has, added in quadrature',
        'rad', 1e-9, 1e6)
    reorder: float = option(
        1.0, 'how late a message may come and still be inserted at its stamp, as long as its '
        'keyframe is not finished; a later one is dropped. Nothing waits for late messages; 0: '
        'off', 's', 0, 60)


def diagonal_covariance(manifold: Manifold, translation: float, rotation: float) -> Array:
    """Return diag(translation^2, ..., rotation^2, ...), (d, d), from two sigmas [m], [rad]."""
    return np.diag(noise.sigmas(manifold, translation, rotation) ** 2)


def reduced_covariance(manifold: Manifold, covariance: Array) -> Array:
    """Return the rows of messages' (..., 6, 6) covariances that the manifold has, (..., d, d)."""
    rows = manifold.COVARIANCE_ROWS
    reduced = np.empty((*covariance.shape[:-2], len(rows), len(rows)))
    # One by one: `covariance[..., rows[:, None], rows]` lets go of the interpreter's lock.
    for r, row in enumerate(rows):
        for c, column in enumerate(rows):
            reduced[..., r, c] = covariance[..., row, column]
    return reduced


class Level:
    """Height and tilt of odometry poses, which poses in the plane lack."""

    def __init__(self, manifold: Manifold):
        self._manifold = manifold
        self._first: Array | None = None

    def dropped(self, sample: OdometrySample, options: KeyframeOptions) -> tuple[float, float]:
        """
        Return how far [m] and how steeply [rad] a sample has left the level of the first one.

        Zeros, where that would not make a keyframe: a floor is not quite even.
        """
        if self._manifold is se3:
            return 0.0, 0.0
        pose3 = sample.pose3[None]
        _, _, z, qx, qy, *_ = sample.pose3.tolist()
        # Most odometry only has a height to drop.
        off = (np.array([[0.0, 0.0, z, 0.0, 0.0, 0.0]]) if qx == qy == 0.0 else
               se3.local(self._manifold.to_pose3(self._manifold.from_pose3(pose3)), pose3))
        if self._first is None:
            self._first = off
        (length,), (angle,) = se3.motion(off - self._first)
        even = (length <= (options.translation or KeyframeOptions.translation)
                and angle <= (options.rotation or KeyframeOptions.rotation))
        return (0.0, 0.0) if even else (float(length), float(angle))


class KeyframeMotion:
    """
    The motion since the last keyframe, grown message by message.

    Parameters
    ----------
    manifold : what the poses live on
    stamp, pose : of the keyframe [ns], (1, p) in the odometry frame

    Attributes
    ----------
    bounded : of all variances that `covariance` could not take as stated, found and used

    """

    def __init__(self, manifold: Manifold, stamp: int, pose: Array):
        self._manifold = manifold
        self.bounded: list[tuple[float, float]] = []
        self.begin(stamp, pose)

    def begin(self, stamp: int, pose: Array) -> None:
        """Begin at a keyframe: stamp [ns], pose (1, p)."""
        d = self._manifold.TANGENT_SIZE
        self._start = self._stamp = stamp
        # The keyframe and the last sample.
        self._ends = np.concatenate((pose, pose))
        self._metres = self._radians = 0.0
        self._distance = self._turn = 0.0
        self._poses: list[Array] = []
        self._stated: list[Array] | None = []
        self._unseen = np.zeros((d, d))

    def step(self, sample: OdometrySample, pose: Array, keyframe: KeyframeOptions,
             odometry: OdometryOptions, verbatim: bool = False,
             unseen: tuple[float, float] | None = None) -> tuple[Array, Array] | None:
        """
        Continue to a sample; where it makes a keyframe, return the motion, and begin there.

        unseen : how much further the robot may have gone [m], and turned [rad], than the sample
        says; that is a keyframe: what is published goes by the last one

        Returns
        -------
        relative pose (1, p) and covariance (d, d); None: no keyframe

        """
        self.add(sample, pose, odometry)
        if unseen is not None:
            self._unseen = self._unseen + diagonal_covariance(self._manifold, *unseen)
        elif not self.is_keyframe(keyframe):
            return None
        motion = self.pose, self.covariance(odometry, verbatim)
        self.begin(sample.stamp, pose)
        return motion

    def add(self, sample: OdometrySample, pose: Array, options: OdometryOptions) -> None:
        """Continue to `pose` (1, p) in the odometry frame, that of a sample."""
        seconds = (sample.stamp - self._stamp) * 1e-9
        self.add_known(sample.stamp, pose, self._states(sample, seconds, options))

    def _states(self, sample: OdometrySample, seconds: float,
                options: OdometryOptions) -> Array | None:
        """Return the covariance of the motion to a sample, some seconds, (d, d), as it states."""
        if options.covariance_source == 'model':
            return None
        if options.covariance_source == 'increment':
            return reduced_covariance(self._manifold, sample.covariance)
        return reduced_covariance(self._manifold, sample.twist_covariance * seconds**2)

    def insert(self, sample: OdometrySample, pose: Array, beside: Array,
               options: OdometryOptions) -> None:
        """
        Take in a sample at `pose` (1, p) that came after the next one.

        beside : (2, p) the poses of those before and after it in time. The way to the later one
        has its covariance already, as `twist` states it for all of the time.
        """
        manifold = self._manifold
        length, angle = (values.tolist() for values in manifold.motion(manifold.local(
            np.concatenate((beside[:1], pose, beside[:1])),
            np.concatenate((pose, beside[1:], beside[1:])))))
        self._metres += length[0] + length[1] - length[2]
        self._radians += angle[0] + angle[1] - angle[2]
        if options.covariance_source == 'increment' and self._stated is not None:
            self._poses.insert(0, pose)
            self._stated.insert(0, reduced_covariance(manifold, sample.covariance))

    def add_known(self, stamp: int, pose: Array, covariance: Array | None) -> None:
        """Continue to `pose` (1, p) at a stamp [ns]; the covariance (d, d) is of the way there."""
        manifold = self._manifold
        length, angle = manifold.motion(manifold.local(self._ends, pose))
        (self._distance, metres), (self._turn, radians) = length.tolist(), angle.tolist()
        self._metres += metres
        self._radians += radians
        if covariance is None:
            self._stated = None  # one message has no covariance: the model is used for all
        elif self._stated is not None and len(self._stated) >= _SUMMED:
            self._sum_up()
        if self._stated is not None and covariance is not None:
            self._poses.append(pose)
            self._stated.append(covariance)
        self._ends[1], self._stamp = pose[0], stamp

    def _sum_up(self) -> None:
        """Replace the covariances of all messages so far by their sum."""
        end = self._poses[-1]
        total = self._seen_from(end)
        self._poses = [end]
        self._stated = None if total is None else [total.sum(axis=0)]

    def is_keyframe(self, options: KeyframeOptions) -> bool:
        """Tell whether the motion passes any threshold that is on."""
        passed = ((options.translation, self._distance), (options.rotation, self._turn),
                  (options.period, (self._stamp - self._start) * 1e-9))
        on = [value >= _ALMOST * threshold for threshold, value in passed if threshold > 0]
        return any(on) or not on

    @property
    def pose(self) -> Array:
        """The relative pose, (1, p)."""
        return self._manifold.between(self._ends[:1], self._ends[1:])

    def covariance(self, options: OdometryOptions, verbatim: bool = False) -> Array:
        """
        Return the covariance of the motion in the axes of its end, (d, d).

        verbatim : as stated, though it be more, or less, than any odometry can know
        """
        self.bounded = []
        model = diagonal_covariance(
            self._manifold,
            math.hypot(options.sigma_translation * self._metres, options.floor_translation),
            math.hypot(options.sigma_rotation * self._radians, options.floor_rotation))
        stated = self._sum(model, verbatim) if self._stated else None
        return (model if stated is None else stated) + self._unseen

    def _sum(self, model: Array, verbatim: bool) -> Array | None:
        """Return the sum of what the messages state; None where one states no covariance."""
        stated = self._seen_from(self._ends[1:])
        if stated is None:
            return None
        total = stated.sum(axis=0, keepdims=True)
        if verbatim:
            return total[0] if noise.usable(total)[0] else None
        used, self.bounded = noise.within_bounds(
            total, model, noise.MOST_OF_ODOMETRY, noise.MOST_VARIANCE)
        # A heading nearly unknown, at the end of a long lever, leaves rounding where position was.
        return used[0] if len(stated) == 1 or noise.usable(used)[0] else None

    def _seen_from(self, end: Array) -> Array | None:
        """Return what each message states (k, d, d), seen from an end (1, p); None: see `_sum`."""
        manifold = self._manifold
        stated = np.array(self._stated)
        if not noise.usable(noise.without_unset(stated)).all():
            return None
        if len(stated) == 1:  # as of most keyframes that are messages
            return stated
        Ad = manifold.adjoint(manifold.between(end, np.concatenate(self._poses)))
        return Ad @ stated @ Ad.transpose(0, 2, 1)
