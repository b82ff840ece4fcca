# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The motion model of the robot, and the odds of each odometry factor to have slipped.

In: a robust state. Out: the density of steps that the odometry shows, and ln of the odds that a
step's measurement is void and the robot moved there as elsewhere.
"""

from dataclasses import dataclass, replace
from math import lgamma

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.robust.gating import SAME, TINY
from l1slam_ros.core.robust.innovation import claimed_volume, log_likelihood_ratio
from l1slam_ros.core.robust.rounds.growth import Growth


@dataclass(frozen=True)
class Motion:
    """
    The density of steps, as tangents: normal, with a power law for the tail.

    step : (n, k) the steps of the odometry; mean, covariance : theirs. A share 1 / sqrt(n) has a
    squared distance beyond `start`, where the density falls by a power (B. M. Hill, A simple
    general approach to inference about the tail of a distribution, 1975). One step of all is
    arbitrary: rare : (k, k) its covariance, as wide as all steps are long, with any rotation. A
    robot that backs up once is as rare as a slip, hence no evidence of one.
    """

    step: Array
    mean: Array
    covariance: Array
    start: float
    power: float
    rare: Array

    def square(self, step: Array, spread: Array | float = 0.0) -> tuple[Array, Array]:
        """Return squared Mahalanobis distances of steps (m, k), and ln det of covariance, (m,)."""
        return _square(step - self.mean, self.covariance + spread)

    def log_density(self, step: Array, spread: Array | float = 0.0, own: bool = False) -> Array:
        """Return ln of the density of steps (m, k), known to spread (m, k, k) or its own, (m,)."""
        square, log_det = self.square(step, spread)
        n, k = self.step.shape
        if own:  # leave each out of the mean and covariance that it is compared with
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
        # The steps as a kernel density with Scott's bandwidth.
        covariance = spread + self.covariance * n ** (-2 / (k + 4))
        repeated = np.tile(covariance, (n, 1, 1))
        return native.prediction.normalise(repeated, self.step - step)[0]


def steps_of(growth: Growth, rows: Indices) -> Array:
    """Return the measurements of factors, in the order of time, as tangents (k, d)."""
    manifold = growth.given.graph.manifold
    return manifold.local(manifold.identity(len(rows)), growth.given.factors.measurement[rows])


def usual_motion(growth: Growth) -> Motion:
    """Return the motion model of the odometry that is not cut."""
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
    # Plus one: steps may be all alike.
    power = few / (1 + np.log(np.maximum(square[-few:] / start, 1.0)).sum())
    return replace(motion, start=start, power=power)


def _square(error: Array, covariance: Array) -> tuple[Array, Array]:
    """Return e'C^-1 e of errors (m, k) and ln det C, (m,); C (m, k, k), or of all (k, k)."""
    m, k = error.shape
    return native.prediction.normalise(np.broadcast_to(covariance, (m, k, k)).copy(), error)


def log_odds_of_slips(growth: Growth, motion: Motion) -> Array:
    """
    Return ln P(slipped) / P(measured) of each odometry factor, (m,); -inf of all else.

    A priori one of all n has. Then its measurement z is arbitrary, and the robot moved by m, which
    all other factors predict with covariance C; else it moved by z, which they predict, too:

        p(m, C as motion) / (V n p(z as motion) p(z - m; C))

    with V the volume of the claims of an outlier.
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
    # Where no other factor predicts it, the residual is rounding.
    innovation = inverse @ R @ inverse @ r[:, :, None]
    measured = growth.uncut()
    cut = growth.cut[rows]
    without = measured.innovations(rows[cut])
    inverse[cut] = without.spread + np.eye(k)
    innovation[cut, :, 0] = -without.system.b.reshape(-1, k)
    root = unwhitening(measured, rows)
    spread = root @ inverse @ root.transpose(0, 2, 1)
    square, log_det = native.prediction.normalise(
        inverse.astype(np.float64), innovation[:, :, 0])
    # With the estimated noise, or with the stated one.
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
    """Return L'^-1 of factors, which turns whitened residuals back, (k, d, d)."""
    roots = growth.subgraph(rows).between.sqrt_information
    return np.linalg.inv(roots).astype(np.float64, copy=False)


def log_slip(manifold: Manifold, slip: Array, spread: Array, motion: Motion) -> Array:
    """Return the log density of slips, tangents (k, d), known to (k, d, d): Cauchy, any turn."""
    part = manifold.TRANSLATION
    square = (slip[:, part] ** 2).sum(axis=1)
    long = (motion.step[:, part] ** 2).sum(axis=1).mean()
    wide = long + np.trace(spread[:, part, part], axis1=1, axis2=2)
    size = (part.stop + 1) / 2
    return (lgamma(size) - size * np.log(np.pi) + np.log(wide) / 2
            - size * np.log(wide + square))
