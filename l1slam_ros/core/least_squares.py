# SPDX-License-Identifier: Apache-2.0
"""
Weighted linear least squares by one sparse factorisation, and the start it gives to L1.

In: a linear system A, b. Out: the step that minimises a weighted sum of squares.
"""

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import splu

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.manifold import Array

# Ten halvings bring the smoothing a thousand times below the mean residual, well under the
# percent that the primal-dual iterations then have to mend; each costs one factorisation.
_SMOOTHING_STEPS = 10


def weighted_least_squares(
    A: csr_array, b: Array, weights: Array | None = None, damping: float = 0.0
) -> Array:
    """
    Return argmin_x sum_i w_i (A x - b)_i^2 + damping sum_j D_j x_j^2, (columns,).

    D is the diagonal of A'WA (Marquardt's scaling). The normal matrix is symmetric positive
    definite, so it is factored without pivoting, in a fill-reducing symmetric order.

    Raises
    ------
    GraphError : the matrix is singular: some keyframe is not tied to the anchor.

    """
    WA = A if weights is None else diags_array(weights) @ A
    H = (A.T @ WA).tocsc()
    if damping:
        H = (H + damping * diags_array(H.diagonal())).tocsc()
    try:
        factor = splu(H, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
                      options={'SymmetricMode': True})
    except RuntimeError as error:
        raise GraphError('the normal matrix is singular: a part of the graph is not tied to '
                         'the anchor, or weights differ beyond double precision') from error
    x: Array = factor.solve(WA.T @ b)
    return x


def reweighted_start(A: csr_array, b: Array) -> tuple[Array, Array]:
    """
    Return a primal and a dual near the optimum of |A x - b|_1, to start Algorithm 2 from.

    Minimises sum_i sqrt(r_i^2 + mu^2) with mu halved at each step, by iteratively reweighted
    least squares: weights w = 1 / sqrt(r^2 + mu^2). The normal equations A'(w r) = 0 say that
    y = w r is a feasible dual of the previous weights. The optimum of the angles is often not
    unique (files round their numbers, so costs tie): this start picks the middle of the optimal
    face, where a first-order method alone ends wherever it came from.

    Returns
    -------
    x : (columns,); y : (rows,), |y| < 1

    """
    x = weighted_least_squares(A, b)
    r = A @ x - b
    # A system that fits exactly would leave nothing to divide by.
    mu = max(float(np.abs(r).mean()), np.finfo(float).tiny ** 0.25)
    for _ in range(_SMOOTHING_STEPS):
        weights = 1 / np.sqrt(r * r + mu * mu)
        x = weighted_least_squares(A, b, weights)
        r = A @ x - b
        y = np.clip(weights * r, -1, 1)
        mu /= 2
    return x, y
