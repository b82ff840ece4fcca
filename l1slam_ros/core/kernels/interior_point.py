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
    for k in range(len(g)):
        dy[k] = q[k] * (moved[k] + g[k])
        du[k] = (c1[k] + u[k] * dy[k]) / s[k] - u[k]
        dv[k] = (c2[k] - v[k] * dy[k]) / t[k] - v[k]
        primal = max(primal, -du[k] / u[k], -dv[k] / v[k])
        dual = max(dual, dy[k] / s[k], -dy[k] / t[k])
    primal, dual = fraction / primal, fraction / dual
    total = 0.0
    for k in range(len(u)):
        total += ((u[k] + primal * du[k]) * (s[k] - dual * dy[k])
                  + (v[k] + primal * dv[k]) * (t[k] + dual * dy[k]))
    return dy, du, dv, primal, dual, total
