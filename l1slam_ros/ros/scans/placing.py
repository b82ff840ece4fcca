# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The poses of the scans' keyframes in the optimised map, and their uncertainty.

In: the back end's `path` and `pose_with_covariance`, and the scan-matched odometry. The back end's
keyframes need not be those of the scans: odometry leads on from the nearest one before.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.scans.submaps import Keyframe

# [m] A standard deviation beyond this means that the pose is unknown.
_UNKNOWN = 100.0


class Placing:
    """
    Places keyframes in the map.

    Attributes
    ----------
    frame : of the map, as `path` says

    """

    def __init__(self) -> None:
        self.frame = ''
        self._stamps = GrowingArray((), np.int64)
        self._odometry = GrowingArray((3,))
        self._path: tuple[Indices, Array] = np.zeros(0, np.int64), np.zeros((0, 3))
        # Of the newest keyframe of each update: stamp, metres, radians from the first keyframe.
        self._known: list[tuple[int, float, float]] = []

    def add_odometry(self, stamp: int, pose: Array) -> None:
        """Add a pose (3,) of the scan-matched odometry; stamps [ns] ascend."""
        self._stamps.extend(np.array([stamp]))
        self._odometry.extend(pose[None])

    def set_path(self, frame: str, stamps: Indices, poses: Array) -> None:
        """Set the path: its frame, stamps (n,) [ns], poses (n, 3)."""
        self.frame = frame
        # If stamps go back, the part before is of another time.
        back = np.flatnonzero(np.diff(stamps) <= 0)
        first = int(back[-1]) + 1 if len(back) else 0
        self._path = stamps[first:], poses[first:]

    def add_known(self, stamp: int, covariance: Array) -> None:
        """Add the covariance (3, 3) of a pose relative to the first one, at its stamp [ns]."""
        metres = float(np.sqrt(max(covariance[0, 0] + covariance[1, 1], 0.0)))
        radians = float(np.sqrt(max(covariance[2, 2], 0.0)))
        row = bisect_left(self._known, (stamp,))
        replaced = row < len(self._known) and self._known[row][0] == stamp
        self._known[row : row + replaced] = [(stamp, metres, radians)]

    def place(self, keyframes: Sequence[Keyframe]) -> Array:
        """Return the poses of keyframes in the map, (n, 3), as far as the path reaches."""
        stamps, poses = self._path
        if not len(stamps) or not len(self._stamps):
            return np.zeros((0, 3))
        wanted = np.array([keyframe.stamp for keyframe in keyframes], np.int64)
        wanted = wanted[: int(np.searchsorted(wanted, stamps[-1], side='right'))]
        before = np.maximum(np.searchsorted(stamps, wanted, side='right') - 1, 0)
        here = np.array([keyframe.pose for keyframe in keyframes[: len(wanted)]]).reshape(-1, 3)
        return se2.compose(poses[before], se2.between(self._at(stamps[before]), here))

    def spread(self, keyframes: Sequence[Keyframe]) -> Array:
        """
        Return the standard deviation of each keyframe relative to the last, (n, 2) [m], [rad].

        Each is known from the first one as well as when it was the newest, or better since, and so
        is the last; both errors are taken to have nothing in common, where in truth they share
        the way. Infinite where nothing has been heard.
        """
        wanted = np.array([keyframe.stamp for keyframe in keyframes], np.int64)
        if not self._known or not len(wanted):
            return np.full((len(wanted), 2), np.inf)
        stamps, metres, radians = np.array(self._known).T
        known = np.column_stack((np.interp(wanted, stamps, metres),
                                 np.interp(wanted, stamps, radians)))
        known[known[:, 0] > _UNKNOWN] = np.inf
        return np.hypot(known, known[-1])

    def joined(self, keyframes: Sequence[Keyframe]) -> set[int]:
        """
        Return the parts of the drive whose pose in the map is known: the first and those joined.

        The back end publishes covariances of unjoined parts, too; they are huge.
        """
        found = {keyframes[0].part} if keyframes else set()
        stamps = [keyframe.stamp for keyframe in keyframes]
        for stamp, metres, _ in self._known:
            if metres < _UNKNOWN and (row := bisect_right(stamps, stamp)):
                found.add(keyframes[row - 1].part)
        return found

    def _at(self, times: Indices) -> Array:
        """Interpolate the scan-matched odometry at some times [ns], (m, 3)."""
        stamps, poses = self._stamps.view(), self._odometry.view()
        if len(stamps) == 1:
            return np.repeat(poses, len(times), axis=0)
        after = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
        fraction = (times - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        return se2.interpolate(poses[after - 1], poses[after], np.clip(fraction, 0.0, 1.0))
