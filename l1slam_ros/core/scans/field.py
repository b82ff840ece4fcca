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
from numpy.typing import NDArray

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array

Likelihoods = NDArray[np.uint8]
# [m] Cells of the look-up, and how far it reaches.
RESOLUTION, REACH = 0.1, 0.6
# The widest bounds of a search are over so many cells each way, and it has at most so many of them
# each way; as `native.branch_and_bound` has them.
WIDTH, ACROSS = 8, 32
_HEIGHT = WIDTH.bit_length() - 1
# A likelihood of 1.
CERTAIN = 255


@dataclass(frozen=True)
class Field:
    """
    Points of a map.

    xy, normals : (n, 2) [m], each has a normal; nearest : (a, b) for each cell the nearest point,
    -1 where none is within reach; square : (a, b) its squared distance from the middle of the cell
    [m^2]; origin : (2,) the corner of cell (0, 0) [m]
    """

    xy: Array
    normals: Array
    nearest: NDArray[np.int32]
    square: Array
    origin: Array

    @staticmethod
    def of(xy: Array, normals: Array) -> 'Field':
        """Return that of some points."""
        if not len(xy):
            return Field(xy, normals, np.full((1, 1), -1, np.int32),
                         np.full((1, 1), REACH**2), np.zeros(2))
        origin = np.floor(xy.min(axis=0) / RESOLUTION - REACH / RESOLUTION) * RESOLUTION
        shape = np.ceil((xy.max(axis=0) - origin + REACH) / RESOLUTION).astype(np.int64)
        xy = np.ascontiguousarray(xy)
        nearest, square = np.full(shape, -1, np.int32), np.full(shape, REACH**2)
        native.likelihood_field.nearest_points(xy, origin, RESOLUTION, REACH, nearest, square)
        return Field(xy, np.ascontiguousarray(normals), nearest, square, origin)

    @cached_property
    def likelihood(self) -> Likelihoods:
        """How well a point in each cell fits, (a, b): exp(-d^2 / (2 RESOLUTION^2)) of 255."""
        # Beyond reach this is less than half of one.
        fit = np.exp(self.square.astype(np.float32) * np.float32(-0.5 / RESOLUTION**2))
        return np.rint(CERTAIN * fit).astype(np.uint8)

    @cached_property
    def levels(self) -> Likelihoods:
        """
        The greatest likelihood over 1, 2, 4, ... cells from each cell on, (h + 1, a, b).

        Cell (0, 0) of the likelihood is at (WIDTH, WIDTH). All that is on the edge is 0.
        """
        columns, rows = self.nearest.shape
        levels = np.zeros((_HEIGHT + 1, columns + WIDTH + 1, rows + WIDTH + 1), np.uint8)
        levels[0, WIDTH:-1, WIDTH:-1] = self.likelihood
        for level, (finer, wider) in enumerate(zip(levels, levels[1:], strict=False)):
            half = 1 << level
            wider[:] = finer
            np.maximum(finer[:-half], finer[half:], out=wider[:-half])
            wider[:, :-half] = np.maximum(wider[:, :-half], wider[:, half:])
        return levels

    @cached_property
    def blocks(self) -> Likelihoods:
        """
        The last of the `levels`, so that cells which are `WIDTH` apart are neighbours.

        (w, w, c, r), w = `WIDTH`: element (p, q, c, r) is of cell (c w + p, (r - a) w + q). Before
        and behind the rows of the level's own blocks are a = `ACROSS` of nothing.
        """
        last = self.levels[-1]
        columns, rows = (-(-size // WIDTH) for size in last.shape)
        whole = np.zeros((columns * WIDTH, rows * WIDTH), np.uint8)
        whole[: last.shape[0], : last.shape[1]] = last
        blocks = np.zeros((WIDTH, WIDTH, columns, rows + 2 * ACROSS), np.uint8)
        own = whole.reshape(columns, WIDTH, rows, WIDTH)
        blocks[..., ACROSS:-ACROSS] = own.transpose(1, 3, 0, 2)
        return blocks
