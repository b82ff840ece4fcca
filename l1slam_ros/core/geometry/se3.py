# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
SE(3): poses of a robot in space, rows (x, y, z [m], qx, qy, qz, qw) in the order of ROS.

The verbs are those of `manifold.Manifold`. Quaternions come out with norm 1 and qw >= 0. A step is
(rho [m], omega [rad]) and moves a pose by (rho, exp omega). The residual is (t, 2 q_v) of the
error: twice the quaternion's vector part, radians for small angles. Formulas: Sola, "Quaternion
kinematics for the error-state Kalman filter" (2017).
"""

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array, are_few

NAME = 'SE3'
POSE_SIZE = 7
TANGENT_SIZE = 6
TRANSLATION = slice(0, 3)
ROTATION = slice(3, 6)
COVARIANCE_ROWS: tuple[int, ...] = (0, 1, 2, 3, 4, 5)

# A quaternion whose squared norm is that near to 1 is left as it is: what was normalised once and
# written to a file reads back the same.
_UNIT = 4 * np.finfo(float).eps
# [rad] Below, terms of the fourth order of an angle are lost in rounding.
_SMALL = 1e-4


def _cross(a: Array, b: Array) -> Array:
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        product[..., k] = a[..., m] * b[..., n] - a[..., n] * b[..., m]
    return product


def _skew(v: Array) -> Array:
    """Return [v]x, (n, 3, 3): [v]x u = v x u."""
    matrix = np.zeros((*v.shape, 3))
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        matrix[..., m, n], matrix[..., n, m] = -v[..., k], v[..., k]
    return matrix


def _turned(q: Array, v: Array) -> Array:
    """Return R(q) v."""
    twice = 2 * _cross(q[..., :3], v)
    return v + q[..., 3:] * twice + _cross(q[..., :3], twice)


def _matrix(q: Array) -> Array:
    """Return R(q), (n, 3, 3)."""
    x = q[..., :3]
    w = q[..., 3, None, None]
    half = w**2 - 0.5
    return 2.0 * (half * np.eye(3) + x[..., :, None] * x[..., None, :] + w * _skew(x))


def _opposite(q: Array) -> Array:
    return q * [-1.0, -1.0, -1.0, 1.0]


def _times(a: Array, b: Array) -> Array:
    """Return the quaternion of R(a) R(b)."""
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    x, y = a[..., :3], b[..., :3]
    product[..., :3] = a[..., 3:] * y + b[..., 3:] * x + _cross(x, y)
    product[..., 3] = a[..., 3] * b[..., 3] - (x * y).sum(axis=-1)
    return product


def _pose(t: Array, q: Array) -> Array:
    """Return rows of t and q, normalised, qw >= 0."""
    square = (q * q).sum(axis=-1, keepdims=True)
    scale = np.where(np.abs(square - 1) <= _UNIT, 1.0, 1 / np.sqrt(square))
    return np.concatenate((t, np.where(q[..., 3:] < 0, -scale, scale) * q), axis=-1)


def _log(q: Array) -> Array:
    """Return the shortest omega, |omega| <= pi, of a quaternion with qw >= 0."""
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    half = np.arctan2(sine, q[..., 3:])
    return 2 * q[..., :3] / np.sinc(half / np.pi)


def identity(n: int) -> Array:
    """Return n identity poses, (n, 7)."""
    pose = np.zeros((n, 7))
    pose[:, 6] = 1.0
    return pose


def compose(a: Array, b: Array) -> Array:
    """Return a b, (n, 7)."""
    if are_few(a, b):
        return native.poses.compose(a, b)
    return _pose(a[..., :3] + _turned(a[..., 3:], b[..., :3]), _times(a[..., 3:], b[..., 3:]))


def inverse(a: Array) -> Array:
    """Return a^-1, (n, 7)."""
    if are_few(a):
        return native.poses.inverse(a)
    q = _opposite(a[..., 3:])
    return _pose(-_turned(q, a[..., :3]), q)


def between(a: Array, b: Array) -> Array:
    """Return a^-1 b, (n, 7)."""
    if are_few(a, b):
        return native.poses.between(a, b)
    q = _opposite(a[..., 3:])
    return _pose(_turned(q, b[..., :3] - a[..., :3]), _times(q, b[..., 3:]))


def retract(pose: Array, step: Array) -> Array:
    """Return pose (rho, exp omega), (n, 7)."""
    if are_few(pose, step):
        return native.poses.retract(pose, step)
    rows = np.ascontiguousarray(pose).reshape(-1, 7), np.ascontiguousarray(step).reshape(-1, 6)
    return native.se3.retract(*rows).reshape(pose.shape)


def local(a: Array, b: Array) -> Array:
    """Return the step that retracts a to b, (n, 6)."""
    if are_few(a, b):
        return native.poses.local(a, b)
    relative = between(a, b)
    return np.concatenate((relative[..., :3], _log(relative[..., 3:])), axis=-1)


def adjoint(pose: Array) -> Array:
    """Return Ad = [[R, [t]x R], [0, R]], (n, 6, 6)."""
    R = _matrix(pose[..., 3:])
    J = np.zeros((*pose.shape[:-1], 6, 6))
    J[..., :3, :3] = J[..., 3:, 3:] = R
    J[..., :3, 3:] = _skew(pose[..., :3]) @ R
    return J


def residual(measurement: Array, pose_i: Array, pose_j: Array) -> Array:
    """Return (t, 2 q_v) of Z^-1 Xi^-1 Xj, (n, 6)."""
    return native.se3.residual(measurement, pose_i, pose_j)


def residual_jacobians(measurement: Array, pose_i: Array, pose_j: Array) -> Array:
    """
    Return J_r_i and J_r_j, (n, 2, 6, 6).

    With p = Ri'(tj - ti), Rij = Ri'Rj, q the quaternion of the error and M = q_w I + [q_v]x:
    `J_r_i = [[-Rz', Rz'[p]x], [0, -M Rij']]` and `J_r_j = [[Rz' Rij, 0], [0, M]]`.
    """
    return native.se3.jacobians(measurement, pose_i, pose_j)


def residual_curvature(measurement: Array, pose_i: Array, pose_j: Array, dual: Array) -> Array:
    """
    Return the rows of turns of the Hessian of dual'e, (n, 2, 3, 12); dual (n, 6); see `manifold`.

    With m = Rz y_t and y the dual's rotation part, the blocks (and that of om_j by om_i) are
    `(om_i, rho_i) = -[m]x`, `(om_i, rho_j) = [m]x Rij`,
    `(om_i, om_i) = (m p' + p m')/2 - (m.p + q_v.y/2) I`, `(om_j, om_j) = -(q_v.y)/2 I`,
    `(om_i, om_j) = Rij ((q_v.y) I + [q_w y - q_v x y]x)/2`. The residual is linear in all else.
    """
    return native.se3.curvature(measurement, pose_i, pose_j, dual)


def local_jacobian(a: Array, b: Array) -> Array:
    """
    Return J_l_b of `local`, (n, 6, 6).

    `[[Ra' Rb, 0], [0, K]]`, with omega the turn from a to b and theta its angle
    `K = I + [omega]x / 2 + (1 - theta/2 cot(theta/2)) / theta^2 [omega]x^2`.
    """
    relative = between(a, b)
    omega = _log(relative[..., 3:])
    theta = np.linalg.norm(omega, axis=-1)[..., None, None]
    large = np.maximum(theta, _SMALL)
    share = np.where(theta < _SMALL, 1 / 12, (1 - large / 2 / np.tan(large / 2)) / large**2)
    W = _skew(omega)
    J = np.zeros((*b.shape[:-1], 6, 6))
    J[..., :3, :3] = _matrix(relative[..., 3:])
    J[..., 3:, 3:] = np.eye(3) + W / 2 + share * (W @ W)
    return J


def interpolate(a: Array, b: Array, fraction: Array) -> Array:
    """Return the poses along a straight line and at an even turn, (n, 7)."""
    return retract(a, fraction[..., None] * local(a, b))


def motion(step: Array) -> tuple[Array, Array]:
    """Return the length [m] and the angle [rad] of each relative pose, (n,) and (n,)."""
    if are_few(step):
        return native.poses.motion(step)
    return np.linalg.norm(step[..., :3], axis=-1), np.linalg.norm(step[..., 3:], axis=-1)


def positions(pose: Array) -> Array:
    """Return x, y, z [m], (n, 3)."""
    return pose[..., :3]


def rotation(pose: Array) -> Array:
    """Return R(q), (n, 3, 3)."""
    return _matrix(pose[..., 3:])


def from_rotation(R: Array, t: Array) -> Array:
    """Return poses from rotation matrices (n, 3, 3) and positions (n, 3), (n, 7)."""
    # 4 q q', of which the row with the largest entry is the most exact.
    square = np.empty((*R.shape[:-2], 4, 4))
    square[..., :3, :3] = R + np.swapaxes(R, -1, -2)
    trace = np.trace(R, axis1=-2, axis2=-1)
    diagonal = 1 - trace[..., None] + 2 * np.diagonal(R, axis1=-2, axis2=-1)
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        square[..., k, k] = diagonal[..., k]
        square[..., k, 3] = square[..., 3, k] = R[..., n, m] - R[..., m, n]
    square[..., 3, 3] = 1 + trace
    largest = np.argmax(np.diagonal(square, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(square, largest[..., None, None], axis=-2)[..., 0, :]
    return _pose(t, q)


def from_pose3(pose3: Array) -> Array:
    """Return the poses with their quaternions normalised and qw >= 0, (n, 7)."""
    return _pose(pose3[..., :3], pose3[..., 3:])


def to_pose3(pose: Array) -> Array:
    """Return the poses as they are, (n, 7)."""
    return pose
