"""Search for a scan over shifts and turns; see `l1slam_ros.core.scans.search`."""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.geometry.manifold import Array

def search(levels: NDArray[np.uint8], blocks: NDArray[np.uint8], points: Array, rotations: Array,
           start: Array, most: int, least: float, rival: float, same: Array
           ) -> tuple[int, int, int, int, int]:
    """
    Return score, turn, column and row of the best shift of a scan, and the best other's score.

    levels, blocks : of `Field`, (h, a, b) and (8, 8, c, r); points : (n, 2) in cells, n at most
    257; rotations : (t, 2) cosine and sine of each turn; start : (2,) where (0, 0) is at the
    lowest shift, in cells of the levels; most : the greatest shift each way, at most 255; least :
    score to beat, turn -1: none does; rival : of the best score, above which another is found out,
    0: none is; same : (3,) within how many turns and cells of the best nothing is another, and
    after how many turns they begin anew. Scores are sums of likelihoods.
    """
