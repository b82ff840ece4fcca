# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The row-wise work of one interior-point step in a single pass; names as in `interior_point`.

All arrays are (rows,). q = 1 / (u/s + v/t); c1, c2 are what the products u s and v t are to
become.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import loop


@loop('(f8[::1], f8)')
def begin(e, mu):
    """Return u, v, s, t, y with e = u - v, u s = v t = mu, s = 1 - y and t = 1 + y."""
    new = (np.empty_like(e), np.empty_like(e), np.empty_like(e), np.empty_like(e),
           np.empty_like(e))
    u, v, s, t, y = new
    for k in range(len(e)):
        root = np.hypot(mu, e[k])
        large = (mu + root + abs(e[k])) / 2
        small = mu * (mu + root) / (2 * large)  # (mu + root - |e|) / 2 would cancel
        u[k], v[k] = (large, small) if e[k] >= 0 else (small, large)
        s[k] = mu / u[k]
        t[k] = mu / v[k]
        y[k] = e[k] / (mu + root)
    return new


@loop('(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])')
def aim(e, y, s, t, q, c1, c2):
    """Return g = e - (u - v) - (c1/s - u) + (c2/t - v), and y + q g."""
    g, pull = np.empty_like(e), np.empty_like(e)
    for k in range(len(e)):
        g[k] = e[k] - c1[k] / s[k] + c2[k] / t[k]
        pull[k] = y[k] + q[k] * g[k]
    return g, pull


@loop('(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8)')
def complete(u, v, s, t, q, c1, c2, g, moved, fraction):
    """
    Return the step of y, u and v that belongs to a step of the residual, and how far to go.

    moved : J dx; fraction : of the way to the nearest bound, which is never more than the step.
    The last two are the lengths of the primal and of the dual step; then u's + v't after them.
    """
    dy, du, dv = np.empty_like(g), np.empty_like(g), np.empty_like(g)
    # No branch, which would be mistaken half the time: the nearest bound is where the step is
    # largest beside what is left.
    primal = dual = fraction
    here = by_primal = by_dual = by_both = 0.0
    for k in range(len(g)):
        dy[k] = q[k] * (moved[k] + g[k])
        du[k] = (c1[k] + u[k] * dy[k]) / s[k] - u[k]
        dv[k] = (c2[k] - v[k] * dy[k]) / t[k] - v[k]
        primal = max(primal, -du[k] / u[k], -dv[k] / v[k])
        dual = max(dual, dy[k] / s[k], -dy[k] / t[k])
        here += u[k] * s[k] + v[k] * t[k]
        by_primal += du[k] * s[k] + dv[k] * t[k]
        by_dual += (v[k] - u[k]) * dy[k]
        by_both += (dv[k] - du[k]) * dy[k]
    primal, dual = fraction / primal, fraction / dual
    return dy, du, dv, primal, dual, (
        here + primal * by_primal + dual * (by_dual + primal * by_both))


@loop('(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8, f8, f8)')
def advance(u, v, s, t, y, du, dv, dy, primal, dual, least):
    """Return u and v that far along a step, s, t and y that far; s and t stay above `least`."""
    new = (np.empty_like(u), np.empty_like(u), np.empty_like(u), np.empty_like(u),
           np.empty_like(u))
    new_u, new_v, new_s, new_t, new_y = new
    for k in range(len(u)):
        new_u[k] = u[k] + primal * du[k]
        new_v[k] = v[k] + primal * dv[k]
        new_s[k] = max(s[k] - dual * dy[k], least)
        new_t[k] = max(t[k] + dual * dy[k], least)
        new_y[k] = y[k] + dual * dy[k]
    return new
