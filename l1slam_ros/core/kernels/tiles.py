# SPDX-License-Identifier: Apache-2.0
"""Values of factors into tiles, factors side by side, and back; see `core.tiles`."""

from l1slam_ros.core.kernels.compiled import loop


@loop('(f8[:, ::1], i8[::1], f4[:, :, ::1])')
def pack(values, order, tiles):
    """Write values (m, c), taken in `order` (m,), to tiles (t, c, lanes)."""
    lanes = tiles.shape[2]
    for place in range(len(order)):
        for c in range(values.shape[1]):
            tiles[place // lanes, c, place % lanes] = values[order[place], c]


@loop('(f4[:, :, ::1], i8[::1], f8[:, ::1])')
def unpack(tiles, order, values):
    """Undo `pack`: write the tiles to values (m, c)."""
    lanes = tiles.shape[2]
    for place in range(len(order)):
        for c in range(values.shape[1]):
            values[order[place], c] = tiles[place // lanes, c, place % lanes]
