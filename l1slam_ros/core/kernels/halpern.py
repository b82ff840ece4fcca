# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
One pass over the factors per iteration of `halpern`: gather, update the dual, scatter.

Factors come in tiles of `LANES`, each number of a factor one row of a tile, so that one
instruction works on as many factors as fit a register. Rows of a tile, k the block size:

    2 k k   the blocks, row after row, that of the first keyframe before the second's
    k       b
    k       y
    k       y0, the dual where the iteration was last restarted

A tile is a flat array and `LANES` a constant: only so does the compiler know that rows do not
overlap. K is a tuple of k zeros; its length is a constant to the compiler, an argument k is not.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, for_sizes, loop

# One cache line of single precision. Below 16 the loop vectoriser takes a loop for a short one,
# where it does not check that arrays are apart, and gives up.
LANES = 16
# Part of a keyframe's scale by which a direction that no factor measures is held.
_UNMEASURED = 1e-12
# Blocks of angles, positions and poses in the plane.
_SIZES = tuple(f'UniTuple(i8, {k})' for k in (1, 2, 3))


@loop('(i8[:, ::1], f8[:, :, :, ::1], i8)')
def scale(keyframe, blocks, size):
    """
    Return the blocks in scaled unknowns (m, 2, k, k), and R_v^-1 of each keyframe.

    (size + 1, k, k), the last one zero: what is held fixed has no unknowns.
    """
    k = blocks.shape[3]
    inverse, scaled = np.zeros((size + 1, k, k)), np.empty_like(blocks)
    for f in range(len(keyframe)):
        for side in range(2):
            block, total = blocks[f, side], inverse[keyframe[f, side]]
            for a in range(k):
                for b in range(k):
                    for r in range(k):
                        total[a, b] += 2 * block[r, a] * block[r, b]
    for v in range(size):
        _invert_root(inverse[v])
    for a in range(k):
        for b in range(k):
            inverse[size, a, b] = 0.0
    for f in range(len(keyframe)):
        for side in range(2):
            block, factor = blocks[f, side], inverse[keyframe[f, side]]
            for r in range(k):
                for c in range(k):
                    total = 0.0
                    for a in range(k):
                        total += block[r, a] * factor[a, c]
                    scaled[f, side, r, c] = total
    return scaled, inverse


@compiled
def _invert_root(gram):
    """Turn R'R into R^-1, R upper triangular, a little more than R'R where nothing is measured."""
    k, trace = len(gram), 0.0
    for a in range(k):
        trace += gram[a, a]
    for a in range(k):
        gram[a, a] += _UNMEASURED * trace if trace > 0 else 1.0
    # The lower triangle becomes R'.
    for a in range(k):
        for b in range(a + 1):
            total = gram[a, b]
            for c in range(b):
                total -= gram[a, c] * gram[b, c]
            gram[a, b] = np.sqrt(total) if a == b else total / gram[b, b]
    # Column by column of R'^-1, which is written to the rows of the upper one.
    for b in range(k):
        gram[b, b] = 1 / gram[b, b]
        for a in range(b + 1, k):
            total = 0.0
            for c in range(b, a):
                total -= gram[a, c] * gram[b, c]
            gram[b, a] = total / gram[a, a]
    for a in range(k):
        for b in range(a):
            gram[a, b] = 0.0


@for_sizes('f4[:, ::1], u4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f8, i8, i8', plane=_SIZES)
def iterate(tiles, keyframes, x, z, g, weight, first, count, K):
    """
    Advance x, the y of the tiles and g = A'y by `count` iterations of `halpern.halpern_step`.

    tiles : (tiles, rows LANES); keyframes : (tiles, 2 LANES) uint32; x, z, g : (size + 1, k), the
    last row of no keyframe, z scratch; first : iterations since the restart.
    """
    k, number = len(K), tiles.dtype.type
    dual = 2 * k * k + k
    local = np.empty(3 * k * LANES, tiles.dtype)
    for iteration in range(first, first + count):
        # Numbers of the tiles' own precision: one double makes all of its loop double.
        a, rest = number((iteration + 1) / (iteration + 2)), number(1 / (iteration + 2))
        w = number(weight)
        twice = number(2 / weight)
        one = number(1)
        _reflect(x.ravel(), z.ravel(), g.ravel(), twice, a)
        for t in range(len(tiles)):
            tile = tiles[t]
            _gather(local, 0, z, keyframes[t], K)
            for r in range(k):
                for lane in range(LANES):
                    residual = -tile[(2 * k * k + r) * LANES + lane]
                    for c in range(k):
                        residual += (
                            tile[(r * k + c) * LANES + lane] * local[c * LANES + lane]
                            + tile[((k + r) * k + c) * LANES + lane]
                            * local[(k + c) * LANES + lane])
                    y = tile[(dual + r) * LANES + lane]
                    y_bar = min(max(y + w * residual, -one), one)
                    y = a * (y_bar + y_bar - y) + rest * tile[(dual + k + r) * LANES + lane]
                    tile[(dual + r) * LANES + lane] = y
                    local[(2 * k + r) * LANES + lane] = y
            _scatter(local, tile, g, keyframes[t], K)


@for_sizes('f4[:, ::1], u4[:, ::1], f4[:, ::1], f4[:, ::1], f8, f4[:, ::1], '
           'f4[:, ::1], f4[:, ::1]', plane=_SIZES)
def look(tiles, keyframes, x, g, weight, x_bar, g_bar, y_bar, K):
    """
    Find the next point without the pull to the restart, and what the tests want to know.

    Written: x_bar and g_bar = A'y_bar (size + 1, k), y_bar (tiles, k LANES).

    Returns
    -------
    residual : the squared fixed-point residual, see `halpern`
    cost, dual : |A x_bar - b|_1 and -b'y_bar

    """
    k, number = len(K), tiles.dtype.type
    dual = 2 * k * k + k
    local = np.empty(5 * k * LANES, tiles.dtype)
    d = np.empty_like(g)
    w, one = number(weight), number(1)
    rest = number(1 / weight)
    moved = turned = crossed = cost = value = 0.0
    for v in range(len(x)):
        for c in range(k):
            d[v, c] = rest * g[v, c]
            x_bar[v, c] = x[v, c] - d[v, c]
            moved += d[v, c] * d[v, c]
            g_bar[v, c] = 0
    for t in range(len(tiles)):
        tile = tiles[t]
        _gather(local, 0, x_bar, keyframes[t], K)
        _gather(local, 2 * k, d, keyframes[t], K)
        for r in range(k):
            for lane in range(LANES):
                b = tile[(2 * k * k + r) * LANES + lane]
                residual, Ad = -b, b - b
                for c in range(k):
                    i, j = c * LANES + lane, (k + c) * LANES + lane
                    A_i, A_j = tile[r * k * LANES + i], tile[(k + r - 1) * k * LANES + j]
                    residual += A_i * local[i] + A_j * local[j]
                    Ad += A_i * local[2 * k * LANES + i] + A_j * local[2 * k * LANES + j]
                y = tile[(dual + r) * LANES + lane]
                new = min(max(y + w * (residual - Ad), -one), one)
                turned += (new - y) * (new - y)
                crossed += (new - y) * Ad
                cost += abs(residual)
                value -= b * new
                local[(4 * k + r) * LANES + lane] = new
        for at in range(k * LANES):
            y_bar[t, at] = local[2 * k * LANES + at] = local[4 * k * LANES + at]
        _scatter(local, tile, g_bar, keyframes[t], K)
    return weight * moved + turned / weight + 2 * crossed, cost, value


@compiled
def _reflect(x, z, g, twice, a):
    """Set z = x - twice g, x = a z, and clear g."""
    for j in range(len(x)):
        z[j] = x[j] - twice * g[j]
        x[j] = a * z[j]
        g[j] = 0


@compiled
def _gather(local, first, x, keyframes, K):
    """Copy x at both keyframes of each factor to 2 k rows of `local` from row `first` on."""
    k = len(K)
    for side in range(2):
        for lane in range(LANES):
            v = keyframes[side * LANES + lane]
            for c in range(k):
                local[(first + side * k + c) * LANES + lane] = x[v, c]


@compiled
def _scatter(local, tile, g, keyframes, K):
    """Add A'y of a tile to g; y : rows 2 k to 3 k of `local`, the rows before are scratch."""
    k = len(K)
    for lane in range(LANES):
        for c in range(k):
            first = second = local.dtype.type(0)
            for r in range(k):
                y = local[(2 * k + r) * LANES + lane]
                first += tile[(r * k + c) * LANES + lane] * y
                second += tile[((k + r) * k + c) * LANES + lane] * y
            local[c * LANES + lane] = first
            local[(k + c) * LANES + lane] = second
    for side in range(2):
        for lane in range(LANES):
            v = keyframes[side * LANES + lane]
            for c in range(k):
                g[v, c] += local[(side * k + c) * LANES + lane]
