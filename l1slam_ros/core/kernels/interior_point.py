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
become. What can be worked out again from the step of y, dy, is not kept: to read it from memory
would take longer.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop

# u, v, s, t, q, e, y
_STATE = 'f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1]'


@loop('(f8[::1], f8)')
def begin(e, mu):
    """Return u, v, s, t, y with e = u - v, u s = v t = mu, s = 1 - y and t = 1 + y."""
    new = (np.empty_like(e), np.empty_like(e), np.empty_like(e), np.empty_like(e),
           np.empty_like(e))
    u, v, s, t, y = new
    for k in range(len(e)):
        root = np.sqrt(mu * mu + e[k] * e[k])
        large = (mu + root + abs(e[k])) / 2
        small = mu * (mu + root) / (2 * large)  # (mu + root - |e|) / 2 would cancel
        u[k] = large if e[k] >= 0 else small
        v[k] = small if e[k] >= 0 else large
        s[k] = mu / u[k]
        t[k] = mu / v[k]
        y[k] = e[k] / (mu + root)
    return new


@loop('(f8[::1], f8[::1], f8[::1], f8[::1])')
def weigh(u, v, s, t):
    """Return q, and the complementarity u's + v't."""
    q = np.empty_like(u)
    gap = 0.0
    for k in range(len(u)):
        q[k] = 1 / (u[k] / s[k] + v[k] / t[k])
        gap += u[k] * s[k] + v[k] * t[k]
    return q, gap


@loop(f'({_STATE}, f8[::1], f8[::1])')
def aim(u, v, s, t, q, e, y, c1, c2):
    """Return -(y + q g), g = e - (u - v) - (c1/s - u) + (c2/t - v)."""
    pull = np.empty_like(e)
    for k in range(len(e)):
        pull[k] = -y[k] - q[k] * (e[k] - c1[k] / s[k] + c2[k] / t[k])
    return pull


@loop(f'({_STATE}, f8[::1], f8, f8)')
def aim_combined(u, v, s, t, q, e, y, dy, mu, most):
    """
    Return c1, c2, and what `aim` does for them: mu, corrected by what the affine step leaves.

    dy : of the affine step; most : of each correction
    """
    c1, c2, pull = np.empty_like(e), np.empty_like(e), np.empty_like(e)
    for k in range(len(e)):
        by_s, by_t = 1 / s[k], 1 / t[k]
        of_u = (u[k] * dy[k] * by_s - u[k]) * dy[k]
        of_v = (-v[k] * dy[k] * by_t - v[k]) * dy[k]
        c1[k] = mu + min(max(of_u, -most), most)
        c2[k] = mu - min(max(of_v, -most), most)
        pull[k] = -y[k] - q[k] * (e[k] - c1[k] * by_s + c2[k] * by_t)
    return c1, c2, pull


@loop(f'({_STATE}, f8[::1], f8[::1], f8[::1], f8, f8)')
def aim_centrally(u, v, s, t, q, e, y, dy, c1, c2, least, most):
    """
    Return c1, c2 that bring all products at the end of a step between bounds, and as `aim`.

    dy, c1, c2 : of that step. Meant to become c1 and c2, they end as c1 - du dy and c2 + dv dy. Of
    those far too large no more is taken than the most they may be, or they would rule the step.
    """
    new1, new2, pull = np.empty_like(e), np.empty_like(e), np.empty_like(e)
    for k in range(len(e)):
        by_s, by_t = 1 / s[k], 1 / t[k]
        end1 = c1[k] - ((c1[k] + u[k] * dy[k]) * by_s - u[k]) * dy[k]
        end2 = c2[k] + ((c2[k] - v[k] * dy[k]) * by_t - v[k]) * dy[k]
        new1[k] = c1[k] + max(min(max(end1, least), most) - end1, -most)
        new2[k] = c2[k] + max(min(max(end2, least), most) - end2, -most)
        pull[k] = -y[k] - q[k] * (e[k] - new1[k] * by_s + new2[k] * by_t)
    return new1, new2, pull


@compiled
def _largest(values, least):
    """Return the largest of some values, `least` where all are smaller."""
    a = b = c = d = least
    whole = len(values) - len(values) % 4
    # Four at a time, none of which waits for another one.
    for k in range(0, whole, 4):
        a = values[k] if values[k] > a else a
        b = values[k + 1] if values[k + 1] > b else b
        c = values[k + 2] if values[k + 2] > c else c
        d = values[k + 3] if values[k + 3] > d else d
    for k in range(whole, len(values)):
        a = values[k] if values[k] > a else a
    return max(max(a, b), max(c, d))


@loop(f'({_STATE}, f8[::1], f8[::1], f8[::1], f8)')
def complete(u, v, s, t, q, e, y, c1, c2, moved, fraction):
    """
    Return the step of y that belongs to a step of the residual, and how far to go.

    moved : J dx; fraction : of the way to the nearest bound, which is never more than the step.
    The last two are the lengths of the primal and of the dual step; then u's + v't after them.
    """
    step, primal_ratio, dual_ratio = np.empty_like(e), np.empty_like(e), np.empty_like(e)
    # The nearest bound is where the step is largest beside what is left. The largest of all is
    # found apart: within this loop it would keep it from being done eight rows at a time.
    here = by_primal = by_dual = by_both = 0.0
    for k in range(len(e)):
        by_s, by_t = 1 / s[k], 1 / t[k]
        dy = q[k] * (moved[k] + (e[k] - c1[k] * by_s + c2[k] * by_t))
        du = (c1[k] + u[k] * dy) * by_s - u[k]
        dv = (c2[k] - v[k] * dy) * by_t - v[k]
        step[k] = dy
        of_u, of_v = -du / u[k], -dv / v[k]
        primal_ratio[k] = of_u if of_u > of_v else of_v
        of_s, of_t = dy * by_s, -dy * by_t
        dual_ratio[k] = of_s if of_s > of_t else of_t
        here += u[k] * s[k] + v[k] * t[k]
        by_primal += du * s[k] + dv * t[k]
        by_dual += (v[k] - u[k]) * dy
        by_both += (dv - du) * dy
    primal, dual = _largest(primal_ratio, fraction), _largest(dual_ratio, fraction)
    primal, dual = fraction / primal, fraction / dual
    return step, primal, dual, (
        here + primal * by_primal + dual * (by_dual + primal * by_both))


@loop('(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8, f8, f8)')
def advance(u, v, s, t, y, c1, c2, dy, primal, dual, least):
    """Move u and v that far along a step, s, t and y that far; s and t stay above `least`."""
    for k in range(len(u)):
        du, dv = (c1[k] + u[k] * dy[k]) / s[k] - u[k], (c2[k] - v[k] * dy[k]) / t[k] - v[k]
        u[k] += primal * du
        v[k] += primal * dv
        s[k] = max(s[k] - dual * dy[k], least)
        t[k] = max(t[k] + dual * dy[k], least)
        y[k] += dual * dy[k]


@loop('(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])')
def missing(u, v, s, t, e):
    """Return the complementarity u's + v't, and |e - u + v|_1."""
    gap = apart = 0.0
    for k in range(len(e)):
        gap += u[k] * s[k] + v[k] * t[k]
        apart += abs(e[k] - u[k] + v[k])
    return gap, apart


@loop('(f8[::1], f8[::1], f8[::1], f8)')
def depart(after, e, moved, length):
    """Return |after|_1 and |after - (e + length moved)|_1."""
    cost = departure = 0.0
    for k in range(len(e)):
        cost += abs(after[k])
        departure += abs(after[k] - (e[k] + length * moved[k]))
    return cost, departure
