# SPDX-License-Identifier: Apache-2.0
"""
The row-wise work of one interior-point step, in single passes; names as in `interior_point`.

All arrays are (rows,). q = 1 / (u/s + v/t); c1, c2 are what the products u s and v t are to
become.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import loop


@loop('(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])')
def right_side(e, u, v, s, t, y, q, c1, c2):
    """Return g = e - (u - v) - (c1/s - u) + (c2/t - v), and y + q g."""
    g, z = np.empty_like(e), np.empty_like(e)
    for k in range(len(e)):
        g[k] = e[k] - c1[k] / s[k] + c2[k] / t[k]
        z[k] = y[k] + q[k] * g[k]
    return g, z


@loop('(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8)')
def complete(u, v, s, t, q, c1, c2, g, moved, fraction):
    """
    Return the step of y, u and v that belongs to a step of the residual, and how far to go.

    moved : J dx; fraction : of the way to the nearest bound, which is never more than the step.
    The last two are the lengths of the primal and of the dual step; then u's + v't after them.
    """
    dy, du, dv = np.empty_like(g), np.empty_like(g), np.empty_like(g)
    primal = dual = np.inf
    for k in range(len(g)):
        dy[k] = q[k] * (moved[k] + g[k])
        du[k] = (c1[k] + u[k] * dy[k]) / s[k] - u[k]
        dv[k] = (c2[k] - v[k] * dy[k]) / t[k] - v[k]
        if du[k] < 0:
            primal = min(primal, -u[k] / du[k])
        if dv[k] < 0:
            primal = min(primal, -v[k] / dv[k])
        if dy[k] > 0:
            dual = min(dual, s[k] / dy[k])
        if dy[k] < 0:
            dual = min(dual, -t[k] / dy[k])
    primal, dual = min(1.0, fraction * primal), min(1.0, fraction * dual)
    total = 0.0
    for k in range(len(u)):
        total += ((u[k] + primal * du[k]) * (s[k] - dual * dy[k])
                  + (v[k] + primal * dv[k]) * (t[k] + dual * dy[k]))
    return dy, du, dv, primal, dual, total


@loop('(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8, f8, f8)')
def advance(u, v, s, t, y, dy, du, dv, primal, dual, smallest):
    """Take the step in place; the slacks stay at `smallest` or above."""
    for k in range(len(u)):
        u[k] += primal * du[k]
        v[k] += primal * dv[k]
        y[k] += dual * dy[k]
        s[k] = max(s[k] - dual * dy[k], smallest)
        t[k] = max(t[k] + dual * dy[k], smallest)
