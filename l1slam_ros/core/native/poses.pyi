"""
The verbs of `l1slam_ros.core.geometry.manifold` for a few poses, of the plane or of space.

Poses are rows (n, 3) or (n, 7), steps (n, 3) or (n, 6) [m, rad], as `se2` and `se3` have them; an
argument with one row goes with all rows of the other.
"""

from l1slam_ros.core.geometry.manifold import Array, Indices

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

def onto_plane(pose3: Array) -> Array:
    """Return x, y and the yaw of poses (n, 7), (n, 3)."""

def places(times: Indices, asked: Indices, to: bool) -> Indices:
    """Return how many times (n,), ascending, are before each asked for, (m,); to : or equal."""

def interpolate(
    times: Indices, poses: Array, first: Indices, end: Indices, asked: Indices
) -> Array:
    """
    Return poses at the times asked for, (m, p), along straight lines and even turns.

    times (n,) ascending, poses (n, p) : samples; first, end : of the samples among which each is
    to be, (m,) or (1,)
    """
