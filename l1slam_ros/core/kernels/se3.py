# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
SE(3) factor by factor: the residual e = (t, 2 q_v) of Z^-1 Xi^-1 Xj, Jacobians, curvature.

z, x_i, x_j : (m, 7) measurements and poses. Formulas: see `se3` of the geometry.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop


@compiled
def _product(a, b):
    """Return the quaternion of R(a)' R(b), x y z w."""
    return (a[3] * b[0] - a[0] * b[3] - a[1] * b[2] + a[2] * b[1],
            a[3] * b[1] - a[1] * b[3] - a[2] * b[0] + a[0] * b[2],
            a[3] * b[2] - a[2] * b[3] - a[0] * b[1] + a[1] * b[0],
            a[3] * b[3] + a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@compiled
def _turned_back(q, v):
    """Return R(q)' v."""
    a = 2 * (v[1] * q[2] - v[2] * q[1])
    b = 2 * (v[2] * q[0] - v[0] * q[2])
    c = 2 * (v[0] * q[1] - v[1] * q[0])
    return (v[0] + q[3] * a + b * q[2] - c * q[1],
            v[1] + q[3] * b + c * q[0] - a * q[2],
            v[2] + q[3] * c + a * q[1] - b * q[0])


@compiled
def _write_matrix(q, R):
    """Write R(q)."""
    x, y, z, w = q
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)


@compiled
def _seen(z, x_i, x_j):
    """Return the position and the quaternion of j seen from i, and that of the error, qw >= 0."""
    q_z, q_i = (z[3], z[4], z[5], z[6]), (x_i[3], x_i[4], x_i[5], x_i[6])
    p = _turned_back(q_i, (x_j[0] - x_i[0], x_j[1] - x_i[1], x_j[2] - x_i[2]))
    q_ij = _product(q_i, (x_j[3], x_j[4], x_j[5], x_j[6]))
    q = _product(q_z, q_ij)
    if q[3] < 0:
        q = (-q[0], -q[1], -q[2], -q[3])
    return p, q_ij, q


@loop('(f8[:, ::1], f8[:, ::1], f8[:, ::1])')
def residual(z, x_i, x_j):
    """Return e (m, 6)."""
    e = np.empty((len(z), 6))
    for f in range(len(z)):
        p, _, q = _seen(z[f], x_i[f], x_j[f])
        t = _turned_back((z[f, 3], z[f, 4], z[f, 5], z[f, 6]),
                         (p[0] - z[f, 0], p[1] - z[f, 1], p[2] - z[f, 2]))
        for k in range(3):
            e[f, k], e[f, 3 + k] = t[k], 2 * q[k]
    return e


@loop('(f8[:, ::1], f8[:, ::1], f8[:, ::1])')
def jacobians(z, x_i, x_j):
    """Return J_e_i and J_e_j, (m, 2, 6, 6)."""
    J = np.zeros((len(z), 2, 6, 6))
    J_i, J_j = J[:, 0], J[:, 1]
    R_z = np.empty((3, 3))
    R_ij = np.empty((3, 3))
    M = np.empty((3, 3))
    for f in range(len(z)):
        p, q_ij, q = _seen(z[f], x_i[f], x_j[f])
        _write_matrix((z[f, 3], z[f, 4], z[f, 5], z[f, 6]), R_z)
        _write_matrix(q_ij, R_ij)
        _write_skew(q, M)
        for k in range(3):
            M[k, k] = q[3]
        for r in range(3):
            # Row r of Rz' times [p]x is p x (column r of Rz), sign turned.
            J_i[f, r, 3] = R_z[1, r] * p[2] - R_z[2, r] * p[1]
            J_i[f, r, 4] = R_z[2, r] * p[0] - R_z[0, r] * p[2]
            J_i[f, r, 5] = R_z[0, r] * p[1] - R_z[1, r] * p[0]
            for c in range(3):
                J_i[f, r, c] = -R_z[c, r]
                J_j[f, 3 + r, 3 + c] = M[r, c]
                for k in range(3):
                    J_j[f, r, c] += R_z[k, r] * R_ij[k, c]
                    J_i[f, 3 + r, 3 + c] -= M[r, k] * R_ij[c, k]
    return J


@compiled
def _write_skew(v, matrix):
    """Write [v]x, with zeros on the diagonal."""
    matrix[0, 0] = matrix[1, 1] = matrix[2, 2] = 0.0
    matrix[0, 1], matrix[0, 2], matrix[1, 2] = -v[2], v[1], -v[0]
    matrix[1, 0], matrix[2, 0], matrix[2, 1] = v[2], -v[1], v[0]


@loop('(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])')
def curvature(z, x_i, x_j, dual):
    """Return the rows of turns of the Hessian of dual'e, (m, 2, 3, 12); see `manifold`."""
    H = np.zeros((len(z), 2, 3, 12))
    R = np.empty((3, 3))
    S = np.empty((3, 3))
    K = np.empty((3, 3))
    for f in range(len(z)):
        p, q_ij, q = _seen(z[f], x_i[f], x_j[f])
        # R(-q)' turns forwards.
        m = _turned_back((-z[f, 3], -z[f, 4], -z[f, 5], z[f, 6]),
                         (dual[f, 0], dual[f, 1], dual[f, 2]))
        y = (dual[f, 3], dual[f, 4], dual[f, 5])
        along = q[0] * y[0] + q[1] * y[1] + q[2] * y[2]
        pull = m[0] * p[0] + m[1] * p[1] + m[2] * p[2]
        _write_matrix(q_ij, R)
        _write_skew(m, S)
        _write_skew((q[3] * y[0] - q[1] * y[2] + q[2] * y[1],
                     q[3] * y[1] - q[2] * y[0] + q[0] * y[2],
                     q[3] * y[2] - q[0] * y[1] + q[1] * y[0]), K)
        for k in range(3):
            K[k, k] = along
            H[f, 0, k, 3 + k] = m[k] * p[k] - pull - along / 2
            H[f, 1, k, 9 + k] = -along / 2
        for r in range(3):
            for c in range(3):
                H[f, 0, r, c] = -S[r, c]
                if c < r:
                    H[f, 0, r, 3 + c] = H[f, 0, c, 3 + r] = (m[r] * p[c] + p[r] * m[c]) / 2
                for k in range(3):
                    H[f, 0, r, 6 + c] += S[r, k] * R[k, c]
                    H[f, 0, r, 9 + c] += R[r, k] * K[k, c] / 2
                H[f, 1, c, 3 + r] = H[f, 0, r, 9 + c]
    return H
