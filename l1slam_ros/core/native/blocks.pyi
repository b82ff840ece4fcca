"""
Products with the two blocks of each factor, and the normal matrix.

keyframe : (m, 2) int64, which of n free keyframes each block multiplies, another number for one
that is held fixed; blocks : (m, 2, k, k). See `LinearSystem`.
"""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.geometry.manifold import Array, Indices

def multiply(keyframe: Indices, blocks: Array, x: Array) -> Array:
    """Return A x, (m, k); x (n, k)."""

def multiply_transposed(keyframe: Indices, blocks: Array, y: Array, n: int) -> Array:
    """Return A'y, (n, k); y (m, k)."""

def whiten(roots: Array, vectors: Array) -> Array:
    """Return L' e of each factor, (m, k); roots (m, k, k) L', upper triangular."""

def unwhiten_dual(roots: Array, duals: Array) -> Array:
    """Return L y of each factor, (m, k); roots (m, k, k) L', upper triangular."""

def whiten_blocks(roots: Array, blocks: Array) -> None:
    """Turn J_i and J_j of each factor into L'J_i and L'J_j, in place; roots (m, k, k) L'."""

def assemble(
    panels: Array, keyframe: Indices, address: Indices, width: Indices, turned: NDArray[np.bool_],
    corner: Indices, stride: Indices, blocks: Array, weights: Array, diagonal: Array,
    curvature: Array, share: float,
) -> None:
    """
    Write the lower triangle of J'WJ + diag(diagonal) + share C to the panels of `cholesky`.

    address, width, turned, corner, stride : see `symbolic.block_addresses`; weights (m, k);
    diagonal (n, k); curvature (m', 2, k // 2, 2 k) of the first m' factors, C their sum.
    """
