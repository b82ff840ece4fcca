"""Breadth-first trees of a graph, and products along them."""

from l1slam_ros.core.geometry.manifold import Array, Indices

def parents(i: Indices, j: Indices, n: int, roots: Indices) -> Indices:
    """
    Return the parent of each of n nodes in breadth-first trees, each root its own, (n,).

    -1: no path leads there. i, j : (m,) ends of the edges; roots : (r,), one tree after the other.
    """

def compose(parent: Indices, relative: Array) -> Array:
    """
    Return poses as products of relative ones from their root down, (n, p); p 3 or 7.

    parent : (n,), a root is its own; relative : (n, p) as seen from the parent, of roots their
    poses.
    """
