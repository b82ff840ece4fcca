"""
Where the entries of a block Cholesky factor lie: elimination tree, postorder, supernodes.

A graph is two arrays: the neighbours of node k are adjacent[start[k]:start[k + 1]], each once,
both ways round, k itself left out; start (n + 1,), adjacent, int32.
"""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.geometry.manifold import Indices

Places = NDArray[np.int32]

def neighbours(keyframe: Indices, size: int) -> tuple[Places, Places]:
    """
    Return the graph that factors make, neighbours ascending.

    keyframe : (m, 2) what each factor joins, from `size` on: none
    """

def lay_out(
    start: Places, adjacent: Places, order: Places,
) -> tuple[Places, Places, Indices, Places, NDArray[np.int8], float]:
    """
    Return the layout of a factor, see `block_cholesky.Pattern`, for any order of the nodes (n,).

    position (n,) of each node: a postorder, so as good; first (panels + 1,); start (panels + 1,);
    rows; halves (panels,); work, multiplications of blocks that one factorisation takes
    """

def block_addresses(
    keyframe: Indices, position: Places, first: Places, start: Indices, rows: Places,
    offset: Indices, stride: Indices, k: int,
) -> tuple[Indices, Indices, NDArray[np.bool_], Indices, Indices]:
    """
    Find where the blocks of a matrix of k x k blocks lie in the panels.

    keyframe : (m, 2) as of `neighbours`; offset, stride : of each panel, where it begins and how
    long its rows are

    Returns
    -------
    address, width, turned : of the block between the keyframes of each factor, (m,) each, see
        `blocks.assemble`
    corner, own : where each keyframe's own block begins and its panel's stride, (n,)

    """
