# SPDX-License-Identifier: Apache-2.0
"""
Many steps of all keyframes at once, and what they say of each factor.

Arrays of steps are (n, k, q): q samples of the k numbers of each of n keyframes, the last keyframe
standing for all that are held fixed. Other arrays are those of `LinearSystem` and of
`cholesky`.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop


@loop('(i8[:, ::1], f8[:, :, :, ::1], f8[:, :, ::1], f8[:, :, ::1])')
def gather(keyframe, blocks, y, product):
    """Add A'y of all samples to product (n + 1, k, q); y : (m, k, q)."""
    k, q = product.shape[1:]
    for f in range(len(blocks)):
        for side in range(2):
            at = product[keyframe[f, side]]
            for c in range(k):
                for r in range(k):
                    value = blocks[f, side, r, c]
                    for t in range(q):
                        at[c, t] += value * y[f, r, t]


@loop('(f8[::1], i4[::1], i8[::1], i4[::1], i8[::1], i4[::1], f8[:, :, ::1])')
def solve_many(panels, first, start, pattern, offset, position, right):
    """Return the solutions of L L' x = right, (n, k, q) in the order of the keyframes."""
    n, k, q = right.shape
    x = np.empty((n * k, q))
    for f in range(n):
        for a in range(k):
            _copy(right[f, a], x[position[f] * k + a])
    for s in range(len(first) - 1):
        width, own = (first[s + 1] - first[s]) * k, x[first[s] * k:first[s + 1] * k]
        at = offset[s]
        for c in range(width):
            for e in range(c):
                _subtract(own[c], panels[at + e], own[e])
            _divide(own[c], panels[at + c])
            at += width
        for below in range(start[s] + width // k, start[s + 1]):
            for a in range(k):
                for c in range(width):
                    _subtract(x[pattern[below] * k + a], panels[at + c], own[c])
                at += width
    for s in range(len(first) - 2, -1, -1):
        width, own = (first[s + 1] - first[s]) * k, x[first[s] * k:first[s + 1] * k]
        at = offset[s] + width * width
        for below in range(start[s] + width // k, start[s + 1]):
            for a in range(k):
                for c in range(width):
                    _subtract(own[c], panels[at + c], x[pattern[below] * k + a])
                at += width
        for c in range(width - 1, -1, -1):
            at = offset[s] + c * width
            _divide(own[c], panels[at + c])
            for e in range(c):
                _subtract(own[e], panels[at + e], own[c])
    solution = np.empty((n, k, q))
    for f in range(n):
        for a in range(k):
            _copy(x[position[f] * k + a], solution[f, a])
    return solution


@compiled
def _copy(row, to):
    for t in range(len(row)):
        to[t] = row[t]


@compiled
def _divide(row, by):
    for t in range(len(row)):
        row[t] /= by


@compiled
def _subtract(row, factor, other):
    for t in range(len(row)):
        row[t] -= factor * other[t]


@loop('(i8[:, ::1], f8[:, :, :, ::1], f8[:, :, ::1], f8[:, :, ::1])')
def left_over(keyframe, blocks, x, y):
    """Return the second moment of y - A x for each factor, (m, k, k); y : (m, k, q)."""
    k, q = x.shape[1:]
    moment, d = np.empty((len(blocks), k, k)), np.empty((k, q))
    for f in range(len(blocks)):
        for r in range(k):
            for t in range(q):
                d[r, t] = y[f, r, t]
        _add_moved(blocks[f], x[keyframe[f, 0]], x[keyframe[f, 1]], -1.0, d)
        _second_moment(d, moment[f])
    return moment


@loop('(i8[:, ::1], f8[:, :, :, ::1], f8[:, :, ::1])')
def spreads(keyframe, blocks, x):
    """Return the second moment of A x for each factor, (m, k, k)."""
    k, q = x.shape[1:]
    moment, d = np.empty((len(blocks), k, k)), np.empty((k, q))
    for f in range(len(blocks)):
        for r in range(k):
            for t in range(q):
                d[r, t] = 0.0
        _add_moved(blocks[f], x[keyframe[f, 0]], x[keyframe[f, 1]], 1.0, d)
        _second_moment(d, moment[f])
    return moment


@loop('(i8[:, ::1], f8[:, :, :, ::1], f8[:, :, ::1])')
def moved(keyframe, blocks, x):
    """Return A x of each factor and sample, (m, k, q)."""
    d = np.zeros((len(blocks), *x.shape[1:]))
    for f in range(len(blocks)):
        _add_moved(blocks[f], x[keyframe[f, 0]], x[keyframe[f, 1]], 1.0, d[f])
    return d


@compiled
def _add_moved(pair, x_i, x_j, sign, d):
    """Add sign (J_i x_i + J_j x_j) of one factor to d (k, q)."""
    for r in range(len(d)):
        for c in range(len(d)):
            _subtract(d[r], -sign * pair[0, r, c], x_i[c])
            _subtract(d[r], -sign * pair[1, r, c], x_j[c])


@compiled
def _second_moment(d, moment):
    for r in range(len(d)):
        for c in range(r + 1):
            total = 0.0
            for t in range(d.shape[1]):
                total += d[r, t] * d[c, t]
            moment[r, c] = moment[c, r] = total / d.shape[1]


@loop('(f8[:, :, ::1], f8[:, ::1])')
def normalise(covariance, residual):
    """
    Return r'C^-1 r and ln det C of each factor, (m,); C (m, k, k) is overwritten.

    Cholesky; where C is not definite beyond rounding, infinity and minus infinity.
    """
    m, k = residual.shape
    square, log_det, u = np.empty(m), np.empty(m), np.empty(k)
    for f in range(m):
        C = covariance[f]
        square[f] = log_det[f] = 0.0
        for r in range(k):
            least = 1e-14 * C[r, r]
            for c in range(r):
                value = C[r, c]
                for e in range(c):
                    value -= C[r, e] * C[c, e]
                C[r, c] = value / C[c, c]
            value, total = C[r, r], residual[f, r]
            for e in range(r):
                value -= C[r, e] ** 2
                total -= C[r, e] * u[e]
            if not value > least:
                square[f], log_det[f] = np.inf, -np.inf
                break
            C[r, r] = np.sqrt(value)
            u[r] = total / C[r, r]
            square[f] += u[r] ** 2
            log_det[f] += 2 * np.log(C[r, r])
    return square, log_det
