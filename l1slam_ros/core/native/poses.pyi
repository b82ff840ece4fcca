"""
The verbs of `l1slam_ros.core.geometry.manifold` for a few poses, of the plane or of space.

Poses are rows (n, 3) or (n, 7), steps (n, 3) or (n, 6) [m, rad], as `se2` and `se3` have them; an
argument with one row goes with all rows of the other.
"""

from l1slam_ros.core.geometry.manifold import Array

def compose(a: Array, b: Array) -> Array:
    """Return a b, (n, p)."""

def between(a: Array, b: Array) -> Array:
    """Return a^-1 b, (n, p)."""

def inverse(a: Array) -> Array:
    """Return a^-1, (n, p)."""

def retract(pose: Array, step: Array) -> Array:
    """Return the poses moved by steps in their own axes, (n, p)."""

def local(a: Array, b: Array) -> Array:
    """Return the steps that retract a to b, (n, k)."""

def motion(step: Array) -> tuple[Array, Array]:
    """Return the length [m] and the angle [rad] of each step, (n,) and (n,)."""
