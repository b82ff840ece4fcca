"""From rays to points with normals; see `l1slam_ros.core.scans.points`."""

from l1slam_ros.core.geometry.manifold import Array

def surface_along(points: Array, centre: Array, spacing: float, least_reach: float,
                  widening: float, off: float, away: Array, normals: Array) -> int:
    """
    Thin out the points of a scan in place, and find their normals; return how many are left.

    points : (n, 2) [m], following each other; centre : (2,) of the laser; spacing : [m] between
    points that are kept; least_reach, widening : [m], [m/m] of the range: neighbours within the
    greater one are of one line; off : [m] RMS distance from it; away, normals : (n, 2), take the
    points as seen from the laser and, from zeros, the normals
    """
