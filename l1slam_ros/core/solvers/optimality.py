# SPDX-License-Identifier: Apache-2.0
"""
How good an answer is, recomputed from the problem itself: objectives, duality gap, status.

Nothing here trusts what a solver says of its own result.
"""

from enum import Enum
from typing import TYPE_CHECKING

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


def smoothing(residual: Array) -> float:
    """Return the mean of |r|, or where all fits exactly a millionth of a sigma."""
    # Weights of rows that fit to rounding must stay comparable with those of exact zeros.
    return max(l1_cost(residual) / max(len(residual), 1), 1e-6)


def fits_exactly(cost: float, rows: int) -> bool:
    """Tell whether only rounding is left: less than a billionth of a sigma in each row."""
    return cost <= 1e-9 * rows


def duality_gap(A: 'csr_array', b: Array, x: Array, y: Array, box: Array) -> float:
    """
    Bound how far x is from the best step inside a box: |x_j| <= box_j.

    For every such x' and every |y|_inf <= 1,
    `|A x' - b|_1 >= y'(A x' - b) >= -b'y - box'|A'y|`, so

        gap = |A x - b|_1 + b'y + box'|A'y|.

    Parameters
    ----------
    A, b : the system, (rows, columns) and (rows,)
    x, y : primal (columns,) and dual (rows,), |y| <= 1
    box : (columns,) half widths; without a box the gap is infinite unless A'y = 0

    """
    return l1_cost(A @ x - b) + float(b @ y) + float(box @ np.abs(A.T @ y))
