# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What a recording has of one laser, whatever it was recorded with."""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.scans.points import Mount, Scan


@dataclass(frozen=True)
class LaserLog:
    """
    Scans, and the wheels.

    scans : in the order of time; wheels : (n, 3) the robot's pose by the wheels at each; mount :
    where the laser is on the robot; skipped : what was left out, in sentences; damage : a sentence
    where only a part could be read, else empty
    """

    scans: list[Scan]
    wheels: Array
    mount: Mount
    skipped: tuple[str, ...] = ()
    damage: str = ''


def wheels_at(stamps: Indices, poses: Array, wanted: Indices) -> tuple[Array, Indices]:
    """
    Return where the wheels had the robot at some stamps, and which of these they surround.

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
