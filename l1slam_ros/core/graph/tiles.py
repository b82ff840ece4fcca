# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How the factors of a linear system lie in memory for the compiled loop of `restarted_pdhg`.

In: values per factor, (m, c), in the order of the system. Out: tiles (t, c, lanes) of single
precision, factors side by side, sorted by keyframe, so that what one factor fetches of x the next
finds in the cache; the last tile is filled up with zeros.
"""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.geometry.manifold import Array, Indices

Single = NDArray[np.float32]
# Factors in a tile: one cache line of single precision, as `native.halpern` has it.
LANES = 16


class Tiles:
    """
    The order of the factors in tiles.

    keyframe : (t, 2, lanes) of each factor, in the order of the tiles

    Parameters
    ----------
    keyframe : (m, 2) as of `LinearSystem`
    size : free keyframes

    """

    def __init__(self, keyframe: Indices, size: int):
        self._order = np.argsort(keyframe[:, 0] * (size + 1) + keyframe[:, 1], kind='stable')
        self._place = np.empty_like(self._order)
        self._place[self._order] = np.arange(len(keyframe))
        self.keyframe = self._side_by_side(keyframe, np.int32, size)

    def pack(self, values: Array) -> Single:
        """Return the values of all factors, (m, c), as tiles (t, c, lanes)."""
        return self._side_by_side(values, np.float32, 0)

    def unpack(self, tiles: Single) -> Array:
        """Return the values of all factors, (m, c), from tiles (t, c, lanes)."""
        rows = tiles.transpose(0, 2, 1).reshape(-1, tiles.shape[1])
        return rows.take(self._place, axis=0).astype(float)

    def _side_by_side(self, values: np.ndarray, dtype: type, rest: int) -> np.ndarray:
        """Return values (m, c) as tiles (t, c, lanes), the last one filled up with `rest`."""
        m, columns = values.shape
        count = -(-len(values) // LANES)
        padded: np.ndarray = np.full((count * LANES, columns), rest, dtype)
        padded[:m] = values.take(self._order, axis=0)
        tiles = padded.reshape(count, LANES, columns).transpose(0, 2, 1)
        return np.ascontiguousarray(tiles)
