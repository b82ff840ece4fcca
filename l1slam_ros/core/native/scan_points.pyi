"""From rays to points with normals; see `l1slam_ros.core.scans.points`."""

from l1slam_ros.core.geometry.manifold import Array, Indices

def points_of(ends: Array, ranges: Array, angles: Array, bearings: Indices, bins: int,
              range_min: float, range_max: float, increment: float, centre: Array
              ) -> tuple[Array, Array, Array]:
    """
    Return the points of a scan, their normals, (n, 2) each, and its view, (bins,).

    ends : (r, 2) of the rays [m]; ranges, angles : (r,) [m], [rad]; bearings : (r,) in which of
    the equal bins from 0 to 2 pi each is; range_min, range_max : ranges outside are of no surface
    [m]; increment : between rays [rad]; centre : (2,) of the laser [m]. A normal is of length 1
    and turned to the laser, or zero. The view is the least range in each bin, infinite: nothing
    was in range, NaN: the laser did not look.
    """
