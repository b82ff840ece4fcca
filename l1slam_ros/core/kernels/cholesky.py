# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Supernodal Cholesky of a sparse matrix of k x k blocks, which `blocks.assemble` wrote.

Panels are dense, row after row: entry (r, c) of panel s is panels[offset[s] + r stride[s] + c].
Left-looking: each supernode gathers what all earlier ones subtract from it, then is factored. All
the work is done in tiles of 6 rows by 8 columns, or 4: a tile stays in the processor's registers
while what its rows have in common with its columns is summed up. Left to itself, the compiler
makes code that is half as fast or worse.

Source: Ng and Peyton, "Block sparse Cholesky algorithms on advanced uniprocessor computers"
(1993); tiles: Goto and van de Geijn, "Anatomy of high-performance matrix multiplication" (2008).
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop
from l1slam_ros.core.kernels.vectors.inline import Inline

# A pivot that is left with less than this part of its diagonal entry is rounding.
_SINGULAR = 1e-13
# Rows and columns of a tile, and columns of a narrow one: as many sums as registers hold.
_ROWS, _WIDE, _NARROW = 6, 8, 4

# Rows of a block of whole poses in the plane, and most columns of a source of such blocks that is
# subtracted block by block: a tile takes longer to begin than so few products.
_PLANE, _THIN = 3, 12

_PANELS = 'f8[::1], i4[::1], i8[::1], i4[::1], i8[::1], i8[::1]'


def _subtract_tile(vectors, left, stride, rows, right, inner, panels, place, column, columns):
    """
    Subtract products of up to six rows with up to as many columns as a vector has numbers.

    left : those rows, of `inner` numbers each; right : (inner, lanes) the columns; panels, place,
    column : where to subtract, see `_subtract`; of what is beyond, the last row is done again
    """
    row = vectors.indices(_ROWS, rows)
    begin = [vectors.at(left, vectors.times(r, stride)) for r in row]
    sums = [vectors.variable(vectors.zeros) for _ in row]
    with vectors.range(inner) as q:
        factor = vectors.load(vectors.at(right, vectors.times(q, vectors.lanes)))
        for total, numbers in zip(sums, begin, strict=True):
            vectors.add(total, vectors.spread(vectors.entry(numbers, q)), factor)
    mask = vectors.first(columns)
    # All are read before any is written, for the last row may be there more than once.
    to = [vectors.at(vectors.at(panels, vectors.entry(place, r)), column) for r in row]
    was = [vectors.load(where, mask) for where in to]
    for where, value, total in zip(to, was, sums, strict=True):
        vectors.store(vectors.less(value, total), where, mask)


def _solve_tile(vectors, panels, place, rows, column, columns, corner):
    """
    Solve for up to six rows and the columns of a factored corner.

    corner : (lanes + 1, lanes) each column of the corner below its diagonal over the entry there,
    and one over all these entries
    """
    row = vectors.indices(_ROWS, rows)
    mask = vectors.first(columns)
    to = [vectors.at(vectors.at(panels, vectors.entry(place, r)), column) for r in row]
    found = [vectors.load(where, mask) for where in to]
    for k in range(vectors.lanes):
        below = vectors.load(vectors.at(corner, vectors.lanes * k))
        found = [vectors.eliminated(one, k, below) for one in found]
    inverse = vectors.load(vectors.at(corner, vectors.lanes**2))
    for where, one in zip(to, found, strict=True):
        vectors.store(vectors.scaled(one, inverse), where, mask)


def _pack_tile(vectors, source, stride, rows, inner, packed):
    """Write up to as many rows as a vector has numbers as columns, (inner, lanes)."""
    begin = [vectors.at(source, vectors.times(r, stride))
             for r in vectors.indices(vectors.lanes, rows)]
    with vectors.range(inner) as q:
        numbers = [vectors.entry(one, q) for one in begin]
        vectors.store(vectors.gathered(numbers),
                      vectors.at(packed, vectors.times(q, vectors.lanes)))


def _blocks_tile(vectors, panels, begin, width, rows, count, local, column, stride):
    """
    Subtract products of blocks in the plane with the first of them from another panel.

    begin, width : of the blocks; rows : (count,) their positions; local, column, stride : where to
    """
    mask = vectors.first(_PLANE)
    source = vectors.at(panels, begin)
    right = [[vectors.entry(vectors.at(source, vectors.times(width, r)), q)
              for r in range(_PLANE)] for q in range(_PLANE)]
    right = [vectors.gathered(numbers) for numbers in right]
    with vectors.range(count) as k:
        block = vectors.at(source, vectors.times(vectors.times(width, _PLANE), k))
        to = vectors.at(panels, vectors.entry(local, vectors.entry(rows, k)))
        to = vectors.at(to, column)
        for r in range(_PLANE):
            row = vectors.at(block, vectors.times(width, r))
            total = vectors.variable(vectors.zeros)
            for q in range(_PLANE):
                vectors.add(total, vectors.spread(vectors.entry(row, q)), right[q])
            where = vectors.at(to, vectors.times(stride, r))
            vectors.store(vectors.less(vectors.load(where, mask), total), where, mask)


_subtract_blocks = Inline(_blocks_tile, _NARROW)
_subtract_wide, _subtract_narrow = (Inline(_subtract_tile, lanes) for lanes in (_WIDE, _NARROW))
_pack_wide, _pack_narrow = (Inline(_pack_tile, lanes) for lanes in (_WIDE, _NARROW))
_solve_wide, _solve_narrow = (Inline(_solve_tile, lanes) for lanes in (_WIDE, _NARROW))


@loop(f'({_PANELS}, i4[::1], i1[::1], i8, i4[:, ::1], i8[::1], i8)', as_written=True)
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
    local, place, target, least, packed = _work_space(
        n, d * _begin_share(reach, start, pattern, owner, share, mine, lists))
    for s in range(count):
        if share[s] != mine:
            continue
        width, height = _begin_panel(
            panels, offset[s], stride[s], pattern[start[s]:start[s + 1]], first[s + 1] - first[s],
            d, local, least)
        source = lists[0, s]
        while source >= 0:
            next_source = lists[1, source]
            rows = pattern[start[source] + reach[source]:start[source + 1]]
            inner = (first[source + 1] - first[source]) * d
            top = offset[source] + reach[source] * d * stride[source]
            columns = _within(rows, first[s + 1])
            if d == _PLANE and inner <= _THIN:
                for c in range(columns):
                    for q in range(top, top + inner, _PLANE):
                        _subtract_blocks(
                            panels, q + c * _PLANE * stride[source], stride[source], rows[c:],
                            len(rows) - c, local, (rows[c] - first[s]) * _PLANE, stride[s])
            else:
                _find_places(rows, columns, local, first[s], stride[s], d, place, target)
                _subtract(panels[top:], stride[source], inner, len(rows) * d, columns * d, panels,
                          place, target, packed)
            reach[source] += columns
            _enqueue(source, reach, start, pattern, owner, share, mine, lists)
            source = next_source
        if width == _PLANE:
            bad = _factorise_block(panels[offset[s]:], stride[s], height, least)
        else:
            bad = _factorise_panel(panels, offset[s], stride[s], height, width, least, place,
                                   target, packed)
        if bad < width:
            return first[s] + bad // d
        reach[s] = first[s + 1] - first[s]
        _enqueue(s, reach, start, pattern, owner, share, mine, lists)
    return n


@compiled
def _work_space(n, tallest):
    """Return room for local, place, target, least and packed."""
    return (np.empty(n, np.int64), np.empty(tallest, np.int64), np.empty(tallest, np.int64),
            np.empty(tallest), np.zeros(_WIDE * (tallest + _WIDE + 1)))


@compiled
def _begin_panel(panels, begin, stride, rows, columns, d, local, least):
    """Write where a panel's rows begin, and what pivots must exceed; return width and height."""
    for k in range(len(rows)):
        local[rows[k]] = begin + k * d * stride
    for c in range(columns * d):
        least[c] = _SINGULAR * panels[begin + c * (stride + 1)]
    return columns * d, len(rows) * d


@compiled
def _find_places(rows, columns, local, first, stride, d, place, target):
    """
    Write where a source's rows begin in another one's panel, and which of its columns are which.

    rows : (blocks,) positions, the first `columns` of them the panel's own; local : of each
    position where it begins; place, target : see `_subtract`
    """
    # Row by row of the blocks: a loop over so few rows takes longer than what it does.
    for a in range(d):
        for k in range(len(rows)):
            place[k * d + a] = local[rows[k]] + a * stride
        for k in range(columns):
            target[k * d + a] = (rows[k] - first) * d + a


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
def _subtract(source, stride, inner, height, columns, panels, place, target, packed):
    """
    Subtract products of a source's first rows from the panel that they belong to.

    place : (height,) where each of the rows begins in the target's panel; target : (columns,) the
    column of that panel that belongs to each of the first rows; packed : work space
    """
    c = 0
    while c < columns:
        end = c + 1
        while end < min(c + _WIDE, columns) and target[end] == target[end - 1] + 1:
            end += 1
        is_wide = end - c > _NARROW
        if is_wide:
            _pack_wide(source[c * stride:], stride, end - c, inner, packed)
        else:
            _pack_narrow(source[c * stride:], stride, end - c, inner, packed)
        for r in range(c, height, _ROWS):
            left, rows, to = source[r * stride:], min(_ROWS, height - r), place[r:]
            if is_wide:
                _subtract_wide(left, stride, rows, packed, inner, panels, to, target[c], end - c)
            else:
                _subtract_narrow(left, stride, rows, packed, inner, panels, to, target[c],
                                 end - c)
        c = end


@compiled
def _factorise_block(panel, stride, height, least):
    """Do what `_factorise_panel` does, for a panel of one block column in the plane."""
    if not panel[0] > max(least[0], 0.0):
        return 0
    d0 = np.sqrt(panel[0])
    i0 = 1 / d0
    l10, l20 = panel[stride] * i0, panel[2 * stride] * i0
    d1 = panel[stride + 1] - l10 * l10
    if not d1 > max(least[1], 0.0):
        return 1
    d1 = np.sqrt(d1)
    i1 = 1 / d1
    l21 = (panel[2 * stride + 1] - l20 * l10) * i1
    d2 = panel[2 * stride + 2] - l20 * l20 - l21 * l21
    if not d2 > max(least[2], 0.0):
        return 2
    d2 = np.sqrt(d2)
    i2 = 1 / d2
    panel[0], panel[stride], panel[stride + 1] = d0, l10, d1
    panel[2 * stride], panel[2 * stride + 1], panel[2 * stride + 2] = l20, l21, d2
    for r in range(_PLANE, height):
        row = panel[r * stride:]
        x0 = row[0] * i0
        x1 = (row[1] - x0 * l10) * i1
        row[0], row[1] = x0, x1
        row[2] = (row[2] - x0 * l20 - x1 * l21) * i2
    return _PLANE


@compiled
def _factorise_panel(panels, begin, stride, height, width, least, place, target, packed):
    """
    Factor the diagonal block of a panel and solve for the rest; return the bad column.

    begin : of the panel; least : (width,) what each pivot must exceed; others : work space
    """
    for r in range(height):
        place[r] = begin + r * stride
        target[r] = r
    for c in range(0, width, _WIDE):
        columns = min(_WIDE, width - c)
        top = place[c]
        if c:
            _subtract(panels[top:], stride, c, height - c, columns, panels, place[c:],
                      target[c:], packed)
        lanes = _WIDE if columns > _NARROW else _NARROW
        bad = _factorise_corner(panels[top + c:], stride, columns, least[c:], lanes, packed)
        if bad < columns:
            return c + bad
        for r in range(c + columns, height, _ROWS):
            rows = min(_ROWS, height - r)
            if lanes == _WIDE:
                _solve_wide(panels, place[r:], rows, c, columns, packed)
            else:
                _solve_narrow(panels, place[r:], rows, c, columns, packed)
    return width


@compiled
def _factorise_corner(corner, stride, width, least, lanes, packed):
    """Factor a diagonal block of a few columns, and pack it for `_solve_tile`; as above."""
    for k in range(lanes * (lanes + 1)):
        packed[k] = 0.0
    inverse = packed[lanes * lanes:]
    for k in range(width):
        pivot = corner[k * (stride + 1)]
        for q in range(k):
            pivot -= corner[k * stride + q] ** 2
        if not pivot > max(least[k], 0.0):
            return k
        root = np.sqrt(pivot)
        inverse[k] = 1 / root
        corner[k * (stride + 1)] = root
        for r in range(k + 1, width):
            value = corner[r * stride + k]
            for q in range(k):
                value -= corner[r * stride + q] * corner[k * stride + q]
            value *= inverse[k]
            corner[r * stride + k] = value
            packed[k * lanes + r] = value * inverse[k]
    return width
