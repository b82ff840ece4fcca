"""The look-up of a map's nearest point; see `l1slam_ros.core.scans.field`."""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.geometry.manifold import Array

def nearest_points(points: Array, origin: Array, resolution: float, reach: float,
                   nearest: NDArray[np.int32], best: Array) -> None:
    """
    Write into `nearest` which point is nearest to the centre of each cell, and how near it is.

    points : (n, 2) [m]; origin : (2,) the corner of cell (0, 0) [m]; resolution, reach : [m];
    nearest, best : (a, b), changed where a point is nearer than the square root of `best` [m^2]
    """
