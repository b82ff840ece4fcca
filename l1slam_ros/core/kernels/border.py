# SPDX-License-Identifier: Apache-2.0
"""
What comes after a factorisation: covariances by climbs, and a small dense factor that grows.

The arrays of the sparse factor are those of `cholesky`. A climb is L^-1 e_p for the k columns of
one keyframe p: it is zero but on the way from p to the root of the elimination tree. Climbs are
kept one after the other: the positions on the way, ascending, and the columns, each in one run.

Triangles are kept row after row, row r from r (r + 1) / 2 on, so that they grow at their end: that
of F, and the blocks of H^-1 between keyframes climbed from, the earlier first.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop


@loop('(f8[::1], i4[::1], i8[::1], i4[::1], i8[::1], i4[::1], i8, i8)')
def climb(panels, first, start, pattern, offset, owner, at, k):
    """
    Return the positions (p,) on the way from position `at` to the root, and L^-1 e_at there.

    owner : (n,) the supernode of each position. The columns are (k, p k), one after the other.
    """
    length, s = first[owner[at]] - at, owner[at]
    while s >= 0:
        length += first[s + 1] - first[s]
        s = _parent(first, start, pattern, owner, s)
    places, values = np.empty(length, np.int32), np.empty((k, length * k))
    # Where in `places` each position on the way is.
    where = np.empty(len(owner), np.int32)
    done, s, begin = 0, owner[at], at
    while s >= 0:
        for position in range(begin, first[s + 1]):
            places[done], where[position] = position, done
            done += 1
        s = _parent(first, start, pattern, owner, s)
        begin = first[s]
    for q in range(k):
        for r in range(length * k):
            values[q, r] = 0.0
        values[q, q] = 1.0
    done, s, begin = 0, owner[at], at
    while s >= 0:
        _climb_panel(panels[offset[s]:offset[s + 1]], pattern[start[s]:start[s + 1]],
                     first[s + 1] - first[s], begin - first[s], where, values, done * k)
        done += first[s + 1] - begin
        s = _parent(first, start, pattern, owner, s)
        begin = first[s]
    return places, values


@compiled
def _parent(first, start, pattern, owner, s):
    """Return the supernode above another in the elimination tree, -1: it is a root."""
    below = start[s] + first[s + 1] - first[s]
    return owner[pattern[below]] if below < start[s + 1] else -1


@compiled
def _climb_panel(panel, rows, columns, skip, where, values, own):
    """Solve for a supernode's own rows, the first `skip` of which are zero, and go below."""
    k = len(values)
    width, none = columns * k, skip * k
    # Three columns at a time (k is 3 or 6): what takes the time is reading the panel.
    for q in range(0, k, 3):
        x, y, z = values[q, own:], values[q + 1, own:], values[q + 2, own:]
        for r in range(none, width):
            line = panel[r * width + none:(r + 1) * width]
            of_x, of_y, of_z = _dot_three(line, r - none, x, y, z)
            pivot = line[r - none]
            x[r - none] = (x[r - none] - of_x) / pivot
            y[r - none] = (y[r - none] - of_y) / pivot
            z[r - none] = (z[r - none] - of_z) / pivot
        for b in range(columns, len(rows)):
            target = where[rows[b]] * k
            for a in range(k):
                line = panel[(b * k + a) * width + none:(b * k + a + 1) * width]
                of_x, of_y, of_z = _dot_three(line, width - none, x, y, z)
                values[q, target + a] -= of_x
                values[q + 1, target + a] -= of_y
                values[q + 2, target + a] -= of_z


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


@loop('(i8[::1], i4[::1], f8[::1], f8[:, :, ::1])')
def meet(begin, places, values, product):
    """
    Write the blocks of H^-1 between each keyframe and the last climbed from, (t, k, k).

    begin : (t + 1,) of each climb in `places`; its columns begin at values[begin k^2]
    """
    t, k = product.shape[:2]
    own_end, own = begin[t], begin[t - 1]
    own_length = (own_end - own) * k
    for s in range(t):
        end, common = begin[s + 1], 0
        most = min(end - begin[s], own_end - own)
        # What two ways have in common is their end.
        while common < most and places[end - 1 - common] == places[own_end - 1 - common]:
            common += 1
        length = (end - begin[s]) * k
        for a in range(k):
            stop = begin[s] * k * k + (a + 1) * length
            left = values[stop - common * k:stop]
            # Three at a time (k is 3 or 6): what takes the time is reading.
            for b in range(0, k, 3):
                stop = own * k * k + (b + 1) * own_length
                x = values[stop - common * k:stop]
                y = values[stop + own_length - common * k:stop + own_length]
                z = values[stop + 2 * own_length - common * k:stop + 2 * own_length]
                product[s, a, b], product[s, a, b + 1], product[s, a, b + 2] = _dot_three(
                    left, len(left), x, y, z)


@loop('(f8[:, :, ::1], i8[:, ::1], f8[:, :, :, ::1], f8[::1], f8[::1], f8[::1], i8[::1], '
      'f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[::1])')
def predict(covariance, ends, blocks, factor, signs, right, own_ends, own_blocks, rows, said,
            expected):
    """
    Write the rows of a factor, reduced by the border so far, (k, n), and what is said of J x.

    Its covariance, (k, k), and its mean is added to what is expected, (k,). Of the border:

    covariance : of the keyframes that are touched; ends, blocks : (b, 2) and (b, 2, k, k) of each
    row of blocks: a factor's touched keyframes, -1 for none; own_ends : the same, -2 - b for the
    border's own keyframe at b
    """
    k, begin = len(rows), len(ends)
    rows[:] = 0.0
    for side in range(2):
        end = own_ends[side]
        if end < -1:
            begin = min(begin, -2 - end)
            for r in range(k):
                for c in range(k):
                    rows[r, (-2 - end) * k + c] += own_blocks[side, r, c]
        elif end >= 0:
            begin = 0
            for b in range(len(ends)):
                for other in range(2):
                    if ends[b, other] >= 0:
                        _subtract_product(own_blocks[side], covariance, end, ends[b, other],
                                          blocks[b, other], rows[:, b * k:(b + 1) * k])
    _reduce(factor, rows, begin * k)
    for side in range(2):
        for other in range(2):
            if own_ends[side] >= 0 and own_ends[other] >= 0:
                _subtract_product(own_blocks[side], covariance, own_ends[side], own_ends[other],
                                  own_blocks[other], said)
    for r in range(k):
        for e in range(begin * k, rows.shape[1]):
            expected[r] += rows[r, e] * signs[e] * right[e]
        for c in range(r + 1):
            total = -(said[r, c] + said[c, r]) / 2
            for e in range(begin * k, rows.shape[1]):
                total += rows[r, e] * signs[e] * rows[c, e]
            said[r, c] = said[c, r] = total


@compiled
def _subtract_product(left, covariance, s, t, right, out):
    """Subtract left H^-1_st right' from out, (k, k) each."""
    k = len(left)
    middle = covariance[t * (t + 1) // 2 + s] if s <= t else covariance[s * (s + 1) // 2 + t].T
    for r in range(k):
        for e in range(k):
            total = 0.0
            for c in range(k):
                total += left[r, c] * middle[c, e]
            for c in range(k):
                out[r, c] -= total * right[c, e]


@compiled
def _reduce(factor, rows, begin):
    """Turn rows (m, n) into rows F^-T in place; what is before column `begin` is zero."""
    for r in range(begin, rows.shape[1]):
        line = factor[r * (r + 1) // 2:(r + 1) * (r + 2) // 2]
        for q in range(len(rows)):
            row = rows[q]
            total = row[r]
            for c in range(begin, r):
                total -= line[c] * row[c]
            row[r] = total / line[r]


@loop('(f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1])')
def append(signs, right, rows, pivot, residual, seen, lines, values):
    """
    Write the rows of F, and of F^-1 times the right hand side, of a factor and what it sees first.

    Parameters
    ----------
    signs, right : S and F^-1 times the right hand side, (n,) so far
    rows, pivot : (k, n), (k, k) of the factor, see `predict`, with its noise
    residual : (k,)
    seen : (k, k) the factor's block of the new keyframe, (0, 0): there is none

    Returns
    -------
    Whether it is definite beyond rounding.

    """
    k, n = rows.shape
    for r in range(k):
        line = lines[r * n + r * (r + 1) // 2:]
        values[r] = -residual[r]
        for c in range(n):
            line[c] = rows[r, c] * signs[c]
            values[r] -= line[c] * right[c]
    if not _take_root(lines, n, 0, pivot, values):
        return False
    if not len(seen):
        return True
    # The keyframe is joined to this factor alone: its rows are X = seen' R^-T, with signs -1.
    X = seen.T.copy()
    for c in range(k):
        root = lines[c * n + c * (c + 1) // 2 + n:]
        for r in range(k):
            for e in range(c):
                X[r, c] -= root[e] * X[r, e]
            X[r, c] /= root[c]
    square = np.zeros((k, k))
    for r in range(k):
        line = lines[(k + r) * n + (k + r) * (k + r + 1) // 2:]
        line[:n] = 0.0
        values[k + r] = 0.0
        for c in range(k):
            line[n + c] = -X[r, c]
            values[k + r] += X[r, c] * values[c]
            for e in range(k):
                square[r, c] += X[r, e] * X[c, e]
    return _take_root(lines, n, k, square, values)


@compiled
def _take_root(lines, n, begin, pivot, values):
    """Write the root of a pivot, (k, k), to the ends of lines; values become root^-1 values."""
    for r in range(len(pivot)):
        own = begin + r
        line = lines[own * n + own * (own + 1) // 2 + n + begin:]
        for c in range(r + 1):
            other = begin + c
            above = lines[other * n + other * (other + 1) // 2 + n + begin:]
            entry = pivot[r, c]
            for e in range(c):
                entry -= line[e] * above[e]
            if c < r:
                line[c] = entry / above[c]
                values[own] -= line[c] * values[other]
            elif entry > 0:
                line[c] = np.sqrt(entry)
                values[own] /= line[c]
            else:
                return False
    return True


@loop('(f8[::1], f8[::1], i8)')
def back_substitute(factor, x, begin):
    """Turn x (n,) into F^-T x in place, from row `begin` on."""
    for r in range(len(x) - 1, begin - 1, -1):
        line = factor[r * (r + 1) // 2:(r + 1) * (r + 2) // 2]
        x[r] /= line[r]
        value = x[r]
        for c in range(begin, r):
            x[c] -= line[c] * value


@loop('(i8[:, ::1], f8[:, :, :, ::1], f8[:, ::1], f8[:, ::1])')
def pull(ends, blocks, multipliers, gradient):
    """Add A'lambda to the gradient (t, k) at the keyframes that are touched."""
    t, k = gradient.shape
    for b in range(len(ends)):
        for side in range(2):
            end = ends[b, side]
            if end >= 0:
                for r in range(k):
                    for c in range(k):
                        gradient[end, c] += blocks[b, side, r, c] * multipliers[b, r]


@loop('(f8[:, :, ::1], f8[:, ::1], i8)')
def move(covariance, gradient, s):
    """Return the step of a touched keyframe, (k,), by what pulls at all of them."""
    t, k = gradient.shape
    step = np.zeros(k)
    for other in range(t):
        first, last = min(s, other), max(s, other)
        between = covariance[last * (last + 1) // 2 + first]
        for r in range(k):
            for c in range(k):
                step[r] -= (between[r, c] if s == first else between[c, r]) * gradient[other, c]
    return step
