# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Solving with the factor that `cholesky` left in the panels, forwards and backwards.

Rows of a panel are taken three at a time, so that what is read of the solution serves all three.
Most panels of a sparse graph are one keyframe wide: those are taken block by block, by loops
whose bounds are known when they are compiled, for a loop over three numbers takes longer to begin
than to run.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop
from l1slam_ros.core.kernels.vectors.inline import Inline

# Rows of a block of whole poses in the plane and in space. Panels of no more block columns are
# taken one such column after the other.
_PLANE, _SPACE, _THIN = 3, 6, 4


def _forward_of(k):
    """Return what does `_forward` for one block column of k columns."""

    def forward_tile(vectors, panels, begin, stride, rows, count, x):
        """Take rows : (count,) positions, the column's own first; begin : of its own block."""
        panel = vectors.at(panels, begin)
        to = vectors.at(x, vectors.times(vectors.entry(rows, 0), k))
        own = []
        for r in range(k):
            row = vectors.at(panel, vectors.times(stride, r))
            value = vectors.entry(to, r)
            for c in range(r):
                value = vectors.reduced(value, vectors.entry(row, c), own[c])
            own.append(vectors.over(value, vectors.entry(row, r)))
        for r in range(k):
            vectors.put(own[r], vectors.at(to, r))
        with vectors.range(count, 1) as block:
            first = vectors.times(block, k)
            to = vectors.at(x, vectors.times(vectors.entry(rows, block), k))
            for r in range(k):
                row = vectors.at(vectors.at(panel, vectors.times(stride, first)),
                                 vectors.times(stride, r))
                value = vectors.entry(to, r)
                for c in range(k):
                    value = vectors.reduced(value, vectors.entry(row, c), own[c])
                vectors.put(value, vectors.at(to, r))

    return Inline(forward_tile, 1)


def _backward_of(k):
    """Return what does `_backward` for one block column of k columns."""

    def backward_tile(vectors, panels, begin, stride, rows, count, x):
        """Take rows : (count,) positions, the column's own first; begin : of its own block."""
        mask = vectors.first(k)
        panel = vectors.at(panels, begin)
        total = vectors.variable(vectors.zeros)
        with vectors.range(count, 1) as block:
            first = vectors.times(block, k)
            below = vectors.at(x, vectors.times(vectors.entry(rows, block), k))
            for r in range(k):
                row = vectors.at(vectors.at(panel, vectors.times(stride, first)),
                                 vectors.times(stride, r))
                vectors.add(total, vectors.load(row, mask), vectors.spread(
                    vectors.entry(below, r)))
        to = vectors.at(x, vectors.times(vectors.entry(rows, 0), k))
        vectors.store(vectors.less(vectors.load(to, mask), total), to, mask)
        own = [vectors.entry(to, r) for r in range(k)]
        for r in range(k - 1, -1, -1):
            row = vectors.at(panel, vectors.times(stride, r))
            own[r] = vectors.over(own[r], vectors.entry(row, r))
            for c in range(r):
                own[c] = vectors.reduced(own[c], vectors.entry(row, c), own[r])
            vectors.put(own[r], vectors.at(to, r))

    return Inline(backward_tile, _LANES[k])


_LANES = {_PLANE: 4, _SPACE: 8}
_forward_plane, _backward_plane = _forward_of(_PLANE), _backward_of(_PLANE)
_forward_space, _backward_space = _forward_of(_SPACE), _backward_of(_SPACE)


@loop('(f8[::1], i4[::1], i8[::1], i4[::1], i8[::1], i8[::1], i4[::1], f8[:, ::1])')
def solve(panels, first, start, pattern, offset, stride, position, right):
    """Return the solution of L L' x = right; both (n, k) in the order of the keyframes."""
    n, k = right.shape
    x = np.empty(n * k)
    for f in range(n):
        for a in range(k):
            x[position[f] * k + a] = right[f, a]
    tallest = 0
    for s in range(len(first) - 1):
        tallest = max(tallest, start[s + 1] - start[s])
    place = np.empty(tallest * k, np.int64)
    for s in range(len(first) - 1):
        width = first[s + 1] - first[s]
        if width <= _THIN and k in (_PLANE, _SPACE):
            _forward_blocks(panels, offset[s], stride[s], pattern[start[s]:start[s + 1]], width, k,
                            x)
            continue
        height = _write_places(pattern[start[s]:start[s + 1]], k, place)
        own = x[first[s] * k:first[s + 1] * k]
        _forward(panels[offset[s]:offset[s + 1]], stride[s], place[:height], own, x)
    for s in range(len(first) - 2, -1, -1):
        width = first[s + 1] - first[s]
        if width <= _THIN and k in (_PLANE, _SPACE):
            _backward_blocks(panels, offset[s], stride[s], pattern[start[s]:start[s + 1]], width,
                             k, x)
            continue
        height = _write_places(pattern[start[s]:start[s + 1]], k, place)
        own = x[first[s] * k:first[s + 1] * k]
        _backward(panels[offset[s]:offset[s + 1]], stride[s], place[:height], own, x)
    solution = np.empty((n, k))
    for f in range(n):
        for a in range(k):
            solution[f, a] = x[position[f] * k + a]
    return solution


@compiled
def _forward_blocks(panels, begin, stride, rows, width, k, x):
    """Do what `_forward` does for a panel of few block columns; rows : its positions."""
    for c in range(width):
        at = begin + c * k * (stride + 1)
        if k == _PLANE:
            _forward_plane(panels, at, stride, rows[c:], len(rows) - c, x)
        else:
            _forward_space(panels, at, stride, rows[c:], len(rows) - c, x)


@compiled
def _backward_blocks(panels, begin, stride, rows, width, k, x):
    """Do what `_backward` does for a panel of few block columns; rows : its positions."""
    for c in range(width - 1, -1, -1):
        at = begin + c * k * (stride + 1)
        if k == _PLANE:
            _backward_plane(panels, at, stride, rows[c:], len(rows) - c, x)
        else:
            _backward_space(panels, at, stride, rows[c:], len(rows) - c, x)


@compiled
def _write_places(rows, k, place):
    """Write where in the solution each row of a panel belongs; return how many there are."""
    for r in range(len(rows)):
        for a in range(k):
            place[r * k + a] = rows[r] * k + a
    return len(rows) * k


@compiled
def _forward(panel, stride, place, own, x):
    """Solve for the supernode's own rows, and subtract what they do to the rows below."""
    width, height = len(own), len(place)
    for r in range(width):
        row, total = panel[r * stride:r * stride + width], 0.0
        for c in range(r):
            total += row[c] * own[c]
        own[r] = (own[r] - total) / row[r]
    for r in range(width, height, 3):
        r1, r2 = min(r + 1, height - 1), min(r + 2, height - 1)
        row0, row1 = panel[r * stride:r * stride + width], panel[r1 * stride:r1 * stride + width]
        row2 = panel[r2 * stride:r2 * stride + width]
        s0 = s1 = s2 = 0.0
        for c in range(width):
            s0 += row0[c] * own[c]
            s1 += row1[c] * own[c]
            s2 += row2[c] * own[c]
        x[place[r]] -= s0
        if r1 > r:
            x[place[r1]] -= s1
        if r2 > r1:
            x[place[r2]] -= s2


@compiled
def _backward(panel, stride, place, own, x):
    """Solve with the transpose for the supernode's own rows, once all below are known."""
    width, height = len(own), len(place)
    for r in range(width, height, 3):
        r1, r2 = min(r + 1, height - 1), min(r + 2, height - 1)
        row0, row1 = panel[r * stride:r * stride + width], panel[r1 * stride:r1 * stride + width]
        row2 = panel[r2 * stride:r2 * stride + width]
        x0, x1, x2 = x[place[r]], x[place[r1]], x[place[r2]]
        x1, x2 = x1 if r1 > r else 0.0, x2 if r2 > r1 else 0.0
        for c in range(width):
            own[c] -= row0[c] * x0 + row1[c] * x1 + row2[c] * x2
    for r in range(width - 1, -1, -1):
        row = panel[r * stride:r * stride + width]
        own[r] /= row[r]
        for c in range(r):
            own[c] -= row[c] * own[r]
