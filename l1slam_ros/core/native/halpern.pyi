"""
The iteration of `solvers.restarted_pdhg` in single precision, in tiles of 16 factors.

tiles : (t, 2 k k + 3 k, 16) of each factor its blocks, b, y and y0; keyframe : (t, 2, 16) int32,
rows of x, z, g, (n + 1, k), the last of what is held fixed. See `graph.tiles`.
"""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.tiles import Single

def scale(keyframe: Indices, blocks: Array, n: int) -> tuple[Array, Array]:
    """
    Return the blocks in scaled unknowns, (m, 2, k, k), and R_v^-1 of each keyframe, (n, k, k).

    keyframe, blocks : as of `blocks`.
    """

def iterate(
    tiles: Single, keyframe: NDArray[np.int32], x: Single, z: Single, g: Single, weight: float,
    first: int, count: int,
) -> None:
    """
    Advance x, the y of the tiles and g = A'y by `count` iterations.

    z : scratch; first : iterations since the restart.
    """

def look(
    tiles: Single, keyframe: NDArray[np.int32], x: Single, g: Single, weight: float,
    x_bar: Single, g_bar: Single, y_bar: Single,
) -> tuple[float, float, float]:
    """
    Find the next point without the pull to the restart: x_bar, g_bar = A'y_bar, y_bar (t, k, 16).

    Return the squared fixed-point residual, |A x_bar - b|_1 and -b'y_bar.
    """
