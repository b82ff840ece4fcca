# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Times when no odometry came, and how little is known of where the robot was meanwhile."""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.growable_array import GrowingArray

# Of the farthest that the robot may have been off, as a standard deviation.
_SIGMA = 0.5


class Silences:
    """
    Silences in order of time.

    Where both ends are of one part, the robot may have been off the way between them by `reach`,
    most in the middle: as an ellipse about both ends has it. Where it ends with another part, it
    was the farther off the longer ago its beginning is.
    """

    def __init__(self) -> None:
        self._times = GrowingArray((2,), np.int64)
        # Metres, radians, and whether both ends are of one part.
        self._reach = GrowingArray((3,))

    def add(self, begin: int, end: int, reach: tuple[float, float], is_closed: bool) -> None:
        """Add one after all others, times [ns]; reach : [m], [rad]."""
        self._times.extend(np.array([[begin, end]]))
        self._reach.extend(np.array([[*reach, is_closed]]))

    def split(self, time: int) -> None:
        """Let a sample have come at a time [ns] that may be in the last one, if there is one."""
        if not len(self._times):
            return
        (begin, end), (*reach, closed) = (
            values.view()[-1].tolist() for values in (self._times, self._reach))
        if closed and begin < time < end:
            self._times.replace(len(self._times) - 1, np.array([[begin, time], [time, end]]))
            parts = np.array([[time - begin], [end - time]]) / (end - begin)
            self._reach.replace(len(self._reach) - 1, np.hstack((parts * reach, np.ones((2, 1)))))

    def sigmas(self, times: Indices) -> Array:
        """Return the standard deviations [m] and [rad] of where the robot was, (m, 2)."""
        found = np.zeros((len(times), 2))
        if not len(self._times):
            return found
        intervals, reach = self._times.view(), self._reach.view()
        row = np.maximum(np.searchsorted(intervals[:, 0], times, side='right') - 1, 0)
        begin, end = intervals[row].T
        inside = (begin < times) & (times < end)
        part = np.where(inside, (times - begin) / (end - begin), 0.0)
        grown = np.where(reach[row, 2] > 0, 2 * np.sqrt(part * (1 - part)), part)
        return _SIGMA * np.minimum(grown[:, None] * reach[row, :2], (np.inf, np.pi))
