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


class Tiles:
    """
    The order of the factors in tiles.

    keyframe : (m, 2) as of `LinearSystem`; size : free keyframes; lanes : factors in a tile
    """

    def __init__(self, keyframe: Indices, size: int, lanes: int):
        self._lanes, self._count = lanes, -(-len(keyframe) // lanes)
        self._order = np.argsort(keyframe[:, 0] * (size + 1) + keyframe[:, 1], kind='stable')
        padded = np.full((self._count * lanes, 2), size, np.uint32)
        padded[: len(keyframe)] = keyframe[self._order]
        side_by_side = padded.reshape(self._count, lanes, 2).transpose(0, 2, 1)
        self.keyframes = np.ascontiguousarray(side_by_side).reshape(self._count, 2 * lanes)

    def pack(self, values: Array) -> Single:
        """Return the values of all factors, (m, c), as tiles (t, c, lanes)."""
        from l1slam_ros.core.kernels import halpern

        tiles = np.zeros((self._count, values.shape[1], self._lanes), np.float32)
        halpern.pack(values, self._order, tiles)
        return tiles

    def unpack(self, tiles: Single) -> Array:
        """Return the values of all factors, (m, c), from tiles (t, c, lanes)."""
        from l1slam_ros.core.kernels import halpern

        values = np.empty((len(self._order), tiles.shape[1]))
        halpern.unpack(tiles, self._order, values)
        return values
