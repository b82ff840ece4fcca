# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
SE(2) factor by factor: the residual e = t2v(Z^-1 Xi^-1 Xj), its Jacobians and its curvature.

z, x_i, x_j : (m, 3) measurements and poses. Formulas: see `se2`.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop


@compiled
def _seen(x_i, x_j):
    """Return Ri'(tj - ti): the position of j seen from i."""
    c, s = np.cos(x_i[2]), np.sin(x_i[2])
    dx, dy = x_j[0] - x_i[0], x_j[1] - x_i[1]
    return c * dx + s * dy, c * dy - s * dx


@loop('(f8[:, ::1], f8[:, ::1], f8[:, ::1])')
def residual(z, x_i, x_j):
    """Return e (m, 3), its angle not yet wrapped."""
    e = np.empty_like(z)
    for f in range(len(z)):
        c, s = np.cos(z[f, 2]), np.sin(z[f, 2])
        tx, ty = _seen(x_i[f], x_j[f])
        e[f, 0] = c * (tx - z[f, 0]) + s * (ty - z[f, 1])
        e[f, 1] = c * (ty - z[f, 1]) - s * (tx - z[f, 0])
        e[f, 2] = x_j[f, 2] - x_i[f, 2] - z[f, 2]
    return e


@loop('(f8[:, ::1], f8[:, ::1], f8[:, ::1])')
def jacobians(z, x_i, x_j):
    """Return J_e_i and J_e_j, (m, 2, 3, 3)."""
    J = np.empty((len(x_i), 2, 3, 3))
    J_i, J_j = J[:, 0], J[:, 1]
    for f in range(len(x_i)):
        J[f] = 0.0  # one by one: to go through all of it twice takes longer
        c, s = np.cos(z[f, 2]), np.sin(z[f, 2])
        phi = x_j[f, 2] - x_i[f, 2] - z[f, 2]
        tx, ty = _seen(x_i[f], x_j[f])
        J_i[f, 0, 0], J_i[f, 0, 1], J_i[f, 0, 2] = -c, -s, c * ty - s * tx
        J_i[f, 1, 0], J_i[f, 1, 1], J_i[f, 1, 2] = s, -c, -s * ty - c * tx
        J_i[f, 2, 2] = -1.0
        J_j[f, 0, 0], J_j[f, 0, 1] = np.cos(phi), -np.sin(phi)
        J_j[f, 1, 0], J_j[f, 1, 1] = np.sin(phi), np.cos(phi)
        J_j[f, 2, 2] = 1.0
    return J


@loop('(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])')
def curvature(z, x_i, x_j, dual):
    """Return the rows of turns of the Hessian of dual'e, (m, 2, 1, 6); see `manifold`."""
    H = np.empty((len(x_i), 2, 1, 6))
    for f in range(len(x_i)):
        H[f] = 0.0
        t = _seen(x_i[f], x_j[f])
        c, s = np.cos(z[f, 2]), np.sin(z[f, 2])
        mx, my = c * dual[f, 0] - s * dual[f, 1], s * dual[f, 0] + c * dual[f, 1]
        theta = x_j[f, 2] - x_i[f, 2]
        c, s = np.cos(theta), np.sin(theta)
        of_i = H[f, 0, 0]
        of_i[0], of_i[1] = my, -mx
        of_i[2] = -(mx * t[0] + my * t[1])
        of_i[3], of_i[4] = s * mx - c * my, c * mx + s * my
    return H
