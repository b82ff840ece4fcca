# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A sparse factorisation bordered by later factors: covariances, and a dense factor that grows.

The arrays of the sparse factor are those of `cholesky`. L^-1 e_p for the k columns of one keyframe
p is zero except on the path from p to the root of the elimination tree. The covariance of two
keyframes is the product of their columns on the part that both paths share, which is the end of
both. If columns are too long to be kept, as in a chain, H^-1 e_p is solved for on the paths.

Points are the keyframes of later factors. Points newer than the factorisation have no position in
the factor; they depend on another point, their parent: x = turn x_parent + noise. Triangular
matrices are stored row by row, row r from r (r + 1) / 2 on, so that they grow at their end: the
factor F, and the covariances of points, that of s <= t at t (t + 1) / 2 + s.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop


@loop('(f8[::1], i4[::1], i8[::1], i4[::1], i8[::1], i8[::1], i4[::1], i8[::1], i8[::1], '
      'f8[:, :, ::1], f8[::1], i8[::1], f8[:, :, ::1])')
def reach(panels, first, start, pattern, offset, stride, owner, at, parent, turn, kept, begins,
          product):
    """
    Write the covariances of all points with the last one, (t, k, k); return its columns, (k, w).

    owner : (n,) the supernode of each position; at : (t,) the position of each point, -1 for what
    has none; parent, turn : (t,), (t, k, k), see above; kept : columns of points, one after the
    other; begins : (t,) where those of each are among them, -1 for none
    """
    t, k = len(product), len(turn[0])
    solved, last = np.empty(t, np.int64), at[t - 1]
    for s in range(t):
        solved[s] = at[s] if begins[s] < 0 else -1
    # Where in the columns each position on a way is.
    where, length = np.empty(len(owner), np.int32), 0
    ways = np.empty(len(first) - 1, np.int32)
    for s in ways[:_ways(first, start, pattern, owner, solved, ways)]:
        for position in range(first[s], first[s + 1]):
            where[position] = length
            length += 1
    values = np.zeros((k, length * k))
    for q in range(k):
        values[q, where[last] * k + q] = 1.0
    own = ways[:_ways(first, start, pattern, owner, at[t - 1:], ways)]
    for s in own[::-1]:
        begin = max(first[s], last)
        _climb_panel(panels[offset[s]:offset[s + 1]], stride[s],
                     pattern[start[s]:start[s + 1]], first[s + 1] - first[s], begin - first[s],
                     where, values, where[begin] * k)
    columns, left = _along(first, own, where, values)
    solved[t - 1] = -1
    for s in ways[:_ways(first, start, pattern, owner, solved, ways)]:
        _descend_panel(panels[offset[s]:offset[s + 1]], stride[s],
                       pattern[start[s]:start[s + 1]], first[s + 1] - first[s], where, values,
                       where[first[s]] * k)
    for s in range(t):
        if parent[s] >= 0:
            _multiply(turn[s], product[parent[s]], product[s])
        elif at[s] < 0 or (s < t - 1 and begins[s] < 0):
            for r in range(k):
                for c in range(k):
                    product[s, r, c] = values[c, where[at[s]] * k + r] if at[s] >= 0 else 0.0
        else:
            width, common = _lengths(first, start, pattern, owner, left, owner[at[s]], k)
            others = kept[begins[s]:begins[s] + k * width] if s < t - 1 else columns.ravel()
            _multiply_ends(others, width, columns, common, product[s])
    return columns


@compiled
def _along(first, way, where, values):
    """Return the values on a way to the root, and how many numbers each supernode has left."""
    k, width = len(values), np.int64(0)
    left = np.zeros(len(first) - 1, np.int64)
    for s in way:
        width += (first[s + 1] - first[s]) * k
        left[s] = width
    columns = np.empty((k, width))
    for s in way:
        own, begin = where[first[s]] * k, width - left[s]
        for q in range(k):
            for c in range((first[s + 1] - first[s]) * k):
                columns[q, begin + c] = values[q, own + c]
    return columns, left


@compiled
def _lengths(first, start, pattern, owner, left, s, k):
    """Return how long the way of a supernode is, and what it has in common with another one."""
    below = 0
    while s >= 0 and left[s] == 0:
        below += (first[s + 1] - first[s]) * k
        s = _parent(first, start, pattern, owner, s)
    common = left[s] if s >= 0 else 0
    return below + common, common


@compiled
def _multiply_ends(others, width, columns, common, product):
    """Write the products of the ends of columns, (k, width) one after the other, and (k, w)."""
    k, begin = len(columns), columns.shape[1] - common
    for a in range(k):
        line = others[(a + 1) * width - common:(a + 1) * width]
        for b in range(0, k, 3):
            product[a, b], product[a, b + 1], product[a, b + 2] = _dot_three(
                line, common, columns[b, begin:], columns[b + 1, begin:], columns[b + 2, begin:])


@compiled
def _ways(first, start, pattern, owner, at, ways):
    """
    Write the supernodes on the ways from some positions, -1 for none, to the root, and count them.

    Each comes after the one above it.
    """
    seen, count = np.zeros(len(first) - 1, np.bool_), 0
    for p in range(len(at)):
        low, s = count, np.int64(owner[at[p]] if at[p] >= 0 else -1)
        while s >= 0 and not seen[s]:
            seen[s], ways[count] = True, s
            count += 1
            s = _parent(first, start, pattern, owner, s)
        high = count - 1
        while low < high:
            ways[low], ways[high] = ways[high], ways[low]
            low, high = low + 1, high - 1
    return count


@compiled
def _parent(first, start, pattern, owner, s):
    """Return the supernode above another in the elimination tree, -1: it is a root."""
    below = start[s] + first[s + 1] - first[s]
    return np.int64(owner[pattern[below]] if below < start[s + 1] else -1)


@compiled
def _climb_panel(panel, stride, rows, columns, skip, where, values, own):
    """Solve for a supernode's own rows, the first `skip` of which are zero, and go below."""
    k = len(values)
    width, none = columns * k, skip * k
    # Three columns at a time (k is 3 or 6): what takes the time is reading the panel.
    for q in range(0, k, 3):
        x, y, z = values[q, own:], values[q + 1, own:], values[q + 2, own:]
        for r in range(none, width):
            line = panel[r * stride + none:r * stride + width]
            of_x, of_y, of_z = _dot_three(line, r - none, x, y, z)
            pivot = line[r - none]
            x[r - none] = (x[r - none] - of_x) / pivot
            y[r - none] = (y[r - none] - of_y) / pivot
            z[r - none] = (z[r - none] - of_z) / pivot
        for b in range(columns, len(rows)):
            target = where[rows[b]] * k
            for a in range(k):
                begin = (b * k + a) * stride
                line = panel[begin + none:begin + width]
                of_x, of_y, of_z = _dot_three(line, width - none, x, y, z)
                values[q, target + a] -= of_x
                values[q + 1, target + a] -= of_y
                values[q + 2, target + a] -= of_z


@compiled
def _descend_panel(panel, stride, rows, columns, where, values, own):
    """Solve with the transpose for a supernode's own rows, once all above it are known."""
    k, width = len(values), columns * len(values)
    for q in range(0, k, 3):
        x, y, z = (values[q, own:own + width], values[q + 1, own:own + width],
                   values[q + 2, own:own + width])
        for b in range(columns, len(rows)):
            for a in range(k):
                begin, target = (b * k + a) * stride, where[rows[b]] * k + a
                of_x, of_y, of_z = values[q, target], values[q + 1, target], values[q + 2, target]
                _subtract_three(panel[begin:begin + width], width, of_x, of_y, of_z, x, y, z)
        for r in range(width - 1, -1, -1):
            line = panel[r * stride:r * stride + r + 1]
            x[r] /= line[r]
            y[r] /= line[r]
            z[r] /= line[r]
            _subtract_three(line, r, x[r], y[r], z[r], x, y, z)


@compiled
def _subtract_three(line, length, of_x, of_y, of_z, x, y, z):
    """Subtract multiples of a line from x, y and z."""
    for c in range(length):
        value = line[c]
        x[c] -= of_x * value
        y[c] -= of_y * value
        z[c] -= of_z * value


@compiled
def _dot_three(line, length, x, y, z):
    """Return the products of a line with x, y and z."""
    of_x = of_y = of_z = 0.0
    for c in range(length):
        value = line[c]
        of_x += value * x[c]
        of_y += value * y[c]
        of_z += value * z[c]
    return of_x, of_y, of_z


@loop('(f8[:, :, ::1], i8, f8[:, ::1], f8[:, ::1], f8[:, :, ::1])', brief=True)
def follow(covariance, parent, turn, noise, product):
    """Write the covariances of all points with a new one that hangs on `parent`, (t, k, k)."""
    last, k = len(product) - 1, len(turn)
    moved = np.zeros((k, k))
    for s in range(last):
        if parent >= 0:
            _multiply(turn, _between(covariance, parent, s), moved)
        for r in range(k):
            for c in range(k):
                product[s, r, c] = moved[c, r]
    if parent >= 0:
        _multiply(turn, product[parent], moved)
    for r in range(k):
        for c in range(k):
            product[last, r, c] = noise[r, c] + moved[r, c]


@compiled
def _between(covariance, s, t):
    """Return the covariance of points s and t, (k, k)."""
    return covariance[t * (t + 1) // 2 + s] if s <= t else covariance[s * (s + 1) // 2 + t].T


@compiled
def _multiply(left, right, product):
    k = len(left)
    for r in range(k):
        for c in range(k):
            total = 0.0
            for e in range(k):
                total += left[r, e] * right[e, c]
            product[r, c] = total


@loop('(f8[:, :, ::1], f8[:, ::1], i8[:, ::1], f8[:, :, :, ::1], f8[::1], f8[::1], i8[::1], '
      'f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[::1])', brief=True)
def predict(covariance, mean, ends, blocks, factor, right, own_ends, own_blocks, rows, said,
            expected):
    """
    Write the rows of a factor, reduced by those before, (k, n), and what is said of J x.

    Its covariance, (k, k), and its mean is added to what is expected, (k,).

    covariance, mean : of points; ends, blocks : (b, 2) and (b, 2, k, k) of the factors so far,
    points, -1 for none; own_ends, own_blocks : the same of this one; factor, right : F and F^-1
    times the right hand side
    """
    k = len(rows)
    rows[:] = 0.0
    said[:] = 0.0
    for side in range(2):
        end, own = own_ends[side], own_blocks[side]
        if end < 0:
            continue
        for b in range(len(ends)):
            for other in range(2):
                if ends[b, other] >= 0:
                    _add_product(own, _between(covariance, end, ends[b, other]),
                                 blocks[b, other], rows, b * k)
        for other in range(2):
            if own_ends[other] >= 0:
                _add_product(own, _between(covariance, end, own_ends[other]),
                             own_blocks[other], said, 0)
        for r in range(k):
            for c in range(k):
                expected[r] += own[r, c] * mean[end, c]
    _reduce(factor, rows)
    for r in range(k):
        for e in range(rows.shape[1]):
            expected[r] += rows[r, e] * right[e]
        for c in range(r + 1):
            total = (said[r, c] + said[c, r]) / 2
            for e in range(rows.shape[1]):
                total -= rows[r, e] * rows[c, e]
            said[r, c] = said[c, r] = total


@compiled
def _add_product(left, middle, right, out, at):
    """Add left middle right', (k, k) each, to columns of out, (k, n), from `at` on."""
    k = len(left)
    for r in range(k):
        for e in range(k):
            total = 0.0
            for c in range(k):
                total += left[r, c] * middle[c, e]
            for c in range(k):
                out[r, at + c] += total * right[c, e]


@compiled
def _reduce(factor, rows):
    """Turn rows (m, n) into rows F^-T in place."""
    for r in range(rows.shape[1]):
        line = factor[r * (r + 1) // 2:(r + 1) * (r + 2) // 2]
        for q in range(len(rows)):
            row = rows[q]
            total = row[r]
            for c in range(r):
                total -= line[c] * row[c]
            row[r] = total / line[r]


@loop('(f8[::1], f8[::1], i8[:, ::1], f8[:, :, :, ::1], f8[:, ::1])', brief=True)
def pull(factor, right, ends, blocks, gradient):
    """Add to the gradient (t, k) what factors pull at points: A'lambda, F'lambda = right."""
    t, k = gradient.shape
    x = right.copy()
    for r in range(len(x) - 1, -1, -1):
        line = factor[r * (r + 1) // 2:(r + 1) * (r + 2) // 2]
        x[r] /= line[r]
        value = x[r]
        for c in range(r):
            x[c] -= line[c] * value
    for b in range(len(ends)):
        for side in range(2):
            end = ends[b, side]
            if end >= 0:
                for r in range(k):
                    for c in range(k):
                        gradient[end, c] += blocks[b, side, r, c] * x[b * k + r]


@loop('(f8[:, :, ::1], f8[:, ::1], f8[:, ::1], i8[::1])', brief=True)
def move(covariance, mean, gradient, points):
    """Return the steps of some points, (m, k), -1 for none, by what pulls at all of them."""
    t, k = gradient.shape
    steps = np.zeros((len(points), k))
    for m in range(len(points)):
        if points[m] < 0:
            continue
        for r in range(k):
            steps[m, r] = mean[points[m], r]
        for other in range(t):
            between = _between(covariance, points[m], other)
            for r in range(k):
                for c in range(k):
                    steps[m, r] += between[r, c] * gradient[other, c]
    return steps
