# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The layout of a JRL file: the names of its parts, and the order of their numbers.

JSON, or the same as CBOR; the format of COSMO-Bench, as the library `jrl` reads and writes it:

    name                        of the data set
    robots                      their characters, as numbers: 97 is a
    measurements                robot -> entries {stamp, measurements}
    groundtruth, initialization robot -> values, each with its key, a symbol of GTSAM
    potential_outlier_factors, outlier_factors   robot -> [entry, measurement] of each factor

    {type: BetweenFactorPose2, key1, key2, measurement, covariance}     and BetweenFactorPose3
    {type: PriorFactorPose2, key, prior, covariance}                    and PriorFactorPose3
    {type: Pose2, x, y, theta}      {type: Pose3, translation: x y z, rotation: w x y z}

**A covariance in space has the rotation first**, as GTSAM has it; both are in the axes of the
measured pose. Stamps are nanoseconds, or they count.

Files of this program have one more member, `OURS`, which the library ignores:

    left_out    robot -> [entry, measurement, word], why a map was made without them, see
                `graphs.left_out`; all of them are in `outlier_factors`, too
    false       robot -> [entry, measurement], what `outlier_factors` said in the file read
    measured    robot -> [entry, measurement, pose] of odometry as it was measured, where the map
                is made of corrected one
    mark        see `ours`
"""

from types import MappingProxyType

import numpy as np

from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.measurements import QUATERNION_NORM_ERROR
from l1slam_ros.io.jrl.document import CBOR_SUFFIX, Node

JRL_SUFFIXES = '.jrl', CBOR_SUFFIX
OURS, MARK_NAME = 'l1slam_ros', 'mark'
# Kind of a factor -> its manifold, and whether the world is its other end.
FACTORS = MappingProxyType({
    'BetweenFactorPose2': (se2, False), 'PriorFactorPose2': (se2, True),
    'BetweenFactorPose3': (se3, False), 'PriorFactorPose3': (se3, True)})
POSES = MappingProxyType({'Pose2': se2, 'Pose3': se3})
# [m^2], [rad^2] A variance of this size or more means that the component is not measured; the
# format has no other way to say that.
SILENT = 1e12


def kind_of(manifold: Manifold, absolute: bool) -> str:
    """Return the type of a factor in the file."""
    return next(name for name, kind in FACTORS.items() if kind == (manifold, absolute))


def row_of(pose: Node, manifold: Manifold) -> list[float]:
    """Return a pose as x y theta, or as x y z and quaternion x y z w."""
    if manifold is se2:
        return [pose[name].number() for name in ('x', 'y', 'theta')]
    rotation = pose['rotation']
    w, *vector = rotation.numbers(4)
    if abs(float(np.linalg.norm([w, *vector])) - 1.0) > QUATERNION_NORM_ERROR:
        rotation.refuse('a quaternion w x y z of norm 1')
    return [*pose['translation'].numbers(3), *vector, w]


def poses_of(rows: list[list[float]], manifold: Manifold) -> Array:
    """Return poses (n, p) of such rows."""
    poses = np.array(rows, float).reshape(len(rows), manifold.POSE_SIZE)
    return manifold.from_pose3(poses) if manifold is se3 else poses


def values_of(poses: Array, manifold: Manifold) -> list[dict[str, object]]:
    """Return poses (n, p) as the format has them."""
    if manifold is se2:
        return [{'type': 'Pose2', 'x': x, 'y': y, 'theta': theta}
                for x, y, theta in poses.tolist()]
    return [{'type': 'Pose3', 'translation': [x, y, z], 'rotation': [w, *vector]}
            for x, y, z, *vector, w in manifold.to_pose3(poses).tolist()]


def swapped(covariance: Array, manifold: Manifold) -> Array:
    """Return covariances (m, d, d) in GTSAM's order from ours, or ours from GTSAM's."""
    order: Indices = np.arange(manifold.TANGENT_SIZE)
    if manifold is se3:
        order = np.concatenate((order[3:], order[:3]))
    return covariance[:, order[:, None], order]
