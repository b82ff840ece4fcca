"""Solving with the factor that `cholesky` left in the panels, forwards and backwards."""

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.native.cholesky import Positions

def solve(
    panels: Array, first: Positions, start: Indices, pattern: Positions, offset: Indices,
    stride: Indices, position: Positions, right: Array,
) -> Array:
    """
    Return the solution of L L' x = right; both (n, k) in the order of the keyframes.

    first .. stride : as of `cholesky.factorise`; position : (n,) of each keyframe in the order of
    elimination.
    """
