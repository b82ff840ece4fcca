# SPDX-License-Identifier: Apache-2.0
"""
What a solved graph says of a factor, before or without it: how far off, and how sure.

In: a graph at its L2 optimum. Out: for any factor the covariance of its residual, and how likely
it is to be true. Covariances come from samples of the posterior: solutions of `H y = A' xi` for
white noise xi have the covariance H^-1. So the second moment of `J_i y_i + J_j y_j` is what the
map's uncertainty adds to the residual of a factor outside the graph, and that of `xi - J y` is
the covariance of the residual of one inside. Two dozen samples cost a few ordinary solutions.
"""

from dataclasses import dataclass
from functools import cache
from math import lgamma

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.quantiles import beta_quantile, gamma_quantile
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import LinearSystem, linearise
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky

# A covariance from that many samples has standard deviations right to 15% (1 / sqrt(2 SAMPLES)).
SAMPLES = 24
# A factor whose residual has a variance below this part of its noise is checked by no other.
_REDUNDANT = 1e-6
# Logarithm of the width of a standard normal density, 1 over its height.
_UNIT_WIDTH = np.log(2 * np.pi) / 2


@dataclass(frozen=True)
class Posterior:
    """
    A graph at its optimum.

    cholesky : of its normal matrix; samples : (free keyframes + 1, k, SAMPLES) steps from it, as
    probable as the noise makes them, the last one of what is held fixed; residual : (m, k)
    whitened, of each between factor; moment : (m, k, k) what noise as stated would make of it.
    """

    cholesky: BlockCholesky
    samples: Array
    residual: Array
    moment: Array

    def left_out(self) -> Array:
        """
        Return the squared innovation of each factor by all others, (m,).

        With the covariance R of the residual, `R^-1 r` is the residual of the factor if it were
        left out and R^-1 its covariance, so the square is r'R^-1 r. Where no other factor says
        anything of it, that is 0.
        """
        from l1slam_ros.core.kernels.prediction import normalise

        square: Array = normalise(self.moment.copy(), self.residual)[0]
        alone = np.trace(self.moment, axis1=1, axis2=2) < _REDUNDANT
        return np.where(alone | ~np.isfinite(square), 0.0, square)


def sample_posterior(
    graph: FactorGraph, poses: Array, cholesky: BlockCholesky, rng: np.random.Generator
) -> Posterior:
    """
    Return the posterior of a graph about its optimum, poses (n, p).

    Raises
    ------
    GraphError : some keyframe is not tied to the anchor.

    """
    from l1slam_ros.core.kernels.prediction import gather, left_over

    system = linearise(graph, poses)
    if not cholesky.factorise(system, np.ones_like(system.b)):
        raise GraphError('the normal matrix is singular: a part of the graph is not tied to '
                         'the anchor, or weights differ beyond double precision')
    m, k = len(system.blocks), system.block_size
    # Signs have the covariance of white noise, and are quicker to draw.
    noise = 2.0 * rng.integers(0, 2, (m, k, SAMPLES), dtype=np.int8) - 1.0
    right = np.zeros((system.size + 1, k, SAMPLES))
    gather(system.keyframe, system.blocks, noise, right)
    samples = np.zeros_like(right)
    samples[:-1] = cholesky.solve_many(right[:-1])
    moment = left_over(system.keyframe, system.blocks, samples, noise)
    count = len(graph.between)
    return Posterior(cholesky, samples, -system.b.reshape(m, k)[:count], moment[:count])


def log_likelihood_ratio(square: Array, log_det: Array, log_claim: Array, size: int) -> Array:
    """
    Return ln p(residual) + ln(volume of a false one's), (m,); size : of a residual.

    p is Student's: what a covariance from `SAMPLES` samples says of one more (Jeffreys' prior).
    Where nothing but the noise speaks, that is a little generous.
    """
    q = SAMPLES
    constant = lgamma((q + 1) / 2) - lgamma((q + 1 - size) / 2) - size * np.log(np.pi * q) / 2
    density = constant - (log_det + (q + 1) * np.log1p(square / q)) / 2
    ratio: Array = log_claim + density
    return ratio


@dataclass(frozen=True)
class Innovations:
    """
    Factors against a posterior that does not know them.

    system : their linearisation, b minus the residual; spread : (m, k, k) covariance that the map
    adds to the residual; square : (m,) the squared residual in units of its covariance
    C = I + spread; log_det : (m,) of C; log_claim : (m,) of the volume of residuals that a false
    factor could have.
    """

    system: LinearSystem
    spread: Array
    square: Array
    log_det: Array
    log_claim: Array

    def log_ratio(self, scale: float = 1.0) -> Array:
        """
        Return how much more probable each residual is if its factor is true, (m,) logarithms.

        scale : of C; see `log_likelihood_ratio`
        """
        k = self.system.block_size
        return log_likelihood_ratio(self.square / scale, self.log_det + k * np.log(scale),
                                    self.log_claim, k)

    def joint(self, posterior: Posterior, first: Indices, second: Indices) -> tuple[Array, Array]:
        """
        Return the squared residual of pairs of factors together, and their `log_ratio`, (pairs,).

        first, second : (pairs,) factors
        """
        from l1slam_ros.core.kernels import prediction

        system, k = self.system, self.system.block_size
        rows, place = np.unique(np.concatenate((first, second)), return_inverse=True)
        moved = prediction.moved(system.keyframe[rows], system.blocks[rows], posterior.samples)
        residual = -system.b.reshape(-1, k)[rows]
        pairs = place.reshape(2, -1)
        both = np.concatenate((moved[pairs[0]], moved[pairs[1]]), axis=1)
        covariance = both @ both.transpose(0, 2, 1) / SAMPLES + np.eye(2 * k)
        square, log_det = prediction.normalise(
            covariance, np.concatenate((residual[pairs[0]], residual[pairs[1]]), axis=1))
        claim = self.log_claim[first] + self.log_claim[second]
        return square, log_likelihood_ratio(square, log_det, claim, 2 * k)


def innovations(graph: FactorGraph, poses: Array, posterior: Posterior,
                log_widths: Array) -> Innovations:
    """
    Return the innovations of the between factors of a graph, none of which made the posterior.

    log_widths : of `claimed_widths`
    """
    from l1slam_ros.core.kernels import prediction

    count = len(graph.between)
    system = _between_part(linearise(graph, poses), count)
    k = system.block_size
    spread = prediction.spreads(system.keyframe, system.blocks, posterior.samples)
    square, log_det = prediction.normalise(spread + np.eye(k), -system.b.reshape(count, k))
    return Innovations(system, spread, square, log_det,
                       log_claim(graph.between.sqrt_information, log_widths))


def log_claim(roots: Array, log_widths: Array) -> Array:
    """
    Return ln of the whitened volume that false factors fill, (m,); roots : (m, k, k) whiten.

    A component without information has the residual 0 whether true or false: no evidence.
    """
    diagonal = np.abs(np.diagonal(roots, axis1=1, axis2=2))
    known = diagonal > 0
    widths = np.where(known, np.log(np.where(known, diagonal, 1.0)) + log_widths, _UNIT_WIDTH)
    volume: Array = widths.sum(axis=1)
    return volume


def exact_squares(graph: FactorGraph, poses: Array, posterior: Posterior) -> Array:
    """
    Return the squared innovations of the few between factors of a graph, (m,), without samples.

    The covariance is I + J H^-1 J', from as many solutions as there are rows.
    """
    from l1slam_ros.core.kernels import prediction

    count = len(graph.between)
    system = _between_part(linearise(graph, poses), count)
    k = system.block_size
    right = np.zeros((system.size + 1, k, count * k))
    rows = np.eye(count * k).reshape(count, k, count * k)
    prediction.gather(system.keyframe, system.blocks, rows, right)
    solved = np.zeros_like(right)
    solved[:-1] = posterior.cholesky.solve_many(right[:-1])
    every = prediction.moved(system.keyframe, system.blocks, solved)
    own = np.arange(count)
    covariance = np.eye(k) + every.reshape(count, k, count, k)[own, :, own]
    square: Array = prediction.normalise(covariance, -system.b.reshape(count, k))[0]
    return square


def _between_part(system: LinearSystem, count: int) -> LinearSystem:
    k = system.block_size
    return LinearSystem(system.keyframe[:count], system.blocks[:count], system.b[: count * k],
                        system.size)


def claimed_widths(manifold: Manifold, poses: Array, rng: np.random.Generator) -> Array:
    """
    Return the logarithms of how wide the claims of false factors spread, (k,).

    The volume of a Gaussian, (2 pi)^(1/2) sigma in each direction, as wide as the positions of
    random pairs lie apart (a false factor need not know of the corridor), with any rotation.
    """
    apart = manifold.local(poses, poses[rng.permutation(len(poses))])
    variance = np.full(manifold.TANGENT_SIZE, np.pi**2 / 3)
    variance[manifold.TRANSLATION] = (apart[:, manifold.TRANSLATION] ** 2).mean()
    with np.errstate(divide='ignore'):
        widths: Array = np.log(variance) / 2 + _UNIT_WIDTH
    return widths


@cache
def chi2_quantile(probability: float, freedom: int) -> float:
    """Return what a sum of `freedom` squared standard normal numbers stays below."""
    return 2 * gamma_quantile(freedom / 2, probability)


@cache
def sampled_quantile(probability: float, freedom: int) -> float:
    """
    Return what r'C^-1 r of normal numbers r (freedom,) stays below.

    C is the covariance of `SAMPLES` samples, so that has Hotelling's distribution:
    T^2 (q - k + 1) / (q k) is Fisher's F of k and q - k + 1 degrees of freedom.
    """
    rest = SAMPLES - freedom + 1
    x = beta_quantile(freedom / 2, rest / 2, probability)
    return SAMPLES * x / (1 - x)
