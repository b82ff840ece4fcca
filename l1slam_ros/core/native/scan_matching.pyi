"""Point-to-line matching of a scan with a map; see `l1slam_ros.core.scans.matching`."""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.geometry.manifold import Array

def normal_equations(points: Array, normals: Array, map_points: Array, map_normals: Array,
                     nearest: NDArray[np.int32], origin: Array, resolution: float, pose: Array,
                     gate: float, scale: float) -> Array:
    """
    Return the sums of one step of Gauss-Newton, (17,).

    points, normals : (n, 2) of the moving scan; map_points, map_normals : (m, 2); nearest : (a, b)
    for each cell the map's nearest point, -1: none; origin : (2,) the corner of cell (0, 0) [m];
    resolution : [m]; pose : (3,); gate : [m] beyond which points do not match; scale : [m] of
    Cauchy's weights. The sums are the upper triangle of H by rows (6), that of the sum over groups
    of points of their part of g times itself (6), g (3), how many points match, and the weighted
    squared residuals [m^2].
    """

def match(points: Array, normals: Array, map_points: Array, map_normals: Array,
          nearest: NDArray[np.int32], origin: Array, resolution: float, start: Array,
          prior: Array, information: Array, units: Array, gate: float, scale: float,
          variance: float, off_normal: float) -> tuple[Array, Array, float, Array]:
    """
    Return pose (3,), H (3, 3), its least eigenvalue in `units` and the sums of the last round.

    start : (3,); prior, information : (3,) and (3, 3) in its axes; units : (3,) in which
    directions are compared; gate : of the first round [m]; variance : of a residual [m^2];
    off_normal : [rad] normals are off by so much, and what they say by that alone is taken out of
    H. The others as above.
    """

def information(H: Array, scatter: Array, variance: float) -> Array:
    """
    Return H over a variance, or less where a gradient scatters more, (3, 3).

    H : (3, 3); scatter : (6,) the upper triangle of the covariance of the gradient by rows;
    variance : [m^2] by which H would be that covariance
    """
