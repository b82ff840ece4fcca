# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The poses of a robot between keyframes, by the scan-matched odometry of all scans."""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import poses_at
from l1slam_ros.core.geometry.manifold import Array, Indices


@dataclass(frozen=True)
class ScanPath:
    """
    The scan-matched odometry.

    stamps : (n,) of the scans [ns], rising; poses : (n, 3) in the frame of the odometry;
    keyframes : (n,) the last keyframe at each
    """

    stamps: Indices
    poses: Array
    keyframes: Indices

    def steps_at(self, at: Indices, longest: int, tolerance: int
                 ) -> tuple[Indices, Indices, Array]:
        """
        Return the poses of the robot at some times, relative to its keyframes.

        Parameters
        ----------
        at : (m,) times [ns]
        longest, tolerance : see `poses_at`

        Returns
        -------
        rows (k,) of `at` that scans surround, the last keyframe (k,) at each, and the pose there
        in the axes of that keyframe (k, 3)

        """
        if len(self.stamps) < 2:
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))
        rows, poses = poses_at(se2, self.stamps, self.poses, at, longest, tolerance)
        before = np.searchsorted(self.stamps, at[rows], side='right') - 1
        keyframes = self.keyframes[np.clip(before, 0, len(self.stamps) - 1)]
        first = np.unique(self.keyframes, return_index=True)[1]
        return rows, keyframes, se2.between(self.poses[first[keyframes]], poses)
