# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Sampled steps of all keyframes at once, and the innovations of factors that they predict.

Arrays of steps are (n, k, q): q = `SAMPLES` of the k numbers of each of n keyframes, the last
keyframe standing for all that are held fixed; k is 3 or 6, and the work is done in tiles of 3 x 3.
Other arrays are those of `LinearSystem` and of `cholesky`.

Steps are passed on as flat arrays, and q is a constant: only so does the compiler know that rows
do not overlap, and works on as many numbers at once as fit a register.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop

# Standard deviations of so many samples are right to 10% (1 / sqrt(2 q)), and of two factors
# together there are far more samples than rows.
SAMPLES = 48
# What is left of a covariance where this part of it was subtracted but rounding.
_DEFINITE = 1e-14


@loop('(i8[:, ::1], f8[:, :, :, ::1], i1[:, :, ::1], f8[:, :, ::1])')
def gather(keyframe, blocks, y, product):
    """Add A'y of all samples to product (n + 1, k, q); y : (m, k, q) whole numbers."""
    k, to = product.shape[1], product.ravel()
    z = np.empty(k * SAMPLES)
    for f in range(len(blocks)):
        _write_sample(y[f], z)
        for side in range(2):
            J, at = blocks[f, side], keyframe[f, side] * k
            for c in range(0, k, 3):
                for r in range(0, k, 3):
                    _add(z, r, J[r:r + 3, c:c + 3].T, 1.0, to, at + c)


@compiled
def _write_sample(y, z):
    """Write whole numbers, (k, q), as doubles, (k q,)."""
    for r in range(len(y)):
        for t in range(SAMPLES):
            z[r * SAMPLES + t] = y[r, t]


@loop('(f8[::1], i4[::1], i8[::1], i4[::1], i8[::1], i8[::1], i4[::1], f8[:, :, ::1])')
def solve_many(panels, first, start, pattern, offset, stride, position, right):
    """Turn right hand sides, (n, k, q) in the order of the keyframes, into L'^-1 L^-1 right."""
    n, k, _ = right.shape
    x, row = right.ravel(), np.empty(n, np.int64)
    for f in range(n):
        row[position[f]] = f * k
    for s in range(len(first) - 1):
        panel, rows = _panel(panels, first, start, pattern, offset, stride, s, k)
        for c in range(0, panel.shape[1], 3):
            own = row[first[s] + c // k] + c % k
            _solve_three(panel[c:c + 3, c:c + 3], x, own)
            for r in range(c + 3, len(panel), 3):
                _add(x, own, panel[r:r + 3, c:c + 3], -1.0, x, row[rows[r // k]] + r % k)
    for s in range(len(first) - 2, -1, -1):
        panel, rows = _panel(panels, first, start, pattern, offset, stride, s, k)
        for c in range(panel.shape[1] - 3, -1, -3):
            own = row[first[s] + c // k] + c % k
            for r in range(c + 3, len(panel), 3):
                _add(x, row[rows[r // k]] + r % k, panel[r:r + 3, c:c + 3].T, -1.0, x, own)
            _solve_three_transposed(panel[c:c + 3, c:c + 3], x, own)


@compiled
def _panel(panels, first, start, pattern, offset, stride, s, k):
    """Return panel s as a matrix, and its rows."""
    rows, width = pattern[start[s]:start[s + 1]], (first[s + 1] - first[s]) * k
    panel = panels[offset[s]:offset[s] + len(rows) * k * stride[s]].reshape(-1, stride[s])
    return panel[:, :width], rows


@compiled
def _add(x, at, F, sign, y, to):
    """Add sign F times three rows of x to three rows of y, F (3, 3)."""
    u, z = x[at * SAMPLES:(at + 3) * SAMPLES], y[to * SAMPLES:(to + 3) * SAMPLES]
    a, b, c = sign * F[0, 0], sign * F[0, 1], sign * F[0, 2]
    d, e, f = sign * F[1, 0], sign * F[1, 1], sign * F[1, 2]
    g, h, i = sign * F[2, 0], sign * F[2, 1], sign * F[2, 2]
    for t in range(SAMPLES):
        p, q, r = u[t], u[SAMPLES + t], u[2 * SAMPLES + t]
        z[t] += a * p + b * q + c * r
        z[SAMPLES + t] += d * p + e * q + f * r
        z[2 * SAMPLES + t] += g * p + h * q + i * r


@compiled
def _solve_three(L, x, at):
    """Solve L y = three rows of x, in place."""
    x = x[at * SAMPLES:(at + 3) * SAMPLES]
    a, b, c, d, e, f = 1 / L[0, 0], L[1, 0], 1 / L[1, 1], L[2, 0], L[2, 1], 1 / L[2, 2]
    for t in range(SAMPLES):
        u = x[t] * a
        v = (x[SAMPLES + t] - b * u) * c
        x[2 * SAMPLES + t] = (x[2 * SAMPLES + t] - d * u - e * v) * f
        x[t], x[SAMPLES + t] = u, v


@compiled
def _solve_three_transposed(L, x, at):
    """Solve L'y = three rows of x, in place."""
    x = x[at * SAMPLES:(at + 3) * SAMPLES]
    a, b, c, d, e, f = 1 / L[0, 0], L[1, 0], 1 / L[1, 1], L[2, 0], L[2, 1], 1 / L[2, 2]
    for t in range(SAMPLES):
        w = x[2 * SAMPLES + t] * f
        v = (x[SAMPLES + t] - e * w) * c
        x[t] = (x[t] - b * v - d * w) * a
        x[SAMPLES + t], x[2 * SAMPLES + t] = v, w


@loop('(i8[:, ::1], f8[:, :, :, ::1], f8[:, :, ::1], i1[:, :, ::1])')
def left_over(keyframe, blocks, x, y):
    """
    Return the second moment of y - A x for each factor, (m, k, k).

    y : as of `gather`, of the first factors; zero of the others; a row of A may have a block of
    any number of keyframes
    """
    k, steps = x.shape[1], x.ravel()
    moment, d = np.empty((len(blocks), k, k)), np.empty(k * SAMPLES)
    for f in range(len(blocks)):
        if f < len(y):
            _write_sample(y[f], d)
        else:
            d[:] = 0.0
        _add_moved(keyframe[f], blocks[f], steps, -1.0, d, 0)
        for r in range(k):
            one = d[r * SAMPLES:(r + 1) * SAMPLES]
            for c in range(r + 1):
                other, total = d[c * SAMPLES:(c + 1) * SAMPLES], 0.0
                for t in range(SAMPLES):
                    total += one[t] * other[t]
                moment[f, r, c] = moment[f, c, r] = total / SAMPLES
    return moment


@loop('(i8[:, ::1], f8[:, :, :, ::1], f8[:, :, ::1])')
def moved(keyframe, blocks, x):
    """Return A x of each factor and sample, (m, k, q)."""
    k = x.shape[1]
    steps = x.ravel()
    d = np.zeros((len(blocks), x.shape[1], SAMPLES))
    product = d.ravel()
    for f in range(len(blocks)):
        _add_moved(keyframe[f], blocks[f], steps, 1.0, product, f * k)
    return d


@compiled
def _add_moved(keyframe, J, x, sign, d, to):
    """Add sign times the sum of J x of one factor to the k rows of d from row `to` on."""
    k = J.shape[1]
    for side in range(len(J)):
        for r in range(0, k, 3):
            for c in range(0, k, 3):
                _add(x, keyframe[side] * k + c, J[side, r:r + 3, c:c + 3], sign, d, to + r)


@compiled
def _normalised(C, whole, residual, u):
    """
    Turn C (k, k) into its Cholesky factor L; return r'C^-1 r and ln det C, and u = L^-1 r.

    whole : (k,) the diagonal of which a pivot is a part
    """
    square = log_det = 0.0
    for r in range(len(C)):
        for c in range(r):
            value = C[r, c]
            for e in range(c):
                value -= C[r, e] * C[c, e]
            C[r, c] = value / C[c, c]
        value, total = C[r, r], residual[r]
        for e in range(r):
            value -= C[r, e] ** 2
            total -= C[r, e] * u[e]
        if not value > _DEFINITE * whole[r]:
            return np.inf, -np.inf
        C[r, r] = np.sqrt(value)
        u[r] = total / C[r, r]
        square += u[r] ** 2
        log_det += 2 * np.log(C[r, r])
    return square, log_det


@loop('(f8[:, :, ::1], f8[:, ::1])')
def normalise(covariance, residual):
    """
    Return r'C^-1 r and ln det C of each factor, (m,); C (m, k, k) is overwritten.

    Cholesky; where C is not definite beyond rounding, infinity and minus infinity.
    """
    m, k = residual.shape
    square = np.empty(m)
    log_det = np.empty(m)
    u = np.empty(k)
    whole = np.empty(k)
    for f in range(m):
        for r in range(k):
            whole[r] = covariance[f, r, r]
        square[f], log_det[f] = _normalised(covariance[f], whole, residual[f], u)
    return square, log_det


@loop('(f8[:, :, ::1], f8[:, ::1], f8[:, ::1], i8[::1], i8[::1])')
def normalise_pairs(covariance, residual, shared, first, second):
    """
    Return what `normalise` does, of pairs of factors together, (pairs,) each.

    covariance : (m, k, k) of each; shared : (m k, m k) of all with all, what is read of it are
    the blocks of first and second ones
    """
    m, k = residual.shape
    square, log_det = np.empty(len(first)), np.empty(len(first))
    own = np.empty(m)
    logs = np.empty(m)
    u = np.empty((m, k))
    factor, whole = np.empty(covariance.shape), np.empty((m, k))
    for f in range(m):
        for r in range(k):
            whole[f, r] = covariance[f, r, r]
            for c in range(k):
                factor[f, r, c] = covariance[f, r, c]
        own[f], logs[f] = _normalised(factor[f], whole[f], residual[f], u[f])
    # Of the second one what the first one does not explain.
    W = np.empty((k, k))
    C = np.empty((k, k))
    left = np.empty(k)
    unused = np.empty(k)
    for pair in range(len(first)):
        a, b = first[pair], second[pair]
        for c in range(k):
            left[c] = residual[b, c]
            for r in range(k):
                value = shared[a * k + r, b * k + c]
                for e in range(r):
                    value -= factor[a, r, e] * W[c, e]
                W[c, r] = value / factor[a, r, r]
                left[c] -= W[c, r] * u[a, r]
            for r in range(c + 1):
                value = covariance[b, c, r]
                for e in range(k):
                    value -= W[c, e] * W[r, e]
                C[c, r] = value
        more, log = _normalised(C, whole[b], left, unused)
        square[pair], log_det[pair] = own[a] + more, logs[a] + log
    return square, log_det
