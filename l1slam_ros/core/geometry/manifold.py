# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The conventions of the whole package, and the verbs that every pose manifold offers.

Pose
    `T_map_k`: takes points of the body frame of keyframe k to the map frame [m, rad].
    Stored as rows of an (n, p) array; p = `POSE_SIZE`.
Step
    Tangent vector, translation first, rotation after; rows of an (n, d) array, d =
    `TANGENT_SIZE`. **Steps apply on the right**, in the axes of the body: X (+) s = X v2t(s).
Residual
    `e = t2v(Z^-1 Xi^-1 Xj)`: the error of the relative pose, in the axes of the measured pose. Xi
    may be the world: the identity, which never moves.
    t2v reads the coordinates off (as g2o does); it is not the logarithm. Of small errors it is
    the step that makes them, in SE(2) of all.
Jacobian
    `J_r_i`: derivative of the residual r with respect to the step of pose i, at step zero.
Stamp
    Integer nanoseconds.

A manifold is a module of plain functions on stacked arrays: `se2`, `se3`. Nothing outside it
assumes a dimension: sizes, and which part of a step is rotation, are asked of it.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
# Of no more rows than that, as they come one by one, a call of NumPy costs more than its sums.
FEW = 8


def are_few(a: Array, b: Array | None = None) -> bool:
    """Return whether each is a matrix of a few rows, for which a native call is quicker."""
    b = a if b is None else b
    return a.ndim == b.ndim == 2 and len(a) <= FEW >= len(b)


class Manifold(Protocol):
    """The verbs of a pose manifold; every array is stacked along its first axis."""

    NAME: str
    POSE_SIZE: int
    TANGENT_SIZE: int
    TRANSLATION: slice
    ROTATION: slice
    COVARIANCE_ROWS: tuple[int, ...]

    def identity(self, n: int) -> Array:
        """Return n identity poses, (n, p)."""

    def compose(self, a: Array, b: Array) -> Array:
        """Return a b, (n, p)."""

    def inverse(self, a: Array) -> Array:
        """Return a^-1, (n, p)."""

    def between(self, a: Array, b: Array) -> Array:
        """Return a^-1 b, the pose of b seen from a, (n, p)."""

    def retract(self, pose: Array, step: Array) -> Array:
        """Return pose v2t(step), (n, p)."""

    def local(self, a: Array, b: Array) -> Array:
        """Return the step that retracts a to b, (n, d)."""

    def adjoint(self, pose: Array) -> Array:
        """Return Ad, (n, d, d): pose v2t(s) = v2t(Ad s) pose to first order in s."""

    def residual(self, measurement: Array, pose_i: Array, pose_j: Array) -> Array:
        """Return t2v(Z^-1 Xi^-1 Xj), (n, d)."""

    def residual_jacobians(self, measurement: Array, pose_i: Array, pose_j: Array) -> Array:
        """Return J_r_i and J_r_j of `residual`, (n, 2, d, d)."""

    def residual_curvature(
        self, measurement: Array, pose_i: Array, pose_j: Array, dual: Array
    ) -> Array:
        """
        Return the Hessian of dual'e over (step of i, step of j), where it is not zero.

        Its rows of the r turns of i, then of j, (n, 2, r, 2 d), which are its columns, too: apart
        from turns, a residual is linear in steps. dual (n, d)
        """

    def local_jacobian(self, a: Array, b: Array) -> Array:
        """Return J_l_b of `local`, (n, d, d)."""

    def interpolate(self, a: Array, b: Array, fraction: Array) -> Array:
        """Return the poses at `fraction` (n,) of the way from a to b, (n, p)."""

    def motion(self, step: Array) -> tuple[Array, Array]:
        """Return the length [m] and the angle [rad] of each relative pose given as a step."""

    def positions(self, pose: Array) -> Array:
        """Return the coordinates of the body's origin in the map [m], (n, 2 or 3)."""

    def rotation(self, pose: Array) -> Array:
        """Return the rotation matrices of poses, (n, k, k), k = 2 or 3."""

    def from_rotation(self, R: Array, t: Array) -> Array:
        """Return poses from rotation matrices (n, k, k) and positions (n, k), k = 2 or 3."""

    def from_pose3(self, pose3: Array) -> Array:
        """Return poses from rows x y z qx qy qz qw (ROS order), (n, 7) -> (n, p)."""

    def to_pose3(self, pose: Array) -> Array:
        """Return rows x y z qx qy qz qw (ROS order), (n, p) -> (n, 7)."""
