# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The scans of one laser in a recording of any format, with wheel odometry."""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.scans.points import Mount, Scan


@dataclass(frozen=True)
class LaserLog:
    """
    Scans with wheel odometry.

    scans : in order of time; wheels : (n, 3) the robot's pose by wheel odometry at each; mount :
    the pose of the laser on the robot; skipped : sentences on what was left out; damage : a
    sentence if only a part could be read, else empty
    """

    scans: list[Scan]
    wheels: Array
    mount: Mount
    skipped: tuple[str, ...] = ()
    damage: str = ''


def wheels_at(stamps: Indices, poses: Array, wanted: Indices) -> tuple[Array, Indices]:
    """
    Interpolate wheel odometry at some stamps; return the poses, and the stamps within it.

    Parameters
    ----------
    stamps, poses : of the odometry, (n,) [ns], rising, and (n, 3)
    wanted : (m,) [ns]

    Returns
    -------
    poses (k, 3) and the rows (k,) of `wanted`

    """
    rows = np.flatnonzero((wanted >= stamps[0]) & (wanted <= stamps[-1]))
    after = np.clip(np.searchsorted(stamps, wanted[rows]), 1, len(stamps) - 1)
    length = (stamps[after] - stamps[after - 1]).astype(float)
    fraction = (wanted[rows] - stamps[after - 1]) / length
    return se2.interpolate(poses[after - 1], poses[after], fraction), rows
