# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The covariance of `scan_odom`: the motion of the robot from scan to scan.

The front end knows how certain the motion from the last keyframe to each scan is, and the errors
of scans that are matched with one map do not add up. A message states what `covariance_source:
increment` sums: the part of that covariance which goes with the way since the message before, as a
part of the way to the next keyframe. So the sum over a keyframe's messages is the covariance of
the front end, and of a stretch that is shorter it is a fair part.

Where the front end begins a new part, nothing is known of the motion to it, and no covariance that
the back end believes says so. The frame of `scan_odom` is then moved farther than anything can
have gone: the back end begins a part, too, which loops may join.
"""

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.measurements import FASTEST
from l1slam_ros.core.scans.odometry import ScanKeyframes, Step

# [m^2, rad^2] Least variance of a message, for a robot that stands.
_LEAST = 1e-8 * np.eye(3)
# [m] Least shift of a new part; and the shift as a multiple of what anything can move.
_APART, _FARTHER = 1000.0, 2.0


class IncrementalOdometry:
    """
    Converts the steps of the front end to poses and covariances of `scan_odom`.

    Parameters
    ----------
    options : when a scan becomes a keyframe

    """

    def __init__(self, options: ScanKeyframes):
        self._options = options
        # The pose and the stamp [ns] of the last one.
        self._keyframe: tuple[Array, int] | None = None
        # Since the last keyframe: the sum of what was stated, at the last pose.
        self._stated = np.zeros((3, 3))
        self._last: tuple[int, Array] = 0, np.zeros(3)
        self._shift = np.zeros(3)

    def tell(self, stamp: int, step: Step, begins: bool) -> tuple[Array, Array]:
        """
        Return a pose (3,) and the covariance (3, 3) of the motion since the one before.

        stamp : of the scan [ns]; begins : a part of the run begins with this step
        """
        if begins or self._keyframe is None:
            return self._begin(stamp, step)
        pose, since = self._keyframe
        way, turn = (float(value[0]) for value in se2.motion(
            se2.local(pose[None], step.pose[None])))
        done = 1.0 if step.keyframe is not None else min(
            self._options.done(way, turn, (stamp - since) * 1e-9), 1.0)
        moved = se2.between(step.pose[None], self._last[1][None])
        Ad = se2.adjoint(moved)[0]
        before = Ad @ self._stated @ Ad.T
        increment = _positive(done * step.covariance - before) + _LEAST
        self._stated = before + increment
        self._last = stamp, step.pose
        if step.keyframe is not None:
            self._keyframe = step.pose, stamp
            self._stated = np.zeros((3, 3))
        return self._shifted(step.pose), increment

    def _begin(self, stamp: int, step: Step) -> tuple[Array, Array]:
        if self._keyframe is not None:
            seconds = abs(stamp - self._last[0]) * 1e-9
            self._shift = self._shift + (max(_APART, _FARTHER * FASTEST * seconds), 0.0, 0.0)
        self._keyframe = step.pose, stamp
        self._stated = np.zeros((3, 3))
        self._last = stamp, step.pose
        return self._shifted(step.pose), step.covariance

    def _shifted(self, pose: Array) -> Array:
        return pose + self._shift


def _positive(matrix: Array) -> Array:
    """Return the positive semidefinite part of a symmetric matrix."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    found: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return found
