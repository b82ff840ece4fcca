# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Innovations of factors against a solved graph, their covariances and likelihood ratios.

In: a graph at its L2 optimum. Out: for any factor the covariance of its residual, and how likely
it is an inlier. Covariances come from posterior samples: solutions of `H y = A' xi` for white
noise xi have the covariance H^-1. So the second moment of `J_i y_i + J_j y_j` is the covariance
that the map adds to the residual of a factor outside the graph; that of `xi - J y` is the
covariance of the residual of one inside. All samples cost a few ordinary solutions.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from math import lgamma

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import Mask, filled
from l1slam_ros.core.geometry.quantiles import beta_quantile, gamma_quantile
from l1slam_ros.core.graph.draws import keys, signs
from l1slam_ros.core.graph.factor_graph import BetweenFactors, FactorGraph
from l1slam_ros.core.graph.linear_system import LinearSystem, anchor, linearise
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky

_beta_quantile, _gamma_quantile = cache(beta_quantile), cache(gamma_quantile)
# Number of posterior samples: standard deviations are right to 10% (1 / sqrt(2 q)), and a pair of
# factors has far fewer rows. `native.prediction` has the same.
SAMPLES = 48
# Noise follows Student's distribution with this number of degrees of freedom for each component of
# a step: its covariance is not known better. Half makes 5 of 89 runs worse, double 2.
TAIL = 8
# Significance level; also the fraction of inliers that a gate may reject: half makes none of 89
# runs worse, double 1.
BY_CHANCE = 1e-3
# Bound on the ratio of the variances of odometry and loops: beyond it the smaller weights are lost
# in rounding, and the matrix cannot be factored.
LEAST_RATIO = 1e-5
# A factor is hardly checked by others if its residual has less than this part of its variance.
CHECKED = 0.01


@dataclass(frozen=True)
class Posterior:
    """
    A graph at its optimum, with posterior samples.

    Attributes
    ----------
    system : linearised there or one step before; b is minus the remaining residual
    noise : (m, k, q) random signs
    samples : (free keyframes + 1, k, q) steps that the noise causes, the last of fixed keyframes
    moment : (m, k, k) of the residual under the stated noise
    speaks : (m, k) bool, see `BetweenFactors`
    fixed : number of keyframes held fixed, see `anchor`

    """

    system: LinearSystem
    noise: np.ndarray
    samples: Array
    moment: Array
    speaks: Mask
    fixed: int

    @property
    def residual(self) -> Array:
        """(m, k) whitened residuals."""
        return -self.system.b.reshape(len(self.system.blocks), -1)

    def left_over(self, rows: Indices) -> Array:
        """Return samples of the residuals of some factors, (l, k, q)."""
        system = self.system
        return self.noise[rows] - native.prediction.moved(
            system.keyframe[rows], system.blocks[rows], self.samples)

    def left_out(self) -> Array:
        """
        Return the leave-one-out squared innovation of each factor, (m,).

        With the covariance R of the residual r, `R^-1 r` is the innovation of the factor by all
        others and R^-1 its covariance, so the square is r'R^-1 r; 0 where others hardly check it.
        """
        moment = filled(self.moment, ~self.speaks).copy()
        square: Array = native.prediction.normalise(moment, self.residual)[0]
        alone = np.trace(self.moment, axis1=1, axis2=2) < CHECKED
        return np.where(alone | ~np.isfinite(square), 0.0, square)


def sample_posterior(graph: FactorGraph, poses: Array, cholesky: BlockCholesky,
                     solved: LinearSystem | None = None) -> Posterior:
    """
    Return the posterior of a graph about its optimum, poses (n, p).

    solved : the system of the last step, factored by `cholesky`, with the remaining b

    Raises
    ------
    GraphError : a keyframe is not connected to the anchor.

    """
    system = solved or factorised(graph, poses, cholesky)
    # A map converged to within its noise is not optimal for factors hardly checked by others.
    step = cholesky.solve(system.transposed_times(system.b))
    system = replace(system, b=system.b - system.times(step))
    noise, samples = _steps(graph, system, cholesky)
    moment = native.prediction.left_over(system.keyframe, system.blocks, samples, noise)
    return Posterior(system, noise, samples, moment, graph.between.speaks, anchor(graph))


def spread_of(graph: FactorGraph, poses: Array, cholesky: BlockCholesky,
              variance: Array) -> Array:
    """
    Return samples of the error of the L2 map (n, p) of a graph, (free keyframes, k, q).

    variance : (m,), or (m, k) by component, of actual noise in units of the stated
    """
    system = factorised(graph, poses, cholesky)
    roots = np.sqrt(np.atleast_2d(variance.T).T)[:, None, :, None]
    noisy = replace(system, blocks=system.blocks * roots)
    return _steps(graph, noisy, cholesky)[1][:-1]


def covariances(samples: Array) -> Array:
    """Return the covariance of each keyframe, (n, k, k), from samples (n, k, q)."""
    return samples @ samples.transpose(0, 2, 1) / samples.shape[2]


def factorised(graph: FactorGraph, poses: Array, cholesky: BlockCholesky) -> LinearSystem:
    """Return the linear system of a graph about poses (n, p), factored by `cholesky`."""
    system = linearise(graph, poses)
    if not cholesky.factorise(system, np.ones_like(system.b)):
        raise GraphError('the normal matrix is singular: a part of the graph is not tied to '
                         'the anchor, or weights differ beyond double precision')
    return system


def _steps(graph: FactorGraph, system: LinearSystem,
           cholesky: BlockCholesky) -> tuple[np.ndarray, Array]:
    """Return signs (m, k, q), and the steps (free keyframes + 1, k, q) that they cause."""
    # Signs have the covariance of white noise and are quicker to draw.
    k = system.block_size
    noise = signs(keys(graph.between.i, graph.between.j), k, SAMPLES)
    noise[~graph.between.speaks] = 0
    samples = np.zeros((system.size + 1, k, SAMPLES))
    native.prediction.gather(system.keyframe, system.blocks, noise, samples)
    samples[-1] = 0.0
    cholesky.solve_many(samples[:-1])
    return noise, samples


def log_likelihood_ratio(square: Array, log_det: Array, log_claim: Array,
                         freedom: Indices, k: int, tail: int = TAIL) -> Array:
    """
    Return ln p(residual | inlier) - ln p(residual | outlier), (m,).

    Outliers are uniform over a volume, exp(log_claim). Inliers have Student's distribution with
    `tail` degrees of freedom for each of the k components of a step: the prediction from as many
    samples (Jeffreys' prior).

    freedom : (m,) of the residuals
    """
    q = tail * k
    constant = by_freedom(lambda size: lgamma((q + 1) / 2) - lgamma((q + 1 - size) / 2)
                          - size * np.log(np.pi * q) / 2, freedom)
    density = constant - (log_det + (q + 1) * np.log1p(square / q)) / 2
    return log_claim + density


def by_freedom(value: Callable[[int], float], freedom: Indices) -> Array:
    """Return a value for each of (m,) degrees of freedom, each computed once."""
    count = np.bincount(np.ravel(freedom))
    values: Array = np.array([value(k) if some else 0.0 for k, some in enumerate(count.tolist())])
    return values[freedom]


@dataclass(frozen=True)
class Innovations:
    """
    Innovations of factors outside the graph.

    Attributes
    ----------
    system : linearised, b minus the residual
    spread : (m, k, k) covariance that the map adds
    square : (m,) NIS r'C^-1 r, C = I + spread
    log_det : (m,) of C
    log_claim : (m,) ln of the volume of residuals of outliers
    freedom : (m,) of the residual

    """

    system: LinearSystem
    spread: Array
    square: Array
    log_det: Array
    log_claim: Array
    freedom: Indices

    def log_ratio(self) -> Array:
        """Return the `log_likelihood_ratio` of each factor, (m,)."""
        return log_likelihood_ratio(self.square, self.log_det, self.log_claim, self.freedom,
                                    self.system.block_size)

    def joint(self, posterior: Posterior, first: Indices, second: Indices) -> tuple[Array, Array]:
        """Return the joint NIS and log ratio of pairs of factors, first and second, (pairs,)."""
        system = self.system
        k = self.system.block_size
        used = np.zeros(len(self.square), bool)
        used[first] = used[second] = True
        rows = np.flatnonzero(used)
        place = np.cumsum(used) - 1
        moved = native.prediction.moved(system.keyframe[rows], system.blocks[rows],
                                         posterior.samples)
        # All products at once: each factor is in many pairs.
        columns = moved.reshape(len(rows) * k, -1) / np.sqrt(SAMPLES)
        shared = columns @ columns.T
        at = np.arange(len(rows))
        own = shared.reshape(len(rows), k, len(rows), k)[at, :, at] + np.eye(k)
        square, log_det = native.prediction.normalise_pairs(
            own, -system.b.reshape(-1, k)[rows], shared, place[first], place[second])
        claim = self.log_claim[first] + self.log_claim[second]
        freedom = self.freedom[first] + self.freedom[second]
        return square, log_likelihood_ratio(square, log_det, claim, freedom, k)


def innovations(graph: FactorGraph, poses: Array, posterior: Posterior,
                log_volume: Array) -> Innovations:
    """Return the innovations of a graph's factors, none in the posterior; see `claimed_volume`."""
    system = linearise(graph, poses, fixed=posterior.fixed)
    factors = graph.between
    k = system.block_size
    spread = native.prediction.left_over(system.keyframe, system.blocks, posterior.samples,
                                         posterior.noise[:0])
    absolute = np.flatnonzero(factors.is_absolute)
    spread[absolute] += _sagittas(graph.subset(absolute), posterior)
    square, log_det = native.prediction.normalise(spread + np.eye(k), -system.b.reshape(-1, k))
    return Innovations(system, spread, square, log_det, log_claims(factors, log_volume),
                       factors.freedom)


def _sagittas(graph: FactorGraph, posterior: Posterior) -> Array:
    """
    Return the covariance that linearisation neglects for absolute factors, (m, k, k).

    A long path with an uncertain heading ends on an arc. Its sagitta, half the offset times the
    turn, counts as noise; between keyframes it is small: both move along.
    """
    manifold, factors = graph.manifold, graph.between
    steps = posterior.samples[factors.j - posterior.fixed]
    offset, turn = ((steps[:, part]**2).sum(axis=1)
                    for part in (manifold.TRANSLATION, manifold.ROTATION))
    variance = np.zeros((len(factors), steps.shape[1]))
    variance[:, manifold.TRANSLATION] = (offset * turn).mean(axis=1)[:, None] / 4
    roots = factors.sqrt_information
    return roots * variance[:, None, :] @ roots.transpose(0, 2, 1)


def log_claims(factors: BetweenFactors, log_volume: Array) -> Array:
    """Return ln of the volume of whitened residuals of outliers, (m,)."""
    roots = np.diagonal(factors.sqrt_information, axis1=1, axis2=2)
    return (factors.speaks * log_volume).sum(axis=1) + np.log(
        np.where(factors.speaks, roots, 1.0)).sum(axis=1)


def stated_variance(factors: BetweenFactors) -> Array:
    """
    Return the median stated variance of odometry and of loops, (2,).

    For a covariance S of k components it is det(S)^(1/k). An absent kind gets the other's.
    """
    diagonal = np.abs(np.diagonal(factors.sqrt_information, axis1=1, axis2=2))
    log_root = np.where(factors.speaks, np.log(np.where(factors.speaks, diagonal, 1.0)), 0.0)
    size = np.exp(-2 * log_root.sum(axis=1) / np.maximum(factors.freedom, 1))
    kinds = [size[(factors.freedom > 0) & ~factors.is_absolute & (factors.is_odometry == odometry)]
             for odometry in (True, False)]
    stated = np.array([np.median(kind) if len(kind) else np.nan for kind in kinds])
    known = stated[np.isfinite(stated)]
    return np.where(np.isfinite(stated), stated, known[0] if len(known) else 1.0)


def within_ratio(variance: Array, stated: Array) -> Array:
    """
    Return variances of odometry and loops, (2,), the smaller raised to `LEAST_RATIO`.

    variance : (2,) in units of stated : (2,)
    """
    effective = variance * stated
    if not np.isfinite(effective).all():
        return variance
    raised: Array = np.maximum(effective, LEAST_RATIO * effective.max()) / stated
    return raised


def claimed_volume(manifold: Manifold, poses: Array) -> Array:
    """
    Return ln of the volume that outliers fill, a term for each of k axes.

    That of a Gaussian, (2 pi)^(k/2) sqrt(det M), in each direction as wide as random pairs of
    positions are apart (an outlier need not follow the corridor), with any rotation.
    """
    others = _others(len(poses))
    positions = manifold.positions(poses)
    variance = np.full(manifold.TANGENT_SIZE, np.pi**2 / 3)
    variance[manifold.TRANSLATION] = ((positions[others] - positions) ** 2).mean()
    with np.errstate(divide='ignore'):
        return np.log(2 * np.pi * variance) / 2


@lru_cache(maxsize=1)
def _others(n: int) -> Indices:
    """Return a random permutation of n keyframes, (n,), kept between rounds."""
    return np.random.default_rng(0).permutation(n)


def chi2_quantile(probability: float, freedom: Indices) -> Array:
    """Return the quantile of chi2 for each number of degrees of freedom, (m,)."""
    return by_freedom(lambda k: 2 * _gamma_quantile(k / 2, probability), freedom)


def student_quantile(probability: float, freedom: Indices, k: int) -> Array:
    """
    Return the gate of r'C^-1 r of n components, (m,), by freedom (m,).

    With C from q samples, `TAIL` for each of the k components of a step, the square has
    Hotelling's distribution: T^2 (q - n + 1) / (q n) is Fisher's F of n and q - n + 1 degrees of
    freedom.
    """
    q = TAIL * k

    def quantile(n: int) -> float:
        x = _beta_quantile(n / 2, (q - n + 1) / 2, probability)
        return q * x / (1 - x)

    return by_freedom(quantile, freedom)
