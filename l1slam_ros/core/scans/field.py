# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A map of points with normals, in which the nearest one is found by a look-up."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.scans import kernels

# [m] Cells of the look-up, and how far it reaches.
RESOLUTION, REACH = 0.1, 0.6
# The widest bound of a search is over 2^_HEIGHT cells.
_HEIGHT = 4


@dataclass(frozen=True)
class Field:
    """
    Points of a map.

    xy, normals : (n, 2) [m], each has a normal; nearest : (a, b) for each cell the nearest point,
    -1 where none is within reach; origin : (2,) the corner of cell (0, 0) [m]
    """

    xy: Array
    normals: Array
    nearest: Indices
    origin: Array

    @staticmethod
    def of(xy: Array, normals: Array) -> 'Field':
        """Return that of some points."""
        if not len(xy):
            return Field(xy, normals, np.full((1, 1), -1, np.int32), np.zeros(2))
        origin = np.floor(xy.min(axis=0) / RESOLUTION - REACH / RESOLUTION) * RESOLUTION
        shape = np.ceil((xy.max(axis=0) - origin + REACH) / RESOLUTION).astype(np.int64)
        xy = np.ascontiguousarray(xy)
        nearest = kernels.nearest_points(xy, origin, shape, RESOLUTION, REACH)
        return Field(xy, np.ascontiguousarray(normals), nearest, origin)

    @cached_property
    def likelihood(self) -> Array:
        """How well a point in each cell fits, (a, b): exp(-d^2 / (2 RESOLUTION^2))."""
        a, b = self.nearest.shape
        centre = [self.origin[k] + RESOLUTION * (np.arange(size) + 0.5)
                  for k, size in enumerate((a, b))]
        if not len(self.xy):
            return np.zeros((a, b), np.float32)
        x, y = self.xy[self.nearest, 0], self.xy[self.nearest, 1]
        square = (x - centre[0][:, None]) ** 2 + (y - centre[1]) ** 2
        fit = np.exp(-square / (2 * RESOLUTION**2))
        return np.where(self.nearest < 0, 0.0, fit).astype(np.float32)

    @cached_property
    def levels(self) -> tuple[Array, Array]:
        """
        The greatest likelihood over 1, 2, 4, ... cells from each cell on, (h + 1, a, b).

        And the (2,) cells of nothing before the first one: so far a shift may reach out.
        """
        width = 1 << _HEIGHT
        levels = [np.pad(self.likelihood, ((width, 0), (width, 0)))]
        for level in range(_HEIGHT):
            half, last = 1 << level, levels[-1].copy()
            last[:-half] = np.maximum(last[:-half], last[half:])
            last[:, :-half] = np.maximum(last[:, :-half], last[:, half:])
            levels.append(last)
        return np.stack(levels), np.full(2, width)
