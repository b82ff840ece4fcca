"""Supernodal Cholesky of a sparse matrix of k x k blocks, which `blocks.assemble` wrote."""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.geometry.manifold import Array, Indices

# int32
Positions = NDArray[np.signedinteger]

def factorise(
    panels: Array, first: Positions, start: Indices, pattern: Positions, offset: Indices,
    stride: Indices, share: NDArray[np.int8], k: int, threads: int,
) -> int:
    """
    Turn the lower triangle in `panels` into its factor.

    Return the first position whose pivot is not positive, the number of positions when all are.

    first .. stride : where panels lie, first and pattern int32, see `symbolic.lay_out` and
    `BlockCholesky`; share : (panels,), 0 and 1 may be worked on at the same time, 2 comes after
    both; threads : how many may be used.
    """
