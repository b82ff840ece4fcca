# SPDX-License-Identifier: Apache-2.0
"""
Weighted linear least squares by one sparse factorisation, and the start it gives to L1.

In: a linear system A, b. Out: the step that minimises a weighted sum of squares.
"""

import numpy as np
from scipy.sparse import csc_array, csr_array, dia_array
from scipy.sparse.linalg import SuperLU, splu

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.manifold import Array

# Ten halvings bring the smoothing a thousand times below the mean residual, well under the
# percent that the primal-dual iterations then have to mend; each costs one factorisation.
_SMOOTHING_STEPS = 10
# [sigma] Weights of rows that fit to rounding must stay comparable with those of exact zeros.
_EXACT = 1e-6


def weighted_least_squares(
    A: csr_array, b: Array, weights: Array | None = None, damping: float = 0.0
) -> Array:
    """
    Return argmin_x sum_i w_i (A x - b)_i^2 + damping sum_j D_j x_j^2, (columns,).

    D is the diagonal of A'WA (Marquardt's scaling). Raises as `factorise`.
    """
    WA = A if weights is None else diagonal(weights) @ A
    H = (A.T @ WA).tocsc()
    if damping:
        H = (H + diagonal(damping * H.diagonal())).tocsc()
    x: Array = factorise(H).solve(WA.T @ b)
    return x


def factorise(H: csc_array) -> SuperLU:
    """
    Factor a sparse symmetric matrix without pivoting, in a fill-reducing symmetric order.

    Raises
    ------
    GraphError : the matrix is singular: some keyframe is not tied to the anchor.

    """
    try:
        return splu(H, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
                    options={'SymmetricMode': True})
    except RuntimeError as error:
        raise GraphError('the normal matrix is singular: a part of the graph is not tied to '
                         'the anchor, or weights differ beyond double precision') from error


def diagonal(values: Array) -> dia_array:
    """Return the diagonal matrix of values (n,)."""
    return dia_array((values[None], [0]), shape=(len(values), len(values)))


def reweighted_step(A: csr_array, b: Array, r: Array, mu: float) -> tuple[Array, Array]:
    """
    Return one step of iteratively reweighted least squares towards |A x - b|_1, and its dual.

    Weights w = 1 / sqrt(r^2 + mu^2) at the residual r (rows,). The normal equations say
    A'(w (A x - b)) = 0, so y = w (A x - b), clipped to the unit box, is nearly a feasible dual.

    Returns
    -------
    x : (columns,); y : (rows,)

    """
    weights = 1 / np.sqrt(r * r + mu * mu)
    x = weighted_least_squares(A, b, weights)
    return x, np.clip(weights * (A @ x - b), -1, 1)


def smoothing(r: Array) -> float:
    """Return the mean of |r|, or where all fits exactly a millionth of a sigma."""
    return max(float(np.abs(r).mean()), _EXACT)


def reweighted_start(A: csr_array, b: Array) -> tuple[Array, Array]:
    """
    Return a primal (columns,) and a dual (rows,) near the optimum of |A x - b|_1.

    From the least squares solution, `reweighted_step` with mu halved each time: it follows the
    minimum of sum sqrt(r^2 + mu^2). The optimum of the angles is often not unique (files round
    their numbers, so costs tie): this path leads to the middle of the optimal face, where a
    first-order method alone ends wherever it came from.
    """
    x = weighted_least_squares(A, b)
    mu = smoothing(A @ x - b)
    for _ in range(_SMOOTHING_STEPS):
        x, y = reweighted_step(A, b, A @ x - b, mu)
        mu /= 2
    return x, y
