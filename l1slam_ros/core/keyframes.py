# SPDX-License-Identifier: Apache-2.0
"""
When motion makes a keyframe, and how uncertain that motion is.

In: the relative pose of each odometry message to the one before. Out: whether a keyframe is due,
and the motion since the last keyframe with its covariance.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.manifold import Array, Manifold
from l1slam_ros.core.measurements import OdometrySample
from l1slam_ros.core.noise import usable
from l1slam_ros.core.options import Options, option


@dataclass(frozen=True)
class KeyframeOptions(Options):
    """Which motion makes a keyframe: any one threshold; 0 switches one off; all 0: any message."""

    translation: float = option(0.5, 'distance from the last keyframe; 0: off', 'm', 0, 1e6)
    rotation: float = option(0.2, 'turn since the last keyframe; 0: off', 'rad', 0, 1e6)
    period: float = option(0.0, 'time since the last keyframe; 0: off', 's', 0, 1e9)


@dataclass(frozen=True)
class OdometryOptions(Options):
    """Where the covariance of the odometry comes from."""

    covariance_source: str = option(
        'model', 'model: the sigmas below; increment: pose.covariance is that of the motion since '
        'the previous message; twist: twist.covariance times the time squared', '',
        choices=('model', 'increment', 'twist'))
    sigma_translation: float = option(0.05, 'model: per metre travelled', 'm/m', 0, 1e6)
    sigma_rotation: float = option(0.05, 'model: per radian turned', 'rad/rad', 0, 1e6)
    floor_translation: float = option(
        0.02, 'model: of any motion, added in quadrature', 'm', 1e-9, 1e6)
    floor_rotation: float = option(
        0.02, 'model: of any motion, added in quadrature', 'rad', 1e-9, 1e6)


def diagonal_covariance(manifold: Manifold, translation: float, rotation: float) -> Array:
    """Return diag(translation^2, ..., rotation^2, ...), (d, d), from two sigmas [m], [rad]."""
    sigma = np.zeros(manifold.TANGENT_SIZE)
    sigma[manifold.TRANSLATION] = translation
    sigma[manifold.ROTATION] = rotation
    return np.diag(sigma**2)


def reduced_covariance(manifold: Manifold, covariance: Array) -> Array:
    """Return the rows of a message's (6, 6) covariance that the manifold has, (d, d)."""
    rows = list(manifold.COVARIANCE_ROWS)
    part: Array = covariance[np.ix_(rows, rows)]
    return part


class Motion:
    """
    The motion since the last keyframe, grown message by message.

    pose : (1, p) relative pose; start : stamp of the keyframe [ns]
    """

    def __init__(self, manifold: Manifold, start: int):
        d = manifold.TANGENT_SIZE
        self._manifold = manifold
        self._sum: Array | None = np.zeros((d, d))
        self._metres = 0.0
        self._radians = 0.0
        self.start = start
        self.pose = manifold.identity(1)

    def add(self, sample: OdometrySample, increment: Array, seconds: float,
            options: OdometryOptions) -> None:
        """Continue by `increment` (1, p), the motion since the previous message."""
        manifold = self._manifold
        length, angle = manifold.motion(manifold.local(manifold.identity(1), increment))
        self._metres += float(length[0])
        self._radians += float(angle[0])
        self.pose = manifold.compose(self.pose, increment)
        covariance = _message_covariance(manifold, sample, seconds, options)
        if self._sum is None or covariance is None:
            self._sum = None  # one message without a covariance: the model speaks for all
            return
        # The earlier error, seen from the new body frame: Ad of the inverse increment.
        Ad = manifold.adjoint(manifold.inverse(increment))[0]
        self._sum = Ad @ self._sum @ Ad.T + covariance

    def is_keyframe(self, stamp: int, options: KeyframeOptions) -> bool:
        """Tell whether the motion up to `stamp` [ns] passes any threshold that is on."""
        manifold = self._manifold
        length, angle = manifold.motion(manifold.local(manifold.identity(1), self.pose))
        passed = [(options.translation, length[0]), (options.rotation, angle[0]),
                  (options.period, (stamp - self.start) * 1e-9)]
        on = [value >= threshold for threshold, value in passed if threshold > 0]
        return any(on) or not on

    def covariance(self, options: OdometryOptions) -> Array:
        """Return the covariance of the motion in the axes of its end, (d, d)."""
        if self._sum is not None and usable(self._sum[None])[0]:
            return self._sum
        return diagonal_covariance(
            self._manifold,
            float(np.hypot(options.sigma_translation * self._metres, options.floor_translation)),
            float(np.hypot(options.sigma_rotation * self._radians, options.floor_rotation)))


def _message_covariance(manifold: Manifold, sample: OdometrySample, seconds: float,
                        options: OdometryOptions) -> Array | None:
    """Return what the message says of the motion since the one before; None: nothing usable."""
    if options.covariance_source == 'model':
        return None
    if options.covariance_source == 'increment':
        covariance = reduced_covariance(manifold, sample.covariance)
    else:
        covariance = reduced_covariance(manifold, sample.twist_covariance) * seconds**2
    return covariance if usable(covariance[None])[0] else None
