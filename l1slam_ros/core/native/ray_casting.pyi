"""What rays say of a grid's cells, and of points; see `occupancy.grid` and `submaps`."""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask

def cast_rays(log_odds: NDArray[np.float32], origin: Array, resolution: float, starts: Array,
              ends: Array, hits: Mask, free: float, occupied: float, most: float) -> None:
    """
    Add rays to a grid of log odds, (a, b), in place.

    origin : (2,) the corner of cell (0, 0) [m]; resolution : [m]; starts, ends : (r, 2) [m];
    hits : (r,) whether a surface is at the end; free, occupied : what a ray takes from the cells
    it passes, and adds to the one it ends in; most : bound of either sign
    """

def contradictions(points: Array, views: Array, poses: Array, off: float) -> tuple[int, int]:
    """
    Return how many points the rays of some views agree with, and how many they pass through.

    points : (n, 2) [m]; views : (v, b) the range in each of b equal bearings [m], NaN: none;
    poses : (v, 3) where they were seen from; off : [m] by which a ray passes what it contradicts
    """
