# SPDX-License-Identifier: Apache-2.0
"""
How good an answer is, recomputed from the problem itself: objectives, duality gap, status.

Nothing here trusts what a solver says of its own result.
"""

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Protocol

import numpy as np

from l1slam_ros.core.geometry.manifold import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array


class Status(str, Enum):
    """Which test ended a solve."""

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

    def weights(self, residual: Array) -> Array:
        """Return the weights w (rows,) by which w r^2 is like F near r, but for a factor."""

    def resolvent(self, dual: Array, sigma: Array | float) -> Array:
        """Return (I + sigma dF*)^-1 of a dual (rows,); with sigma 0 the nearest that may be."""

    def gap(self, residual: Array, dual: Array) -> float:
        """Return F(r) + F*(y) - y'r, 0 or more; with A'y = 0 what a linear problem can lose."""


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
        """See `Norm`; smoothed, where a group is shorter than usual."""
        length = _lengths(residual, self.size)
        return np.repeat(1 / np.hypot(length, smoothing(length)), self.size)

    def resolvent(self, dual: Array, sigma: Array | float) -> Array:
        """See `Norm`: y / max(1, |y|)."""
        nearest: Array = dual / np.repeat(np.maximum(_lengths(dual, self.size), 1.0), self.size)
        return nearest

    def gap(self, residual: Array, dual: Array) -> float:
        """See `Norm`; F* is 0 for a dual no longer than 1."""
        return self.cost(residual) - float((dual * residual).sum())


@dataclass(frozen=True)
class Huber:
    """
    Sum of rho(s) over the lengths s of the groups, s^2 up to delta, 2 delta s - delta^2 beyond.

    That is g2o's. With delta infinite it is chi2, L2 without a half.
    """

    size: int = 1
    delta: float = np.inf

    def cost(self, residual: Array) -> float:
        """See `Norm`."""
        length = _lengths(residual, self.size)
        if self.delta == np.inf:
            return float((length * length).sum())
        return float(np.where(length <= self.delta, length**2,
                              2 * self.delta * length - self.delta**2).sum())

    def weights(self, residual: Array) -> Array:
        """See `Norm`."""
        if self.delta == np.inf:
            return np.ones_like(residual)
        length = np.maximum(_lengths(residual, self.size), self.delta)
        return np.repeat(self.delta / length, self.size)

    def resolvent(self, dual: Array, sigma: Array | float) -> Array:
        """See `Norm`: y / (1 + sigma / 2), no longer than 2 delta."""
        dual = dual / (1 + np.asarray(sigma) / 2)
        excess = _lengths(dual, self.size) / (2 * self.delta)
        nearest: Array = dual / np.repeat(np.maximum(excess, 1.0), self.size)
        return nearest

    def gap(self, residual: Array, dual: Array) -> float:
        """See `Norm`; F* is |y|^2 / 4."""
        return self.cost(residual) + l2_cost(dual) / 4 - float((dual * residual).sum())


@dataclass(frozen=True)
class Largest:
    """The largest of |r|, L-infinity: one group of all rows; for the reference method alone."""

    size: int

    def cost(self, residual: Array) -> float:
        """See `Norm`."""
        return float(np.abs(residual).max(initial=0.0))

    def weights(self, residual: Array) -> Array:
        """See `Norm`; of the largest rows alone."""
        largest: Array = (np.abs(residual) == self.cost(residual)).astype(np.float64)
        return largest

    def resolvent(self, dual: Array, sigma: Array | float) -> Array:
        """See `Norm`: the nearest dual whose |y| sum up to 1 at most; sigma is one number."""
        size = np.sort(np.abs(dual))[::-1]
        excess = np.maximum((np.cumsum(size) - 1) / np.arange(1, len(size) + 1), 0.0)
        threshold = excess.max(initial=0.0)
        nearest: Array = np.sign(dual) * np.maximum(np.abs(dual) - threshold, 0.0)
        return nearest

    def gap(self, residual: Array, dual: Array) -> float:
        """See `Norm`; F* is 0 for a dual whose |y| sum up to no more than 1."""
        return self.cost(residual) - float((dual * residual).sum())


L1 = Lengths()


def norm_of(name: str, size: int, delta: float = np.inf) -> Norm:
    """Return one of `names.NORMS` for factors of so many rows; delta : of Huber."""
    norms: dict[str, Norm] = {'l1': L1, 'group-l1': Lengths(size), 'l2': Huber(),
                              'huber': Huber(size, delta)}
    return norms[name]


def _lengths(rows: Array, size: int) -> Array:
    if size == 1:
        return np.abs(rows)
    groups = rows.reshape(-1, size)
    length: Array = np.sqrt((groups * groups).sum(axis=1))
    return length


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
