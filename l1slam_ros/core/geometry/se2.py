# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
SE(2): poses of a robot in the plane, rows (x [m], y [m], theta [rad]).

The verbs are those of `manifold.Manifold`. Angles come out in (-pi, pi]. Formulas: Grisetti et
al., "A Tutorial on Graph-Based SLAM" (2010), sections IV and V, with the step on the right.
"""

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array, are_few

NAME = 'SE2'
POSE_SIZE = 3
TANGENT_SIZE = 3
TRANSLATION = slice(0, 2)
ROTATION = slice(2, 3)
# Where x, y and yaw stand in the 6x6 covariance of a ROS message (x y z rx ry rz).
COVARIANCE_ROWS: tuple[int, ...] = (0, 1, 5)


def wrap(angle: Array) -> Array:
    """Return the angle [rad] in (-pi, pi]; values already there are returned to the last bit."""
    if np.abs(angle).max(initial=0.0) < np.pi:
        return angle
    wrapped = angle - 2 * np.pi * np.rint(angle / (2 * np.pi))
    # Rounding can leave it one rounding outside.
    return np.where(wrapped <= -np.pi, np.pi, np.minimum(wrapped, np.pi))


def _turned(theta: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Return R(theta) (x, y)', the two coordinates."""
    c, s = np.cos(theta), np.sin(theta)
    return c * x - s * y, s * x + c * y


def _pose(x: Array, y: Array, theta: Array) -> Array:
    pose = np.empty((*theta.shape, 3))
    pose[..., 0], pose[..., 1], pose[..., 2] = x, y, wrap(theta)
    return pose


def identity(n: int) -> Array:
    """Return n identity poses, (n, 3)."""
    return np.zeros((n, 3))


def compose(a: Array, b: Array) -> Array:
    """Return a b, (n, 3)."""
    if are_few(a, b):
        return native.poses.compose(a, b)
    x, y = _turned(a[..., 2], b[..., 0], b[..., 1])
    return _pose(a[..., 0] + x, a[..., 1] + y, a[..., 2] + b[..., 2])


def inverse(a: Array) -> Array:
    """Return a^-1, (n, 3)."""
    if are_few(a):
        return native.poses.inverse(a)
    return _pose(*_turned(-a[..., 2], -a[..., 0], -a[..., 1]), -a[..., 2])


def between(a: Array, b: Array) -> Array:
    """Return a^-1 b, (n, 3)."""
    if are_few(a, b):
        return native.poses.between(a, b)
    moved = _turned(-a[..., 2], b[..., 0] - a[..., 0], b[..., 1] - a[..., 1])
    return _pose(*moved, b[..., 2] - a[..., 2])


def retract(pose: Array, step: Array) -> Array:
    """Return pose v2t(step); a pose of SE(2) and its tangent share their coordinates."""
    if are_few(pose, step):
        return native.poses.retract(pose, step)
    rows = (np.ascontiguousarray(each).reshape(-1, 3) for each in (pose, step))
    return native.se2.retract(*rows).reshape(pose.shape)


def local(a: Array, b: Array) -> Array:
    """Return t2v(a^-1 b), (n, 3)."""
    return between(a, b)


def adjoint(pose: Array) -> Array:
    """Return Ad = [[R, (y, -x)'], [0, 1]], (n, 3, 3)."""
    J = np.zeros((*pose.shape, 3))
    J[..., 0, 0] = J[..., 1, 1] = np.cos(pose[..., 2])
    J[..., 1, 0] = np.sin(pose[..., 2])
    J[..., 0, 1] = -J[..., 1, 0]
    J[..., 0, 2] = pose[..., 1]
    J[..., 1, 2] = -pose[..., 0]
    J[..., 2, 2] = 1.0
    return J


def residual(measurement: Array, pose_i: Array, pose_j: Array) -> Array:
    """Return t2v(Z^-1 Xi^-1 Xj), (n, 3)."""
    return native.se2.residual(measurement, pose_i, pose_j)


def residual_jacobians(measurement: Array, pose_i: Array, pose_j: Array) -> Array:
    """
    Return J_r_i and J_r_j, (n, 2, 3, 3).

    With t = Ri'(tj - ti): `J_r_i = [[-Rz', Rz'(t_y, -t_x)'], [0, -1]]` and
    `J_r_j = [[Rz' Ri' Rj, 0], [0, 1]]`.
    """
    return native.se2.jacobians(measurement, pose_i, pose_j)


def residual_curvature(measurement: Array, pose_i: Array, pose_j: Array, dual: Array) -> Array:
    """
    Return the rows of turns of the Hessian of dual'e, (n, 2, 1, 6); dual (n, 3); see `manifold`.

    With m = Rz y_t, h = Rij' m (minus and plus the gradients of the positions) and
    t = Ri'(tj - ti), the entries are (theta_i, x_i) = m_y,
    (theta_i, y_i) = -m_x, (theta_i, theta_i) = -m.t, (theta_i, x_j) = -h_y,
    (theta_i, y_j) = h_x. The residual is linear in all else.
    """
    return native.se2.curvature(measurement, pose_i, pose_j, dual)


def local_jacobian(a: Array, b: Array) -> Array:
    """Return J_l_b of t2v(a^-1 b) = [[Ra' Rb, 0], [0, 1]], (n, 3, 3)."""
    theta = b[..., 2] - a[..., 2]
    J = np.zeros((*b.shape, 3))
    J[..., 0, 0] = J[..., 1, 1] = np.cos(theta)
    J[..., 1, 0] = np.sin(theta)
    J[..., 0, 1] = -J[..., 1, 0]
    J[..., 2, 2] = 1.0
    return J


def interpolate(a: Array, b: Array, fraction: Array) -> Array:
    """Return a v2t(fraction t2v(a^-1 b)), (n, 3)."""
    return retract(a, fraction[..., None] * local(a, b))


def motion(step: Array) -> tuple[Array, Array]:
    """Return the length [m] and the angle [rad] of each relative pose, (n,) and (n,)."""
    if are_few(step):
        return native.poses.motion(step)
    return np.hypot(step[..., 0], step[..., 1]), np.abs(step[..., 2])


def positions(pose: Array) -> Array:
    """Return x, y [m], (n, 2)."""
    return pose[..., :2]


def rotation(pose: Array) -> Array:
    """Return R(theta), (n, 2, 2)."""
    return local_jacobian(identity(len(pose)), pose)[..., :2, :2]


def from_rotation(R: Array, t: Array) -> Array:
    """Return poses from rotation matrices (n, 2, 2) and positions (n, 2), (n, 3)."""
    return _pose(t[..., 0], t[..., 1], np.arctan2(R[..., 1, 0], R[..., 0, 0]))


def from_pose3(pose3: Array) -> Array:
    """Project x y z qx qy qz qw (n, 7) onto the plane: x, y and the yaw, (n, 3)."""
    if are_few(pose3):
        return native.poses.onto_plane(np.asarray(pose3, np.float64))
    qx, qy, qz, qw = (pose3[..., k] for k in range(3, 7))
    yaw = np.arctan2(2 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)
    return np.concatenate((pose3[..., :2], yaw[..., None]), axis=-1)


def to_pose3(pose: Array) -> Array:
    """Return x y 0 0 0 sin(theta/2) cos(theta/2), (n, 7)."""
    pose3 = np.zeros((*pose.shape[:-1], 7))
    pose3[..., :2] = pose[..., :2]
    pose3[..., 5] = np.sin(pose[..., 2] / 2)
    pose3[..., 6] = np.cos(pose[..., 2] / 2)
    return pose3
