# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How the robot moves, and what that and all loops say of the steps of the odometry.

In: a robust solve. Out: the motion that the odometry shows, and the odds that a step slipped: that
it says nothing, and the robot moved on as ever; or that all steps drift.
"""

from dataclasses import dataclass, replace
from math import lgamma

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.robust.gating import SAME, TINY
from l1slam_ros.core.robust.innovation import claimed_volume, log_likelihood_ratio
from l1slam_ros.core.robust.rounds.growth import Growth


@dataclass(frozen=True)
class Motion:
    """
    How the robot moves: steps as tangents, normal but for the few most unusual ones.

    step : (n, k) those of the odometry; mean, covariance : of these; of a share 1 / sqrt(n) the
    squared distance is beyond `start`, where it falls off by a power (B. M. Hill, A simple general
    approach to inference about the tail of a distribution, 1975). One of all is like no other:
    rare : (k, k) its covariance, as wide each way as all are long, with any rotation. To back up
    or turn round but once is as rare as a slip, so that it is no evidence of one.
    """

    step: Array
    mean: Array
    covariance: Array
    start: float
    power: float
    rare: Array

    def square(self, step: Array, spread: Array | float = 0.0) -> tuple[Array, Array]:
        """Return how unusual steps (m, k) are, squared, and ln det of their covariances, (m,)."""
        return _square(step - self.mean, self.covariance + spread)

    def log_density(self, step: Array, spread: Array | float = 0.0, own: bool = False) -> Array:
        """Return ln of the density of steps (m, k), known to spread (m, k, k) or its own, (m,)."""
        square, log_det = self.square(step, spread)
        n, k = self.step.shape
        if own:  # each by all others: a jump would widen what it is judged by
            square /= np.maximum(1 - square / n, 1 / n)
        normal = -(square + k * np.log(2 * np.pi)) / 2
        # From the density of the square to that of a point on its ellipsoid.
        tail = (np.log(self.power / np.sqrt(n)) + self.power * np.log(self.start)
                - (self.power + k / 2) * np.log(np.maximum(square, self.start))
                + lgamma(k / 2) - k / 2 * np.log(np.pi))
        square, wide = _square(step, self.rare + spread)
        rare = -(square + wide + k * np.log(2 * np.pi)) / 2 - np.log(n)
        return np.logaddexp(np.maximum(normal, tail) - log_det / 2, rare)

    def distance(self, step: Array, spread: Array) -> Array:
        """Return the squared distances of a step (k,), known to spread (k, k), to all, (n,)."""
        n, k = self.step.shape
        # All that there is lies in a cloud of Scott's bandwidth.
        covariance = spread + self.covariance * n ** (-2 / (k + 4))
        repeated = np.tile(covariance, (n, 1, 1))
        return native.prediction.normalise(repeated, self.step - step)[0]


def steps_of(growth: Growth, rows: Indices) -> Array:
    """Return what factors measure, in the order of time, as tangents (k, d)."""
    manifold = growth.given.graph.manifold
    return manifold.local(manifold.identity(len(rows)), growth.given.factors.measurement[rows])


def usual_motion(growth: Growth) -> Motion:
    """Return how the robot moves by its odometry."""
    step = steps_of(growth, np.flatnonzero(growth.given.is_step & ~growth.cut))
    least = np.diag(SAME**2 * (step**2).mean(axis=0) + TINY)
    translation = growth.given.graph.manifold.TRANSLATION
    width = np.full(len(least), np.pi**2 / 3)
    width[translation] = (step[:, translation] ** 2).mean()
    motion = Motion(step, step.mean(axis=0), np.cov(step.T) + least, np.inf, 1.0,
                    np.diag(width) + least)
    square = np.sort(motion.square(step)[0])
    few = int(np.sqrt(len(step)))
    start = max(float(square[-few - 1]), float(len(least)))
    # The one at the start is for steps that are all alike.
    power = few / (1 + np.log(np.maximum(square[-few:] / start, 1.0)).sum())
    return replace(motion, start=start, power=power)


def _square(error: Array, covariance: Array) -> tuple[Array, Array]:
    """Return e'C^-1 e of errors (m, k) and ln det C, (m,); C (m, k, k), or of all (k, k)."""
    m, k = error.shape
    return native.prediction.normalise(np.broadcast_to(covariance, (m, k, k)).copy(), error)


def log_odds_of_slips(growth: Growth, motion: Motion) -> Array:
    """
    Return ln P(slipped) / P(measured) of each odometry factor, (m,); -inf of all else.

    Of all of them one is expected to have slipped. Then it may say anything, and the robot moved
    as it does where all others say it did, m with a covariance C. If it did not slip, the robot
    moved as it does where this factor says so, and all others say what it says:

        p(m, C as motion) / (claims n p(z as motion) p(z - m; C))

    Of one that is cut, all others know nothing of it as it is.
    """
    given = growth.given
    odds = np.full(len(given.factors), -np.inf)
    manifold = given.graph.manifold
    factors = given.factors
    k = manifold.TANGENT_SIZE
    rows = np.flatnonzero(given.is_step & ~given.gap & (factors.freedom == k))
    at = np.searchsorted(np.flatnonzero(growth.accepted), rows)
    R, r = growth.posterior.moment[at], growth.posterior.residual[at]
    inverse = np.linalg.inv(R + TINY * np.eye(k))
    # Of what no other says, the residual is rounding.
    innovation = inverse @ R @ inverse @ r[:, :, None]
    measured = growth.uncut()
    cut = growth.cut[rows]
    without = measured.innovations(rows[cut])
    inverse[cut] = without.spread + np.eye(k)
    innovation[cut, :, 0] = -without.system.b.reshape(-1, k)
    root = unwhitening(measured, rows)
    spread = root @ inverse @ root.transpose(0, 2, 1)
    square, log_det = native.prediction.normalise(inverse.astype(float), innovation[:, :, 0])
    # All may be as noisy as they turn out, or as they say.
    found = max((r[~cut] ** 2).sum() / np.trace(R[~cut], axis1=1, axis2=2).sum(), 1.0)
    said = growth.noise.said[0]
    fit = np.max([log_likelihood_ratio(square / noise, log_det + k * np.log(noise),
                                       np.zeros(1), factors.freedom[rows], k)
                  for noise in (found, said)], axis=0) - np.linalg.slogdet(root)[1]
    start = manifold.identity(len(rows))
    moved = manifold.retract(factors.measurement[rows], (root @ innovation)[:, :, 0])
    J = manifold.local_jacobian(start, moved)
    claims = claimed_volume(manifold, growth.poses).sum()
    motions = motion.log_density(manifold.local(start, moved), J @ spread @ J.transpose(0, 2, 1))
    odds[rows] = motions - motion.log_density(steps_of(growth, rows), own=True) - fit - (
        claims + np.log(len(rows)))
    return odds


def unwhitening(growth: Growth, rows: Indices) -> Array:
    """Return what makes whitened residuals of odometry steps of it, (k, d, d)."""
    roots = growth.subgraph(rows).between.sqrt_information
    return np.linalg.inv(roots).astype(np.float64, copy=False)
