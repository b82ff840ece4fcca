"""Clouds of points as one, of each cell one point; see `l1slam_ros.core.scans.submaps`."""

from l1slam_ros.core.geometry.manifold import Array, Indices

def merge(points: Array, normals: Array, counts: Indices, poses: Array, width: float
          ) -> tuple[Array, Array]:
    """
    Return the points that have normals, and these, (k, 2) each, in the frame that poses are in.

    points, normals : (n, 2) of all clouds one after the other [m]; counts : (c,) of each; poses :
    (c, 3); width : of a cell [m], where of each of four sides of a surface the first is kept
    """
