# SPDX-License-Identifier: Apache-2.0
"""
Many steps of all keyframes at once, and what they say of each factor.

Arrays of steps are (n, k, q): q samples of the k numbers of each of n keyframes, the last keyframe
standing for all that are held fixed; k is 3 or 6, and the work is done in tiles of 3 x 3. Other
arrays are those of `LinearSystem` and of `cholesky`.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop


@loop('(i8[:, ::1], f8[:, :, :, ::1], i1[:, :, ::1], f8[:, :, ::1])')
def gather(keyframe, blocks, y, product):
    """Add A'y of all samples to product (n + 1, k, q); y : (m, k, q) whole numbers."""
    k, q = product.shape[1:]
    z = np.empty((k, q))
    for f in range(len(blocks)):
        z[:] = y[f]
        for side in range(2):
            J, to = blocks[f, side], product[keyframe[f, side]]
            for c in range(0, k, 3):
                for r in range(0, k, 3):
                    _add(z, r, J[r:r + 3, c:c + 3].T, 1.0, to, c)


@loop('(f8[::1], i4[::1], i8[::1], i4[::1], i8[::1], i4[::1], f8[:, :, ::1])')
def solve_many(panels, first, start, pattern, offset, position, right):
    """Turn right hand sides, (n, k, q) in the order of the keyframes, into L'^-1 L^-1 right."""
    n, k, q = right.shape
    x, row = right.reshape(n * k, q), np.empty(n, np.int64)
    for f in range(n):
        row[position[f]] = f * k
    for s in range(len(first) - 1):
        panel, rows = _panel(panels, first, start, pattern, offset, s, k)
        for c in range(0, panel.shape[1], 3):
            own = row[first[s] + c // k] + c % k
            _solve_three(panel[c:c + 3, c:c + 3], x, own)
            for r in range(c + 3, len(panel), 3):
                _add(x, own, panel[r:r + 3, c:c + 3], -1.0, x, row[rows[r // k]] + r % k)
    for s in range(len(first) - 2, -1, -1):
        panel, rows = _panel(panels, first, start, pattern, offset, s, k)
        for c in range(panel.shape[1] - 3, -1, -3):
            own = row[first[s] + c // k] + c % k
            for r in range(c + 3, len(panel), 3):
                _add(x, row[rows[r // k]] + r % k, panel[r:r + 3, c:c + 3].T, -1.0, x, own)
            _solve_three_transposed(panel[c:c + 3, c:c + 3], x, own)


@compiled
def _panel(panels, first, start, pattern, offset, s, k):
    """Return panel s as a matrix, and its rows."""
    width = (first[s + 1] - first[s]) * k
    return panels[offset[s]:offset[s + 1]].reshape(-1, width), pattern[start[s]:start[s + 1]]


@compiled
def _add(x, at, F, sign, y, to):
    """Add sign F times three rows of x to three rows of y, F (3, 3)."""
    a, b, c = sign * F[0, 0], sign * F[0, 1], sign * F[0, 2]
    d, e, f = sign * F[1, 0], sign * F[1, 1], sign * F[1, 2]
    g, h, i = sign * F[2, 0], sign * F[2, 1], sign * F[2, 2]
    for t in range(x.shape[1]):
        u, v, w = x[at, t], x[at + 1, t], x[at + 2, t]
        y[to, t] += a * u + b * v + c * w
        y[to + 1, t] += d * u + e * v + f * w
        y[to + 2, t] += g * u + h * v + i * w


@compiled
def _solve_three(L, x, at):
    """Solve L y = three rows of x, in place."""
    for t in range(x.shape[1]):
        x[at, t] /= L[0, 0]
        x[at + 1, t] = (x[at + 1, t] - L[1, 0] * x[at, t]) / L[1, 1]
        x[at + 2, t] = (x[at + 2, t] - L[2, 0] * x[at, t] - L[2, 1] * x[at + 1, t]) / L[2, 2]


@compiled
def _solve_three_transposed(L, x, at):
    """Solve L'y = three rows of x, in place."""
    for t in range(x.shape[1]):
        x[at + 2, t] /= L[2, 2]
        x[at + 1, t] = (x[at + 1, t] - L[2, 1] * x[at + 2, t]) / L[1, 1]
        x[at, t] = (x[at, t] - L[1, 0] * x[at + 1, t] - L[2, 0] * x[at + 2, t]) / L[0, 0]


@loop('(i8[:, ::1], f8[:, :, :, ::1], f8[:, :, ::1], i1[:, :, ::1])')
def left_over(keyframe, blocks, x, y):
    """
    Return the second moment of y - A x for each factor, (m, k, k).

    y : as of `gather`, of the first factors; zero of the others
    """
    k, q = x.shape[1:]
    moment, d = np.empty((len(blocks), k, k)), np.empty((k, q))
    for f in range(len(blocks)):
        d[:] = 0.0
        if f < len(y):
            d[:] = y[f]
        _add_moved(blocks[f], x[keyframe[f, 0]], x[keyframe[f, 1]], -1.0, d)
        for r in range(k):
            for c in range(r + 1):
                total = 0.0
                for t in range(q):
                    total += d[r, t] * d[c, t]
                moment[f, r, c] = moment[f, c, r] = total / q
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
    for r in range(0, len(d), 3):
        for c in range(0, len(d), 3):
            _add(x_i, c, pair[0, r:r + 3, c:c + 3], sign, d, r)
            _add(x_j, c, pair[1, r:r + 3, c:c + 3], sign, d, r)


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
