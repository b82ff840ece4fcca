"""
The row-wise work of one interior-point step; names as in `solvers.interior_point`.

All arrays are (rows,). q = 1 / (u/s + v/t); c1, c2 are what the products u s and v t are to
become.
"""

from l1slam_ros.core.geometry.manifold import Array

def begin(e: Array, mu: float) -> tuple[Array, Array, Array, Array, Array]:
    """Return u, v, s, t, y with e = u - v, u s = v t = mu, s = 1 - y and t = 1 + y."""

def weigh(u: Array, v: Array, s: Array, t: Array) -> tuple[Array, float]:
    """Return q, and the complementarity u's + v't."""

def aim(
    u: Array, v: Array, s: Array, t: Array, q: Array, e: Array, y: Array, c1: Array, c2: Array,
) -> Array:
    """Return -(y + q g), g = e - (u - v) - (c1/s - u) + (c2/t - v)."""

def aim_combined(
    u: Array, v: Array, s: Array, t: Array, q: Array, e: Array, y: Array, dy: Array, mu: float,
    most: float,
) -> tuple[Array, Array, Array]:
    """
    Return c1, c2, and what `aim` does for them: mu, corrected by what the affine step leaves.

    dy : of the affine step; most : of each correction.
    """

def aim_centrally(
    u: Array, v: Array, s: Array, t: Array, q: Array, e: Array, y: Array, dy: Array, c1: Array,
    c2: Array, least: float, most: float,
) -> tuple[Array, Array, Array]:
    """
    Return c1, c2 that bring all products at the end of a step between bounds, and as `aim`.

    dy, c1, c2 : of that step.
    """

def complete(
    u: Array, v: Array, s: Array, t: Array, q: Array, e: Array, y: Array, c1: Array, c2: Array,
    moved: Array, fraction: float,
) -> tuple[Array, float, float, float]:
    """
    Return the step of y, the lengths of the primal and the dual step, and u's + v't after them.

    moved : J dx; fraction : of the way to the nearest bound, which is never more than the step.
    """

def advance(
    u: Array, v: Array, s: Array, t: Array, y: Array, c1: Array, c2: Array, dy: Array,
    primal: float, dual: float, least: float,
) -> None:
    """Move u and v that far along a step, s, t and y that far; s and t stay above `least`."""

def missing(u: Array, v: Array, s: Array, t: Array, e: Array) -> tuple[float, float]:
    """Return the complementarity u's + v't, and |e - u + v|_1."""

def depart(after: Array, e: Array, moved: Array, length: float) -> tuple[float, float]:
    """Return |after|_1 and |after - (e + length moved)|_1."""
