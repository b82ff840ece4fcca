"""
Sampled steps of all keyframes, (n + 1, k, 48), and the innovations that they predict.

The last row is of what is held fixed, k 3 or 6; keyframe (m, sides) int64, rows of the steps;
blocks (m, sides, k, k).
"""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.native.cholesky import Positions

def gather(keyframe: Indices, blocks: Array, y: NDArray[np.int8], product: Array) -> None:
    """Add A'y of all samples to product, (n + 1, k, 48); y (m, k, 48)."""

def solve_many(
    panels: Array, first: Positions, start: Indices, pattern: Positions, offset: Indices,
    stride: Indices, position: Positions, right: Array,
) -> None:
    """
    Turn right hand sides, (n, k, 48) in the order of the keyframes, into L'^-1 L^-1 right.

    Other arguments : as of `substitution.solve`.
    """

def left_over(keyframe: Indices, blocks: Array, x: Array, y: NDArray[np.int8]) -> Array:
    """
    Return the second moment of y - A x of each factor, (m, k, k).

    x : (n + 1, k, 48); y : (m', k, 48) of the first m' factors, zero of the others.
    """

def moved(keyframe: Indices, blocks: Array, x: Array) -> Array:
    """Return A x of each factor and sample, (m, k, 48); x (n + 1, k, 48)."""

def normalise(covariance: Array, residual: Array) -> tuple[Array, Array]:
    """
    Return r'C^-1 r and ln det C of each factor, (m,) each; C (m, k, k), r (m, k).

    Where C is not definite beyond rounding, infinity and minus infinity.
    """

def normalise_pairs(
    covariance: Array, residual: Array, shared: Array, first: Indices, second: Indices,
) -> tuple[Array, Array]:
    """
    Return what `normalise` does, of pairs of factors together, (pairs,) each.

    covariance : (m, k, k) of each; shared : (m k, m k) of all with all, what is read of it are
    the blocks of first and second ones, (pairs,) each.
    """
