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

So with what hangs on points of a border, each on one before it; see `border`.

As `cholesky` does, it works on tiles whose sums stay in registers.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import Inline, compiled, loop

# Numbers of a vector, and of a narrow one.
_WIDE, _NARROW = 8, 4


def _subtract_tile(vectors, left, stride, rows, inner, own, x, place):
    """Subtract from up to as many entries of x as a vector has products of rows with `own`."""
    row = vectors.indices(vectors.lanes, rows)
    begin = [vectors.at(left, vectors.times(r, stride)) for r in row]
    totals = [vectors.variable(vectors.zeros) for _ in row]
    whole, rest = vectors.divided(inner, vectors.lanes)
    with vectors.range(whole) as q:
        at = vectors.times(q, vectors.lanes)
        factor = vectors.load(vectors.at(own, at))
        for total, numbers in zip(totals, begin, strict=True):
            vectors.add(total, vectors.load(vectors.at(numbers, at)), factor)
    at, mask = vectors.times(whole, vectors.lanes), vectors.first(rest)
    factor = vectors.load(vectors.at(own, at), mask)
    for total, numbers in zip(totals, begin, strict=True):
        vectors.add(total, vectors.load(vectors.at(numbers, at), mask), factor)
    products = vectors.sums([vectors.value(total) for total in totals])
    vectors.subtract_from(x, [vectors.entry(place, r) for r in row], products)


def _pull_tile(vectors, below, stride, rows, known, own, columns):
    """Subtract from up to as many entries of `own` as a vector has what the rows below pull."""
    mask = vectors.first(columns)
    totals = [vectors.variable(vectors.zeros) for _ in range(2)]
    pairs, single = vectors.divided(rows, 2)
    with vectors.range(pairs) as pair:
        for k, total in enumerate(totals):
            r = vectors.plus(vectors.times(pair, 2), k)
            numbers = vectors.load(vectors.at(below, vectors.times(r, stride)), mask)
            vectors.add(total, numbers, vectors.spread(vectors.entry(known, r)))
    with vectors.range(single):
        r = vectors.times(pairs, 2)
        numbers = vectors.load(vectors.at(below, vectors.times(r, stride)), mask)
        vectors.add(totals[0], numbers, vectors.spread(vectors.entry(known, r)))
    left = vectors.load(own, mask)
    for total in totals:
        left = vectors.less(left, total)
    vectors.store(left, own, mask)


def _corner_tile(vectors, corner, stride, columns, own):
    """Solve for as many entries of `own` as a vector has, with a corner of the factor."""
    row = vectors.indices(vectors.lanes, columns)
    begin = [vectors.at(corner, vectors.times(r, stride)) for r in row]
    inverse = vectors.inverse(vectors.gathered(
        [vectors.entry(one, r) for one, r in zip(begin, row, strict=True)]))
    mask = vectors.first(columns)
    found = vectors.load(own, mask)
    for k in range(vectors.lanes - 1):
        below = [vectors.entry(one, row[k]) for one in begin[k + 1:]]
        column = vectors.gathered([vectors.zero] * (k + 1) + below)
        found = vectors.eliminated(found, k, vectors.scaled(column, vectors.lane(inverse, k)))
    vectors.store(vectors.scaled(found, inverse), own, mask)


def _turned_tile(vectors, corner, stride, columns, own):
    """Solve for as many entries of `own` as a vector has, with the transpose of a corner."""
    row = vectors.indices(vectors.lanes, columns)
    begin = [vectors.at(corner, vectors.times(r, stride)) for r in row]
    inverse = vectors.inverse(vectors.gathered(
        [vectors.entry(one, r) for one, r in zip(begin, row, strict=True)]))
    mask = vectors.first(columns)
    found = vectors.load(own, mask)
    for k in range(vectors.lanes - 1, 0, -1):
        before = vectors.load(begin[k], vectors.first(vectors.at_most(k, columns)))
        found = vectors.eliminated(found, k, vectors.scaled(before, vectors.lane(inverse, k)))
    vectors.store(vectors.scaled(found, inverse), own, mask)


_subtract_wide, _subtract_narrow = (Inline(_subtract_tile, lanes) for lanes in (_WIDE, _NARROW))
_pull_wide, _pull_narrow = (Inline(_pull_tile, lanes) for lanes in (_WIDE, _NARROW))
_corner_wide, _corner_narrow = (Inline(_corner_tile, lanes) for lanes in (_WIDE, _NARROW))
_turned_wide, _turned_narrow = (Inline(_turned_tile, lanes) for lanes in (_WIDE, _NARROW))


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
    place, known = np.empty(tallest * k, np.int64), np.empty(tallest * k)
    for s in range(len(first) - 1):
        height = _write_places(pattern[start[s]:start[s + 1]], k, place)
        own = x[first[s] * k:first[s + 1] * k]
        _forward(panels[offset[s]:offset[s + 1]], stride[s], place[:height], own, x)
    for s in range(len(first) - 2, -1, -1):
        height = _write_places(pattern[start[s]:start[s + 1]], k, place)
        own = x[first[s] * k:first[s + 1] * k]
        _backward(panels[offset[s]:offset[s + 1]], stride[s], place[:height], own, x, known)
    solution = np.empty((n, k))
    for f in range(n):
        for a in range(k):
            solution[f, a] = x[position[f] * k + a]
    return solution


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
    for c in range(0, width, _WIDE):
        columns, corner = min(_WIDE, width - c), panel[c * (stride + 1):]
        if columns > _NARROW:
            _subtract_wide(panel[c * stride:], stride, columns, c, own, x, place[c:])
            _corner_wide(corner, stride, columns, own[c:])
        else:
            _subtract_narrow(panel[c * stride:], stride, columns, c, own, x, place[c:])
            _corner_narrow(corner, stride, columns, own[c:])
    if width > _NARROW:
        for r in range(width, height, _WIDE):
            rows = min(_WIDE, height - r)
            _subtract_wide(panel[r * stride:], stride, rows, width, own, x, place[r:])
    else:
        for r in range(width, height, _NARROW):
            rows = min(_NARROW, height - r)
            _subtract_narrow(panel[r * stride:], stride, rows, width, own, x, place[r:])


@compiled
def _backward(panel, stride, place, own, x, known):
    """
    Solve with the transpose for the supernode's own rows, once all below are known.

    known : work space for what is below
    """
    width, height = len(own), len(place)
    for r in range(width, height):
        known[r - width] = x[place[r]]
    for c in range(0, width, _WIDE):
        below, columns = panel[width * stride + c:], min(_WIDE, width - c)
        if columns > _NARROW:
            _pull_wide(below, stride, height - width, known, own[c:], columns)
        else:
            _pull_narrow(below, stride, height - width, known, own[c:], columns)
    for c in range((width - 1) // _WIDE * _WIDE, -1, -_WIDE):
        columns, corner = min(_WIDE, width - c), panel[c * (stride + 1):]
        if columns > _NARROW:
            _turned_wide(corner, stride, columns, own[c:])
        else:
            _turned_narrow(corner, stride, columns, own[c:])
        for left in range(0, c, _WIDE):
            _pull_wide(panel[c * stride + left:], stride, columns, own[c:], own[left:], _WIDE)


@loop('(i8[::1], f8[:, :, ::1], f8[:, ::1])')
def pull_parents(parent, turn, gradient):
    """Let what pulls at points, (t, k), pull at what they hang on, too."""
    for s in range(len(parent) - 1, -1, -1):
        if parent[s] >= 0:
            for r in range(gradient.shape[1]):
                for c in range(gradient.shape[1]):
                    gradient[parent[s], c] += turn[s, r, c] * gradient[s, r]


@loop('(i8[::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1])')
def move_children(parent, turn, noise, gradient, moved):
    """Write how far from their means points are that hang on others, (t, k)."""
    k = moved.shape[1]
    for s in range(len(parent)):
        for r in range(k):
            for c in range(k):
                moved[s, r] += noise[s, r, c] * gradient[s, c]
                if parent[s] >= 0:
                    moved[s, r] += turn[s, r, c] * moved[parent[s], c]
