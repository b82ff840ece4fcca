# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Measures of a solution, computed from the problem itself: norms, duality gap, status.

Nothing here relies on values that a solver reports about its own result.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask

if TYPE_CHECKING:
    from scipy.sparse import csr_array


# Of the curvature across a length so much is left along it, or rounding would make it negative.
_CURVED = 1e-9


class Status(str, Enum):
    """The test that ended a solve."""

    CONVERGED = 'converged'
    ITERATION_LIMIT = 'iteration_limit'
    STALLED = 'stalled'
    OUT_OF_TIME = 'out_of_time'


SENTENCES = {
    Status.CONVERGED: 'the stopping test was met',
    Status.ITERATION_LIMIT: 'the iterations ran out before the stopping test was met',
    Status.STALLED: 'no step along the last direction lowers the cost',
    Status.OUT_OF_TIME: 'the time budget ran out before the stopping test was met',
}


def l1_cost(residual: Array) -> float:
    """Return the sum of the absolute values of the whitened residual (rows,)."""
    return float(np.abs(residual).sum())


def l2_cost(residual: Array) -> float:
    """Return chi2, the sum of squares of the whitened residual (rows,); no half."""
    # Not as an inner product: BLAS would wake its threads for it.
    return float((residual * residual).sum())


class Smoothed(NamedTuple):
    """A smoothed norm at e (m, k): cost, gradient (m, k), curvature (m, k, k)."""

    cost: float
    gradient: Array
    curvature: Array


class Norm(Protocol):
    """
    What is minimised of a whitened residual r (rows,), F(r), and what goes with it.

    It is a sum over groups of `size` consecutive rows, convex, and does not change when a group
    turns.
    """

    @property
    def size(self) -> int:
        """Rows of a group."""

    def cost(self, residual: Array) -> float:
        """Return F(r)."""

    def resolvent(self, dual: Array, sigma: Array | float) -> Array:
        """Return (I + sigma dF*)^-1 of a dual (rows,); for sigma 0 the nearest feasible dual."""

    def gap(self, residual: Array, dual: Array) -> float:
        """Return F(r) + F*(y) - y'r, 0 or more; with A'y = 0 what a linear problem can lose."""


class SmoothNorm(Norm, Protocol):
    """A norm of factors, which Newton's method minimises with their duals y, (m, k)."""

    def weights(self, residual: Array) -> Array:
        """Return the weights w (rows,) by which w r^2 is like F near r, but for a factor."""

    def smoothed(self, e: Array, y: Array, mu: float) -> Smoothed:
        """Return F near e (m, k), each corner rounded by mu, to be minimised with the dual y."""

    def reach(self, y: Array, dy: Array) -> float:
        """Return how far a feasible dual can go along dy before it becomes infeasible."""

    def slack(self, y: Array) -> Array:
        """Return how far each row of a dual may move, (rows,)."""


@dataclass(frozen=True)
class Lengths:
    """
    Sum of the lengths of the groups: L1 where each is one row, else group L1.

    L1 depends on the axes that a residual is written in. Where a group is a factor, its length is
    Mahalanobis' distance, which does not: turn the body's frame, and the map stays.
    """

    size: int = 1

    def cost(self, residual: Array) -> float:
        """See `Norm`."""
        return float(_lengths(residual, self.size).sum())

    def weights(self, residual: Array) -> Array:
        """See `SmoothNorm`; smoothed, where a group is shorter than usual."""
        length = _lengths(residual, self.size)
        return np.repeat(1 / np.hypot(length, smoothing(length)), self.size)

    def resolvent(self, dual: Array, sigma: Array | float) -> Array:
        """See `Norm`: y / max(1, |y|)."""
        return dual / np.repeat(np.maximum(_lengths(dual, self.size), 1.0), self.size)

    def gap(self, residual: Array, dual: Array) -> float:
        """See `Norm`; F* is 0 for a dual no longer than 1."""
        return self.cost(residual) - float((dual * residual).sum())

    def smoothed(self, e: Array, y: Array, mu: float) -> Smoothed:
        """See `SmoothNorm`: R = sqrt(|e|^2 + mu^2); (I - (y e' + e y') / 2 R) / R."""
        groups = e.reshape(-1, self.size)
        R = np.sqrt((groups * groups).sum(axis=1, keepdims=True) + mu * mu)
        d = groups / R
        crossed = (1 - _CURVED) * y.reshape(groups.shape)[:, :, None] * d[:, None, :]
        W = (np.eye(self.size) - (crossed + crossed.transpose(0, 2, 1)) / 2) / R[:, :, None]
        if self.size == 1:
            W = W.reshape(*e.shape, 1) * np.eye(e.shape[1])
        return Smoothed(float(R.sum()), d.reshape(e.shape), W)

    def reach(self, y: Array, dy: Array) -> float:
        """See `SmoothNorm`."""
        y, dy = y.reshape(-1, self.size), dy.reshape(-1, self.size)
        a, b = (dy * dy).sum(axis=1), (y * dy).sum(axis=1)
        c = np.maximum(1 - (y * y).sum(axis=1), 0.0)
        # The larger root of |y + t dy| = 1, without cancellation where dy is small.
        root = np.sqrt(b * b + a * c)
        reach = np.where(b > 0, c / np.maximum(b + root, 1e-300),
                         (root - b) / np.maximum(a, 1e-300))
        return float(reach.min(initial=np.inf))

    def slack(self, y: Array) -> Array:
        """See `SmoothNorm`."""
        return np.repeat(1 - _lengths(y, self.size), self.size)


@dataclass(frozen=True)
class Huber:
    """
    Sum of scale rho(s) over the lengths s of groups, s^2 up to delta, 2 delta s - delta^2 beyond.

    That is g2o's. With delta infinite it is chi2, L2 without a half.
    """

    size: int = 1
    delta: float = np.inf
    scale: float = 1.0

    def cost(self, residual: Array) -> float:
        """See `Norm`."""
        length = _lengths(residual, self.size)
        if self.delta == np.inf:
            return self.scale * float((length * length).sum())
        return self.scale * float(np.where(length <= self.delta, length**2,
                                           2 * self.delta * length - self.delta**2).sum())

    def weights(self, residual: Array) -> Array:
        """See `SmoothNorm`."""
        if self.delta == np.inf:
            return np.full_like(residual, self.scale)
        length = np.maximum(_lengths(residual, self.size), self.delta)
        return np.repeat(self.scale * self.delta / length, self.size)

    def resolvent(self, dual: Array, sigma: Array | float) -> Array:
        """See `Norm`: y / (1 + sigma / 2 scale), no longer than 2 delta scale."""
        dual = dual / (1 + np.asarray(sigma) / (2 * self.scale))
        excess = _lengths(dual, self.size) / (2 * self.delta * self.scale)
        return dual / np.repeat(np.maximum(excess, 1.0), self.size)

    def gap(self, residual: Array, dual: Array) -> float:
        """See `Norm`; F* is |y|^2 / 4 scale."""
        return (self.cost(residual) + l2_cost(dual) / (4 * self.scale)
                - float((dual * residual).sum()))

    def smoothed(self, e: Array, y: Array, mu: float) -> Smoothed:
        """See `SmoothNorm`; it has no corner, and is reweighted."""
        weights = 2 * self.weights(e.ravel()).reshape(e.shape)
        return Smoothed(self.cost(e.ravel()), weights * e,
                        weights[:, :, None] * np.eye(e.shape[1]))

    def reach(self, y: Array, dy: Array) -> float:
        """See `SmoothNorm`; the dual is the derivative, whatever it was before."""
        return np.inf

    def slack(self, y: Array) -> Array:
        """See `SmoothNorm`: to its bound, but no further than for a residual of one sigma."""
        left = 2 * self.delta * self.scale - _lengths(y, self.size)
        return np.repeat(np.clip(left, 0.0, 2 * self.scale), self.size)


@dataclass(frozen=True)
class Mixed:
    """
    One norm of odometry, another one of loops and absolute poses.

    parts : both, and which of the m factors each is of, (m,) bool
    """

    parts: tuple[tuple[SmoothNorm, Mask], ...]

    @property
    def size(self) -> int:
        """See `Norm`."""
        return max(norm.size for norm, _ in self.parts)

    def cost(self, residual: Array) -> float:
        """See `Norm`."""
        return sum(norm.cost(r) for norm, r in self._split(residual))

    def weights(self, residual: Array) -> Array:
        """See `SmoothNorm`."""
        return self._joined([norm.weights(r) for norm, r in self._split(residual)])

    def resolvent(self, dual: Array, sigma: Array | float) -> Array:
        """See `Norm`."""
        sigmas = self._split(np.broadcast_to(sigma, dual.shape))
        return self._joined([norm.resolvent(y, s) for (norm, y), (_, s) in zip(
            self._split(dual), sigmas, strict=True)])

    def gap(self, residual: Array, dual: Array) -> float:
        """See `Norm`."""
        return sum(norm.gap(r, y) for (norm, r), (_, y) in zip(
            self._split(residual), self._split(dual), strict=True))

    def smoothed(self, e: Array, y: Array, mu: float) -> Smoothed:
        """See `SmoothNorm`."""
        gradient = np.empty_like(e)
        curvature = np.empty((*e.shape, e.shape[1]))
        cost = 0.0
        for norm, own in self.parts:
            part, gradient[own], curvature[own] = norm.smoothed(e[own], y[own], mu)
            cost += part
        return Smoothed(cost, gradient, curvature)

    def reach(self, y: Array, dy: Array) -> float:
        """See `SmoothNorm`."""
        return min(norm.reach(y[own], dy[own]) for norm, own in self.parts)

    def slack(self, y: Array) -> Array:
        """See `SmoothNorm`."""
        return self._joined([norm.slack(y[own]) for norm, own in self.parts])

    def _split(self, rows: Array) -> list[tuple[SmoothNorm, Array]]:
        factors = rows.reshape(len(self.parts[0][1]), -1)
        return [(norm, factors[own].ravel()) for norm, own in self.parts]

    def _joined(self, found: list[Array]) -> Array:
        m = len(self.parts[0][1])
        rows = np.empty((m, sum(map(len, found)) // m))
        for (_, own), part in zip(self.parts, found, strict=True):
            rows[own] = part.reshape(-1, rows.shape[1])  # a part may have no factors
        return rows.ravel()


@dataclass(frozen=True)
class Largest:
    """The largest of |r|, L-infinity: one group of all rows; for the reference method alone."""

    size: int

    def cost(self, residual: Array) -> float:
        """See `Norm`."""
        return float(np.abs(residual).max(initial=0.0))

    def resolvent(self, dual: Array, sigma: Array | float) -> Array:
        """See `Norm`: the nearest dual whose |y| sum up to 1 at most; sigma is one number."""
        size = np.sort(np.abs(dual))[::-1]
        excess = np.maximum((np.cumsum(size) - 1) / np.arange(1, len(size) + 1), 0.0)
        threshold = excess.max(initial=0.0)
        return np.sign(dual) * np.maximum(np.abs(dual) - threshold, 0.0)

    def gap(self, residual: Array, dual: Array) -> float:
        """See `Norm`; F* is 0 for a dual whose |y| sum up to no more than 1."""
        return self.cost(residual) - float((dual * residual).sum())


L1 = Lengths()

# What makes each of `names.NORMS` of the rows of a factor, Huber's delta [sigmas] and a scale.
NORM_OF: dict[str, Callable[[int, float, float], SmoothNorm]] = {
    'l1': lambda size, delta, scale: L1,
    'group-l1': lambda size, delta, scale: Lengths(size),
    'l2': lambda size, delta, scale: Huber(scale=scale),
    'huber': Huber,
}


def norm_of(name: str, size: int, delta: float = np.inf, scale: float = 1.0) -> SmoothNorm:
    """Return one of `names.NORMS` for factors of so many rows; delta, scale : of Huber."""
    return NORM_OF[name](size, delta, scale)


def _lengths(rows: Array, size: int) -> Array:
    if size == 1:
        return np.abs(rows).ravel()
    groups = rows.reshape(-1, size)
    return np.sqrt((groups * groups).sum(axis=1))


def smoothing(residual: Array) -> float:
    """Return the mean of |r|, or where all fits exactly a millionth of a sigma."""
    # Weights of rows that fit to rounding must stay comparable with those of exact zeros.
    return max(l1_cost(residual) / max(len(residual), 1), 1e-6)


def fits_exactly(cost: float, rows: int) -> bool:
    """Tell whether only rounding is left: less than a billionth of a sigma in each row."""
    return cost <= 1e-9 * rows


def duality_gap(A: 'csr_array', b: Array, x: Array, y: Array, box: Array,
                norm: Norm = L1) -> float:
    """
    Bound how far x is from the best step inside a box: |x_j| <= box_j.

    For every such x' and every |y|_inf <= 1,
    `|A x' - b|_1 >= y'(A x' - b) >= -b'y - box'|A'y|`, so

        gap = |A x - b|_1 + b'y + box'|A'y|,

    and of another norm F(A x - b) + F*(y) + b'y + box'|A'y|.

    Parameters
    ----------
    A, b : the system, (rows, columns) and (rows,)
    x, y : primal (columns,) and dual (rows,), |y| <= 1
    box : (columns,) half widths; without a box the gap is infinite unless A'y = 0

    """
    Ax = A @ x
    return norm.gap(Ax - b, y) + float(y @ Ax) + float(box @ np.abs(A.T @ y))
