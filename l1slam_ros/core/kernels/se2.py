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

Cosines and sines, most of the work, are found for all factors at once, eight at a time where the
processor can: calls of the mathematical library for each take eleven times as long.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop

# Coefficients of the polynomials for sine and cosine from -pi/4 to pi/4, in powers of the square,
# of the cubic and of the fourth-order term on. Source: Sun Microsystems' fdlibm, k_sin.c, k_cos.c.
_SINE = (-1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04,
         2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10)
_COSINE = (4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
           -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11)


@compiled
def _turns(poses):
    """
    Return the cosine and the sine of the angle [rad] of each pose, (m,) each.

    As exact as for an angle that differs by the rounding of this one. NaN and infinity become NaN;
    an angle so large that its rounding is a turn becomes some other angle.
    """
    c, s = np.empty(len(poses)), np.empty(len(poses))
    # No branch: each choice is one between two values, or nothing would be done eight at a time.
    for k in range(len(poses)):
        quarters = np.rint(poses[k, 2] * (2 / np.pi))
        r = poses[k, 2] - quarters * (np.pi / 2)
        r = 0.0 if abs(r) > 1.0 else r
        w = r * r
        sine = _SINE[0] + w * (_SINE[1] + w * (_SINE[2] + w * (_SINE[3] + w * (
            _SINE[4] + w * _SINE[5]))))
        cosine = _COSINE[0] + w * (_COSINE[1] + w * (_COSINE[2] + w * (_COSINE[3] + w * (
            _COSINE[4] + w * _COSINE[5]))))
        sine = r + r * w * sine
        cosine = 1 - w / 2 + w * w * cosine
        quadrant = quarters - 4 * np.floor(quarters / 4)
        is_odd = quadrant == 1 or quadrant == 3
        along = sine if is_odd else cosine
        across = cosine if is_odd else sine
        c[k] = -along if quadrant == 1 or quadrant == 2 else along
        s[k] = -across if quadrant >= 2 else across
    return c, s


@compiled
def _wrapped(angle):
    """Return an angle [rad] in (-pi, pi], see `se2.wrap`."""
    angle -= 2 * np.pi * np.rint(angle / (2 * np.pi))
    # By comparisons that NaN fails, so that it stays.
    return np.pi if angle <= -np.pi or angle > np.pi else angle


@compiled
def _seen(x_i, x_j, c, s):
    """Return Ri'(tj - ti), the position of j seen from i; c, s : cosine and sine of i's angle."""
    dx, dy = x_j[0] - x_i[0], x_j[1] - x_i[1]
    return c * dx + s * dy, c * dy - s * dx


@compiled
def _turn_between(c_i, s_i, c_j, s_j):
    """Return cosine and sine of the angle from i to j, of which the cosine and sine are known."""
    return c_i * c_j + s_i * s_j, c_i * s_j - s_i * c_j


@loop('(f8[:, ::1], f8[:, ::1], f8[:, ::1])')
def residual(z, x_i, x_j):
    """Return e (m, 3)."""
    e = np.empty_like(z)
    c_z, s_z = _turns(z)
    c_i, s_i = _turns(x_i)
    for f in range(len(z)):
        c, s = c_z[f], s_z[f]
        tx, ty = _seen(x_i[f], x_j[f], c_i[f], s_i[f])
        e[f, 0] = c * (tx - z[f, 0]) + s * (ty - z[f, 1])
        e[f, 1] = c * (ty - z[f, 1]) - s * (tx - z[f, 0])
        e[f, 2] = _wrapped(x_j[f, 2] - x_i[f, 2] - z[f, 2])
    return e


@loop('(f8[:, ::1], f8[:, ::1], f8[:, ::1])')
def jacobians(z, x_i, x_j):
    """Return J_e_i and J_e_j, (m, 2, 3, 3)."""
    J = np.empty((len(x_i), 2, 3, 3))
    J_i, J_j = J[:, 0], J[:, 1]
    c_z, s_z = _turns(z)
    c_i, s_i = _turns(x_i)
    c_j, s_j = _turns(x_j)
    for f in range(len(x_i)):
        J[f] = 0.0  # one by one: to go through all of it twice takes longer
        c, s = c_z[f], s_z[f]
        tx, ty = _seen(x_i[f], x_j[f], c_i[f], s_i[f])
        J_i[f, 0, 0], J_i[f, 0, 1], J_i[f, 0, 2] = -c, -s, c * ty - s * tx
        J_i[f, 1, 0], J_i[f, 1, 1], J_i[f, 1, 2] = s, -c, -s * ty - c * tx
        J_i[f, 2, 2] = -1.0
        c_ij, s_ij = _turn_between(c_i[f], s_i[f], c_j[f], s_j[f])
        c_phi, s_phi = _turn_between(c, s, c_ij, s_ij)
        J_j[f, 0, 0], J_j[f, 0, 1] = c_phi, -s_phi
        J_j[f, 1, 0], J_j[f, 1, 1] = s_phi, c_phi
        J_j[f, 2, 2] = 1.0
    return J


@loop('(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])')
def curvature(z, x_i, x_j, dual):
    """Return the rows of turns of the Hessian of dual'e, (m, 2, 1, 6); see `manifold`."""
    H = np.empty((len(x_i), 2, 1, 6))
    c_z, s_z = _turns(z)
    c_i, s_i = _turns(x_i)
    c_j, s_j = _turns(x_j)
    for f in range(len(x_i)):
        H[f] = 0.0
        t = _seen(x_i[f], x_j[f], c_i[f], s_i[f])
        c, s = c_z[f], s_z[f]
        mx, my = c * dual[f, 0] - s * dual[f, 1], s * dual[f, 0] + c * dual[f, 1]
        c, s = _turn_between(c_i[f], s_i[f], c_j[f], s_j[f])
        of_i = H[f, 0, 0]
        of_i[0], of_i[1] = my, -mx
        of_i[2] = -(mx * t[0] + my * t[1])
        of_i[3], of_i[4] = s * mx - c * my, c * mx + s * my
    return H
