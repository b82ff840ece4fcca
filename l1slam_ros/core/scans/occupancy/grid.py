# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
An occupancy grid of scans and the poses of their keyframes.

Each ray tells the cells it passes that they are free, and the cell where it ends that it is not,
in log odds (Moravec and Elfes, "High resolution maps from wide angle sonar", 1985). A cell that no
ray has met is unknown. The grid grows as the map does, and a keyframe that moved is taken out and
put in again, so that only what moved is drawn anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.scans.points import Points, transformed

# Log odds that one ray adds, and the most that all do.
_FREE = 0.4
_OCCUPIED = 0.85
_MOST = 100.0
# Cells above, and below, are occupied and free: probabilities .65 and .25, as nav2's map saver
# has them.
OCCUPIED, FREE = np.log(0.65 / 0.35), np.log(0.25 / 0.75)
# [m] Rays into the open are free so far.
_OPEN = 8.0
# [m] Rays between points are free up to so much before the surface.
_SHORT = 0.1


@dataclass(frozen=True)
class Grid:
    """
    Occupancy.

    log_odds : (a, b), column of x and row of y, 0 where nothing is known; origin : (2,) the corner
    of cell (0, 0) [m]; resolution : [m]
    """

    log_odds: NDArray[np.float32]
    origin: Array
    resolution: float

    @property
    def occupancy(self) -> NDArray[np.int8]:
        """100 occupied, 0 free, -1 unknown, (a, b) int8, as nav_msgs/OccupancyGrid has it."""
        known = np.full(self.log_odds.shape, -1, np.int8)  # a large map has no room for wider ones
        known[self.log_odds > OCCUPIED] = 100
        known[self.log_odds < FREE] = 0
        return known


def draw(points: Sequence[Points], poses: Array, resolution: float = 0.05) -> Grid:
    """
    Return the grid of scans seen from poses.

    points : of the scans; poses : (n, 3) of the robot in the map; resolution : [m]
    """
    rays = [rays_of(seen, pose) for seen, pose in zip(points, poses, strict=True)]
    ends = np.concatenate([end for _, end, _ in rays]) if rays else np.zeros((1, 2))
    starts = np.concatenate([start for start, _, _ in rays]) if rays else np.zeros((1, 2))
    low = np.floor(np.minimum(ends.min(axis=0), starts.min(axis=0)) / resolution - 1) * resolution
    high = np.maximum(ends.max(axis=0), starts.max(axis=0))
    shape = np.ceil((high - low) / resolution).astype(int) + 1
    log_odds = np.zeros((int(shape[0]), int(shape[1])), np.float32)
    for start, end, hit in rays:
        native.ray_casting.cast_rays(
            log_odds, low, resolution, start, end, hit, _FREE, _OCCUPIED, _MOST)
    return Grid(log_odds, low, resolution)


def rays_of(seen: Points, pose: Array) -> tuple[Array, Array, Mask]:
    """Return where the rays of a view begin and end (r, 2) [m], and whether there is a surface."""
    bins = len(seen.view)
    angles = (np.arange(bins) + 0.5) * (2 * np.pi / bins)
    looked = ~np.isnan(seen.view)
    # A bearing is as wide as it is: at its edge the surface may be nearer.
    reach = np.maximum(seen.view[looked] - _SHORT, 0.0)
    reach[np.isposinf(seen.view[looked])] = _OPEN
    free = seen.centre + reach[:, None] * np.stack(
        (np.cos(angles[looked]), np.sin(angles[looked])), axis=1)
    ends = np.ascontiguousarray(transformed(pose, np.concatenate((free, seen.xy))))
    start = transformed(pose, seen.centre[None])
    hit = np.arange(len(ends)) >= len(free)
    return np.ascontiguousarray(np.repeat(start, len(ends), axis=0)), ends, hit
