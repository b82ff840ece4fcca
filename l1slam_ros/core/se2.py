# SPDX-License-Identifier: Apache-2.0
"""
SE(2): poses of a robot in the plane, rows (x [m], y [m], theta [rad]).

The verbs are those of `manifold.Manifold`. Angles come out in (-pi, pi]. Formulas: Grisetti et
al., "A Tutorial on Graph-Based SLAM" (2010), sections IV and V, with the step on the right.
"""

import numpy as np

from l1slam_ros.core.manifold import Array

NAME = 'SE2'
POSE_SIZE = 3
TANGENT_SIZE = 3
TRANSLATION = slice(0, 2)
ROTATION = slice(2, 3)
# Where x, y and yaw stand in the 6x6 covariance of a ROS message (x y z rx ry rz).
COVARIANCE_ROWS = (0, 1, 5)


def wrap(angle: Array) -> Array:
    """Return the angle [rad] in (-pi, pi]; values already there are returned to the last bit."""
    inside = (angle > -np.pi) & (angle <= np.pi)
    wrapped = np.pi - np.mod(np.pi - angle, 2 * np.pi)
    # One rounding above pi the remainder is rounded up to the whole turn.
    return np.where(inside, angle, np.where(wrapped <= -np.pi, np.pi, wrapped))


def _rotate(theta: Array, vector: Array) -> Array:
    """Return R(theta) vector for stacked angles (n,) and vectors (n, 2)."""
    c, s = np.cos(theta), np.sin(theta)
    x, y = vector[..., 0], vector[..., 1]
    return np.stack((c * x - s * y, s * x + c * y), axis=-1)


def _join(translation: Array, theta: Array) -> Array:
    return np.concatenate((translation, wrap(theta)[..., None]), axis=-1)


def identity(n: int) -> Array:
    """Return n identity poses, (n, 3)."""
    return np.zeros((n, 3))


def compose(a: Array, b: Array) -> Array:
    """Return a b, (n, 3)."""
    return _join(a[..., :2] + _rotate(a[..., 2], b[..., :2]), a[..., 2] + b[..., 2])


def inverse(a: Array) -> Array:
    """Return a^-1, (n, 3)."""
    return _join(-_rotate(-a[..., 2], a[..., :2]), -a[..., 2])


def between(a: Array, b: Array) -> Array:
    """Return a^-1 b, (n, 3)."""
    return _join(_rotate(-a[..., 2], b[..., :2] - a[..., :2]), b[..., 2] - a[..., 2])


def retract(pose: Array, step: Array) -> Array:
    """Return pose v2t(step); a pose of SE(2) and its tangent share their coordinates."""
    return compose(pose, step)


def local(a: Array, b: Array) -> Array:
    """Return t2v(a^-1 b), (n, 3)."""
    return between(a, b)


def adjoint(pose: Array) -> Array:
    """Return Ad = [[R, (y, -x)'], [0, 1]], (n, 3, 3)."""
    J = np.zeros((*pose.shape, 3))
    J[..., :2, :2] = _rotation_matrix(pose[..., 2])
    J[..., 0, 2] = pose[..., 1]
    J[..., 1, 2] = -pose[..., 0]
    J[..., 2, 2] = 1.0
    return J


def residual(measurement: Array, pose_i: Array, pose_j: Array) -> Array:
    """Return t2v(Z^-1 Xi^-1 Xj), (n, 3)."""
    return between(measurement, between(pose_i, pose_j))


def residual_jacobians(measurement: Array, pose_i: Array, pose_j: Array) -> tuple[Array, Array]:
    """
    Return J_r_i and J_r_j, each (n, 3, 3).

    With t = Ri'(tj - ti): `J_r_i = [[-Rz', Rz'(t_y, -t_x)'], [0, -1]]` and
    `J_r_j = [[Rz' Ri' Rj, 0], [0, 1]]`.
    """
    relative = between(pose_i, pose_j)
    theta_z = measurement[..., 2]
    J_r_i = np.zeros((*pose_i.shape, 3))
    J_r_i[..., :2, :2] = -_rotation_matrix(-theta_z)
    lever = np.stack((relative[..., 1], -relative[..., 0]), axis=-1)
    J_r_i[..., :2, 2] = _rotate(-theta_z, lever)
    J_r_i[..., 2, 2] = -1.0
    return J_r_i, local_jacobian(measurement, relative)


def residual_curvature(
    measurement: Array, pose_i: Array, pose_j: Array, dual: Array
) -> Array:
    """
    Return the Hessian of dual'e over (step of i, step of j), (n, 6, 6); dual (n, 3).

    With l = Rz (dual_x, dual_y), t = Ri'(tj - ti) and phi the angle of the residual, the entries
    (and their mirrors) are (theta_i, x_i) = l_y, (theta_i, y_i) = -l_x, (theta_i, theta_i) = -l.t,
    (theta_i, x_j) = dual_x sin phi - dual_y cos phi,
    (theta_i, y_j) = dual_y sin phi + dual_x cos phi. The residual is linear in all else.
    """
    relative = between(pose_i, pose_j)
    lever = _rotate(measurement[..., 2], dual[..., :2])
    # Seen from keyframe j: the derivative of R(-phi) turns by a right angle.
    seen = _rotate(-(relative[..., 2] - measurement[..., 2]), dual[..., :2])
    H = np.zeros((*pose_i.shape[:-1], 6, 6))
    H[..., 2, 0], H[..., 2, 1] = lever[..., 1], -lever[..., 0]
    H[..., 2, 3], H[..., 2, 4] = -seen[..., 1], seen[..., 0]
    H[..., 0:5, 2] = H[..., 2, 0:5]
    H[..., 2, 2] = -(lever * relative[..., :2]).sum(axis=-1)
    return H


def local_jacobian(a: Array, b: Array) -> Array:
    """Return J_l_b of t2v(a^-1 b) = [[Ra' Rb, 0], [0, 1]], (n, 3, 3)."""
    J = np.zeros((*b.shape, 3))
    J[..., :2, :2] = _rotation_matrix(b[..., 2] - a[..., 2])
    J[..., 2, 2] = 1.0
    return J


def interpolate(a: Array, b: Array, fraction: Array) -> Array:
    """Return a v2t(fraction t2v(a^-1 b)), (n, 3)."""
    return retract(a, fraction[..., None] * local(a, b))


def motion(step: Array) -> tuple[Array, Array]:
    """Return the length [m] and the angle [rad] of each relative pose, (n,) and (n,)."""
    return np.hypot(step[..., 0], step[..., 1]), np.abs(step[..., 2])


def positions(pose: Array) -> Array:
    """Return x, y [m], (n, 2)."""
    return pose[..., :2]


def from_pose3(pose3: Array) -> Array:
    """Project x y z qx qy qz qw (n, 7) onto the plane: x, y and the yaw, (n, 3)."""
    qx, qy, qz, qw = np.moveaxis(pose3[..., 3:], -1, 0)
    yaw = np.arctan2(2 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)
    return np.concatenate((pose3[..., :2], yaw[..., None]), axis=-1)


def to_pose3(pose: Array) -> Array:
    """Return x y 0 0 0 sin(theta/2) cos(theta/2), (n, 7)."""
    pose3 = np.zeros((*pose.shape[:-1], 7))
    pose3[..., :2] = pose[..., :2]
    pose3[..., 5] = np.sin(pose[..., 2] / 2)
    pose3[..., 6] = np.cos(pose[..., 2] / 2)
    return pose3


def _rotation_matrix(theta: Array) -> Array:
    c, s = np.cos(theta), np.sin(theta)
    return np.stack((np.stack((c, -s), -1), np.stack((s, c), -1)), -2)
