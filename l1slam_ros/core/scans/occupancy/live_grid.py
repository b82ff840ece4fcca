# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
An occupancy grid that follows keyframes as the map moves them.

A keyframe that moved is taken out and put in again, so that only what moved is drawn anew. To take
out what was put in, nothing may be cut off or rounded: what a ray adds is in eighths, which a
float of 32 bits sums exactly up to two millions, and there is no bound.
"""

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans.occupancy.grid import Grid, rays_of
from l1slam_ros.core.scans.points import Points

# Log odds that one ray adds, in eighths.
_FREE, _OCCUPIED = 0.375, 0.875
# [m] The grid grows by so much at once.
_MARGIN = 10.0
# [m] A keyframe is drawn anew where it moves what is so far away by half a cell.
_SIGHT = 5.0


class LiveGrid:
    """
    A grid of the scans of keyframes.

    Parameters
    ----------
    resolution : of a cell [m]

    """

    def __init__(self, resolution: float):
        self._resolution = resolution
        self._log_odds = np.zeros((0, 0), np.float32)
        self._origin = np.zeros(2)
        # What is drawn: lowest and highest corner [m], and of each keyframe where.
        self._low = np.full(2, np.inf)
        self._high = np.full(2, -np.inf)
        self._drawn: dict[int, tuple[Points, Array]] = {}

    def __len__(self) -> int:
        """Return how many keyframes are drawn."""
        return len(self._drawn)

    def is_as_drawn(self, keyframe: int, pose: Array) -> bool:
        """Tell whether a keyframe is drawn at a pose (3,), but for half a cell."""
        if keyframe not in self._drawn:
            return False
        off = pose - self._drawn[keyframe][1]
        turn = abs((off[2] + np.pi) % (2 * np.pi) - np.pi)
        return bool(np.hypot(off[0], off[1]) + _SIGHT * turn <= self._resolution / 2)

    def draw(self, keyframe: int, points: Points, pose: Array) -> None:
        """Draw a keyframe, by its number, at a pose (3,); where it was drawn before, no more."""
        self.erase(keyframe)
        self._cast(points, pose, 1)
        self._drawn[keyframe] = points, pose.copy()

    def erase(self, keyframe: int) -> None:
        """Take a keyframe out, if it is drawn."""
        if keyframe in self._drawn:
            self._cast(*self._drawn.pop(keyframe), -1)

    def grid(self) -> Grid:
        """Return a copy of all that has ever been drawn on."""
        if not np.isfinite(self._low).all():
            return Grid(np.zeros((1, 1), np.float32), np.zeros(2), self._resolution)
        first = np.floor((self._low - self._origin) / self._resolution).astype(int)
        end = np.floor((self._high - self._origin) / self._resolution).astype(int) + 1
        part = self._log_odds[first[0] : end[0], first[1] : end[1]].astype(np.float32)
        return Grid(part, self._origin + first * self._resolution, self._resolution)

    def _cast(self, points: Points, pose: Array, sign: int) -> None:
        starts, ends, hits = rays_of(points, pose)
        if not len(ends):
            return
        low = np.minimum(ends.min(axis=0), starts[0])
        high = np.maximum(ends.max(axis=0), starts[0])
        self._reach(low, high)
        native.ray_casting.cast_rays(
            self._log_odds, self._origin, self._resolution, starts, ends, hits, sign * _FREE,
            sign * _OCCUPIED, np.inf)

    def _reach(self, low: Array, high: Array) -> None:
        """Let the grid reach from one corner to another [m]."""
        self._low, self._high = np.minimum(self._low, low), np.maximum(self._high, high)
        end = self._origin + np.array(self._log_odds.shape) * self._resolution
        if self._log_odds.size and (low >= self._origin).all() and (high < end).all():
            return
        # Whole cells from the origin before, so that what is drawn stays in its cells.
        first = np.floor((self._low - _MARGIN - self._origin) / self._resolution).astype(int)
        last = np.ceil((self._high + _MARGIN - self._origin) / self._resolution).astype(int)
        before = self._log_odds
        at = -first
        self._log_odds = np.zeros(tuple(last - first), np.float32)
        if before.size:
            self._log_odds[at[0] : at[0] + before.shape[0],
                           at[1] : at[1] + before.shape[1]] = before
        self._origin = self._origin + first * self._resolution
