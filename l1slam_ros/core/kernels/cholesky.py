# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Supernodal Cholesky of a sparse matrix of k x k blocks: assembly and factorisation.

Panels are dense, row after row: entry (r, c) of panel s is panels[offset[s] + r stride[s] + c].
Left-looking: each supernode gathers what all earlier ones subtract from it, then is factored; all
the work is done in tiles of 2 x 3 inner products, which reuse what they load and suit blocks of
three and of six. (Of 3 x 3, the compiler makes code that is half as fast, or worse where rows are
short.)

`size` is k zeros. As a tuple its length is known when a loop is compiled, so that loops over the
rows of a block are unrolled; as an array it serves blocks of every other size. To factor takes no
longer without it.

Source: Ng and Peyton, "Block sparse Cholesky algorithms on advanced uniprocessor computers"
(1993).
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import ANY_SIZE, compiled, for_sizes, loop

# A pivot that is left with less than this part of its diagonal entry is rounding.
_SINGULAR = 1e-13
# As many zeros as a pose has numbers.
_IN_PLANE, _IN_SPACE = (0,) * 3, (0,) * 6
# Factors whose blocks are fetched at the same time.
_AHEAD = 16


_PANELS = 'f8[::1], i4[::1], i8[::1], i4[::1], i8[::1], i8[::1]'
_FACTORS = ('f8[::1], i8[:, ::1], i8[::1], i8[::1], b1[::1], i8[::1], i8[::1], f8[:, :, :, ::1], '
            'f8[:, ::1], f8[:, ::1], f8[:, :, :, ::1], f8')


@for_sizes(_FACTORS, ANY_SIZE)
def assemble(panels, keyframe, address, width, turned, corner, stride, blocks, weights, diagonal,
             curvature, share, size):
    """
    Write the lower triangle of J'WJ + diag(diagonal) + share C to the panels.

    keyframe : (m, 2), blocks : (m, 2, k, k), see `LinearSystem`; weights : (m, k); diagonal :
    (n, k)
    curvature : (m', 2, k // 2, 2 k) of the first m' factors, of each the rows of the turns, the
        last entries, of keyframe i, and of j, which are its columns, too; all else is zero. C is
        their sum
    address, width : (m,) where the block between the keyframes i and j of each factor lies, and
    the stride of its panel; address -1: there is none
    turned : (m,) bool, that block is the one of row i and column j
    corner, stride : (n,) where each keyframe's own block begins, and its panel's stride

    Returns the sum of what it read ahead, which is of no use.
    """
    k = len(size)
    for at in range(len(panels)):
        panels[at] = 0.0
    # Keyframes' own blocks are summed up side by side: in the panels they lie far apart, and each
    # factor would wait for two of them.
    own = _own_blocks(diagonal)
    scaled, seen = np.empty((2, k, k)), 0.0
    for f in range(len(blocks)):
        if f % _AHEAD == 0:
            seen += _read_ahead(panels, address[f:f + _AHEAD], width[f:f + _AHEAD], k)
        for side in range(2):
            for r in range(k):
                for c in range(k):
                    scaled[side, r, c] = weights[f, r] * blocks[f, side, r, c]
            for r in range(k):
                for c in range(r + 1):
                    total = 0.0
                    for a in range(k):
                        total += blocks[f, side, a, r] * scaled[side, a, c]
                    own[keyframe[f, side], r, c] += total
        left = 0 if turned[f] else 1
        right = 1 - left
        if address[f] >= 0:
            for r in range(k):
                for c in range(k):
                    total = 0.0
                    for a in range(k):
                        total += blocks[f, left, a, r] * scaled[right, a, c]
                    panels[address[f] + r * width[f] + c] += total
        if f < len(curvature):
            _add_curvature(own, panels, keyframe[f], address[f], width[f], left, curvature[f],
                           share, k)
    for v in range(len(corner)):
        for r in range(k):
            for c in range(r + 1):
                panels[corner[v] + r * stride[v] + c] = own[v, r, c]
    return seen


@compiled
def _add_curvature(own, panels, keyframe, at, width, left, curvature, share, k):
    """
    Add a factor's curvature to its keyframes' own blocks, and to the one between, if it has one.

    keyframe : (2,); at, width, left : of its block, see `assemble`; curvature : (2, k // 2, 2 k)
    """
    # Of three and of six numbers a step turns by one and by three.
    still = k - k // 2
    for side in range(2):
        for r in range(still, k):
            for c in range(r + 1):
                own[keyframe[side], r, c] += share * curvature[side, r - still, side * k + c]
    if at < 0:
        return
    right = 1 - left
    for r in range(still):
        for c in range(still, k):
            panels[at + r * width + c] += share * curvature[right, c - still, left * k + r]
    for r in range(still, k):
        for c in range(k):
            panels[at + r * width + c] += share * curvature[left, r - still, right * k + c]


@compiled
def _own_blocks(diagonal):
    """Return a block for each keyframe, with this diagonal, and one for what is held fixed."""
    n, k = diagonal.shape
    own = np.zeros((n + 1, k, k))
    for v in range(n):
        for a in range(k):
            own[v, a, a] = diagonal[v, a]
    return own


@compiled
def _read_ahead(panels, address, width, k):
    """
    Return the sum of a number of each row of some blocks.

    They lie anywhere in memory. Read one right after the other, they are fetched at the same time;
    and a sum that is returned is not left out by the compiler.
    """
    seen = 0.0
    for f in range(len(address)):
        for r in range(k):
            seen += panels[max(address[f], 0) + r * width[f]]
    return seen


@loop(f'({_PANELS}, i4[::1], i1[::1], i8, i4[:, ::1], i8[::1], i8)')
def factorise(panels, first, start, pattern, offset, stride, owner, share, mine, lists, reach, d):
    """
    Turn the lower triangle in `panels` into its Cholesky factor, for one share of the supernodes.

    Shares may be worked on at the same time, and the last one after all others.

    owner : (n,) the supernode of each position; share : of each supernode; mine : the one to do
    lists, reach : (2, supernodes) -1 and (supernodes,) 0, kept from one share to the next
    d : rows of a block

    Returns the first position whose pivot is not positive; the number of positions when all are.
    """
    count, n = len(first) - 1, first[-1]
    local = np.empty(n, np.int64)
    tallest = d * _begin_share(reach, start, pattern, owner, share, mine, lists)
    place, target = np.empty(tallest, np.int64), np.empty(tallest, np.int64)
    least = np.empty(tallest)
    for s in range(count):
        if share[s] != mine:
            continue
        width = (first[s + 1] - first[s]) * d
        for k in range(start[s], start[s + 1]):
            local[pattern[k]] = offset[s] + (k - start[s]) * d * stride[s]
        for c in range(width):
            least[c] = _SINGULAR * panels[offset[s] + c * (stride[s] + 1)]
        source = lists[0, s]
        while source >= 0:
            next_source = lists[1, source]
            rows = pattern[start[source] + reach[source]:start[source + 1]]
            inner = (first[source + 1] - first[source]) * d
            top = offset[source] + reach[source] * d * stride[source]
            columns = _within(rows, first[s + 1])
            # Row by row of the blocks: a loop over so few rows takes longer than what it does.
            for a in range(d):
                for k in range(len(rows)):
                    place[k * d + a] = local[rows[k]] + a * stride[s]
                for k in range(columns):
                    target[k * d + a] = (rows[k] - first[s]) * d + a
            _subtract(panels[top:], stride[source], inner, len(rows) * d, columns * d, panels,
                      place, target)
            reach[source] += columns
            _enqueue(source, reach, start, pattern, owner, share, mine, lists)
            source = next_source
        panel = panels[offset[s]:offset[s + 1]]
        bad = _factorise_panel(panel, stride[s], (start[s + 1] - start[s]) * d, width, least)
        if bad < width:
            return first[s] + bad // d
        reach[s] = first[s + 1] - first[s]
        _enqueue(s, reach, start, pattern, owner, share, mine, lists)
    return n


@compiled
def _within(rows, end):
    """Return how many of the sorted rows lie before `end`."""
    count = 0
    while count < len(rows) and rows[count] < end:
        count += 1
    return count


@compiled
def _begin_share(reach, start, pattern, owner, share, mine, lists):
    """Enqueue the supernodes of earlier shares; return how many rows the tallest of all has."""
    tallest = 0
    for s in range(len(share)):
        tallest = max(tallest, start[s + 1] - start[s])
        if share[s] < mine:
            _enqueue(s, reach, start, pattern, owner, share, mine, lists)
    return tallest


@compiled
def _enqueue(source, reach, start, pattern, owner, share, mine, lists):
    """
    Let a supernode wait for the one that owns its next row, if that is of this share.

    Supernodes that have something to subtract from s are a linked list: lists[0, s] is the first,
    lists[1, t] the one behind t; reach: from which of their rows on.
    """
    if start[source] + reach[source] < start[source + 1]:
        target = owner[pattern[start[source] + reach[source]]]
        if share[target] == mine:
            lists[1, source] = lists[0, target]
            lists[0, target] = source


@compiled
def _subtract(source, stride, inner, height, columns, panels, place, target):
    """
    Subtract products of a source's rows, from `top` on, from the panel that they belong to.

    place : (height,) where each of the rows begins in the target's panel; target : (columns,) the
    column of that panel that belongs to each of the first rows
    """
    for c in range(0, columns, 3):
        c1, c2 = min(c + 1, columns - 1), min(c + 2, columns - 1)
        right = (source[c * stride:c * stride + inner], source[c1 * stride:c1 * stride + inner],
                 source[c2 * stride:c2 * stride + inner])
        for r in range(c, height, 2):
            r1 = min(r + 1, height - 1)
            left = source[r * stride:r * stride + inner], source[r1 * stride:r1 * stride + inner]
            # Most panels of sparse graphs are as wide as a block of a pose.
            if inner == 3:
                tile = _tile(left, right, _IN_PLANE)
            elif inner == 6:
                tile = _tile(left, right, _IN_SPACE)
            else:
                tile = _tile(left, right, left[0])
            _write(panels[place[r]:], target[c], target[c1], target[c2], c1 > c, c2 > c1, tile[0])
            if r1 > r:
                _write(panels[place[r1]:], target[c], target[c1], target[c2], c1 > c, c2 > c1,
                       tile[1])


@compiled
def _write(row, t0, t1, t2, has_second, has_third, values):
    """Subtract up to three values from a row of a panel."""
    row[t0] -= values[0]
    if has_second:
        row[t1] -= values[1]
    if has_third:
        row[t2] -= values[2]


@compiled
def _tile(left, right, along):
    """
    Return the six inner products of two rows with three rows, each as long as `along`.

    A row, or a tuple, whose length the compiler knows: then the loop is unrolled.
    """
    left0, left1 = left
    right0, right1, right2 = right
    s00 = s01 = s02 = s10 = s11 = s12 = 0.0
    for q in range(len(along)):
        x0, x1 = left0[q], left1[q]
        y0, y1, y2 = right0[q], right1[q], right2[q]
        s00 += x0 * y0
        s01 += x0 * y1
        s02 += x0 * y2
        s10 += x1 * y0
        s11 += x1 * y1
        s12 += x1 * y2
    return (s00, s01, s02), (s10, s11, s12)


@compiled
def _factorise_panel(panel, stride, height, width, least):
    """
    Factor the diagonal block of a panel and solve for the rest; return the bad column.

    least : (width,) what each pivot must exceed
    """
    for c in range(0, width, 3):
        strip = min(3, width - c)
        if c:
            _update_strip(panel, stride, height, width, c, strip)
        at = c * stride + c
        for k in range(strip):
            pivot = panel[at + k * stride + k]
            for q in range(k):
                pivot -= panel[at + k * stride + q] ** 2
            if not pivot > max(least[c + k], 0.0):
                return c + k
            panel[at + k * stride + k] = np.sqrt(pivot)
            for r in range(k + 1, strip):
                value = panel[at + r * stride + k]
                for q in range(k):
                    value -= panel[at + r * stride + q] * panel[at + k * stride + q]
                panel[at + r * stride + k] = value / panel[at + k * stride + k]
        _solve_strip(panel[at + strip * stride:], panel[at:], height - c - strip, stride, strip)
    return width


@compiled
def _update_strip(panel, stride, height, width, c, strip):
    """Subtract from up to three columns what the columns before them do."""
    c1, c2 = min(c + 1, width - 1), min(c + 2, width - 1)
    right = (panel[c * stride:c * stride + c], panel[c1 * stride:c1 * stride + c],
             panel[c2 * stride:c2 * stride + c])
    for r in range(c, height, 2):
        r1 = min(r + 1, height - 1)
        left = panel[r * stride:r * stride + c], panel[r1 * stride:r1 * stride + c]
        tile = _tile(left, right, left[0])
        _write(panel[r * stride:], c, c1, c2, strip > 1, strip > 2, tile[0])
        if r1 > r:
            _write(panel[r1 * stride:], c, c1, c2, strip > 1, strip > 2, tile[1])


@compiled
def _solve_strip(below, diagonal, height, stride, strip):
    """Solve for the rows below a factored block of one to three columns."""
    f00, f10, f11, f20, f21, f22 = 1 / diagonal[0], 0.0, 0.0, 0.0, 0.0, 0.0
    if strip > 1:
        f10, f11 = diagonal[stride], 1 / diagonal[stride + 1]
    if strip > 2:
        f20, f21 = diagonal[2 * stride], diagonal[2 * stride + 1]
        f22 = 1 / diagonal[2 * stride + 2]
    for r in range(height):
        row = below[r * stride:r * stride + strip]
        x = row[0] * f00
        row[0] = x
        if strip > 1:
            y = (row[1] - x * f10) * f11
            row[1] = y
            if strip > 2:
                row[2] = (row[2] - x * f20 - y * f21) * f22
