# SPDX-License-Identifier: Apache-2.0
"""
What comes after a factorisation: covariances by climbs, and a small dense factor that grows.

The arrays of the sparse factor are those of `cholesky`. A climb is L^-1 e_p for the k columns of
one keyframe p: it is zero but on the way from p to the root of the elimination tree. Climbs are
kept one after the other: the positions on the way, ascending, and the columns, each in one run.
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
    for r in range(none, width):
        line = panel[r * width:(r + 1) * width]
        for q in range(k):
            x = values[q, own:]
            total = x[r - none]
            for c in range(none, r):
                total -= line[c] * x[c - none]
            x[r - none] = total / line[r]
    for b in range(columns, len(rows)):
        target = where[rows[b]] * k
        for a in range(k):
            line = panel[(b * k + a) * width + none:(b * k + a + 1) * width]
            for q in range(k):
                x = values[q, own:own + width - none]
                total = 0.0
                for c in range(len(line)):
                    total += line[c] * x[c]
                values[q, target + a] -= total


@loop('(i8[::1], i4[::1], f8[::1], i8, f8[:, :, ::1])')
def meet(begin, places, values, k, product):
    """
    Write the blocks of H^-1 between the last keyframe climbed from and each, (t, k, k).

    begin : (t + 1,) of each climb in `places`; its columns begin at values[begin k^2]
    """
    t = len(begin) - 1
    own_end, own = begin[t], begin[t - 1]
    for s in range(t):
        end, common = begin[s + 1], 0
        most = min(end - begin[s], own_end - own)
        # What two ways have in common is their end.
        while common < most and places[end - 1 - common] == places[own_end - 1 - common]:
            common += 1
        length, own_length = (end - begin[s]) * k, (own_end - own) * k
        for a in range(k):
            stop = begin[s] * k * k + (a + 1) * length
            left = values[stop - common * k:stop]
            for b in range(k):
                stop = own * k * k + (b + 1) * own_length
                right = values[stop - common * k:stop]
                total = 0.0
                for r in range(len(left)):
                    total += left[r] * right[r]
                product[s, a, b] = total


@loop('(f8[:, :, :, ::1], i8[:, ::1], f8[:, :, :, ::1], i8[::1], f8[:, :, ::1], f8[:, ::1])')
def couple(covariance, ends, blocks, own_ends, own_blocks, rows):
    """
    Write what joins a factor with the rows of the border so far to rows (k, k b).

    covariance : (t, t, k, k) of the keyframes that are touched; ends, blocks : (b, 2) and
    (b, 2, k, k) of each row of blocks: a factor's touched keyframes, -1 for none; own_ends : the
    same, -2 - b for the border's own keyframe at b
    """
    k = len(rows)
    for b in range(len(ends)):
        out = rows[:, b * k:(b + 1) * k]
        for r in range(k):
            for c in range(k):
                out[r, c] = 0.0
        for side in range(2):
            if own_ends[side] == -2 - b:
                for r in range(k):
                    for c in range(k):
                        out[r, c] += own_blocks[side, r, c]
            if own_ends[side] < 0:
                continue
            for other in range(2):
                if ends[b, other] >= 0:
                    _add_product(own_blocks[side], covariance[own_ends[side], ends[b, other]],
                                 blocks[b, other], out)


@compiled
def _add_product(left, middle, right, out):
    """Subtract left middle right' from out, (k, k) each."""
    k = len(left)
    for r in range(k):
        for e in range(k):
            total = 0.0
            for c in range(k):
                total += left[r, c] * middle[c, e]
            for c in range(k):
                out[r, c] -= total * right[c, e]


@loop('(f8[:, ::1], f8[:, ::1], i8)')
def reduce(factor, rows, begin):
    """Turn rows (m, n) into rows F^-T in place; what is before column `begin` is zero."""
    for r in range(begin, rows.shape[1]):
        line = factor[r]
        for q in range(len(rows)):
            row = rows[q]
            total = row[r]
            for c in range(begin, r):
                total -= line[c] * row[c]
            row[r] = total / line[r]


@loop('(f8[:, ::1], f8[::1])')
def back_substitute(factor, x):
    """Turn x (n,) into F^-T x in place; factor : F, lower triangular, (n, n) or larger."""
    for r in range(len(x) - 1, -1, -1):
        line = factor[r]
        x[r] /= line[r]
        value = x[r]
        for c in range(r):
            x[c] -= line[c] * value
