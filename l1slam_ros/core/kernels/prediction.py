# SPDX-License-Identifier: Apache-2.0
"""
Many steps of all keyframes at once, and what they say of each factor.

Arrays of steps are (n, k, q): q samples of the k numbers of each of n keyframes. `size` is a tuple
of k zeros, see `blocks`; other arrays are those of `LinearSystem` and of `cholesky`.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled


@compiled
def gather(keyframe, blocks, y, product, size):
    """Add A'y of all samples to product (n + 1, k, q); y : (m, k, q)."""
    k, q = len(size), product.shape[2]
    for f in range(len(blocks)):
        for side in range(2):
            at = product[keyframe[f, side]]
            for c in range(k):
                for r in range(k):
                    value = blocks[f, side, r, c]
                    for t in range(q):
                        at[c, t] += value * y[f, r, t]


@compiled
def solve_many(panels, first, start, pattern, offset, position, right, size):
    """Return the solutions of L L' x = right, (n, k, q) in the order of the keyframes."""
    n, k, q = right.shape
    x = np.empty((n * k, q))
    for f in range(n):
        for a in range(k):
            x[position[f] * k + a] = right[f, a]
    for s in range(len(first) - 1):
        width, own = (first[s + 1] - first[s]) * k, x[first[s] * k:first[s + 1] * k]
        at = offset[s]
        for c in range(width):
            for e in range(c):
                _subtract(own[c], panels[at + e], own[e])
            own[c] /= panels[at + c]
            at += width
        for row in pattern[start[s] + width // k:start[s + 1]]:
            for a in range(k):
                for c in range(width):
                    _subtract(x[row * k + a], panels[at + c], own[c])
                at += width
    for s in range(len(first) - 2, -1, -1):
        width, own = (first[s + 1] - first[s]) * k, x[first[s] * k:first[s + 1] * k]
        at = offset[s] + width * width
        for row in pattern[start[s] + width // k:start[s + 1]]:
            for a in range(k):
                for c in range(width):
                    _subtract(own[c], panels[at + c], x[row * k + a])
                at += width
        for c in range(width - 1, -1, -1):
            at = offset[s] + c * width
            own[c] /= panels[at + c]
            for e in range(c):
                _subtract(own[e], panels[at + e], own[c])
    solution = np.empty((n, k, q))
    for f in range(n):
        for a in range(k):
            solution[f, a] = x[position[f] * k + a]
    return solution


@compiled
def _subtract(row, factor, other):
    for t in range(len(row)):
        row[t] -= factor * other[t]


@compiled
def left_over(keyframe, blocks, x, y, size):
    """Return |y - A x|^2 of each factor, mean over the samples, (m,); x : (n + 1, k, q)."""
    k, q = len(size), x.shape[2]
    mean, row = np.zeros(len(blocks)), np.empty(q)
    for f in range(len(blocks)):
        x_i, x_j = x[keyframe[f, 0]], x[keyframe[f, 1]]
        for r in range(k):
            for t in range(q):
                row[t] = y[f, r, t]
            for c in range(k):
                _subtract(row, blocks[f, 0, r, c], x_i[c])
                _subtract(row, blocks[f, 1, r, c], x_j[c])
            for t in range(q):
                mean[f] += row[t] * row[t] / q
    return mean


@compiled
def spreads(keyframe, blocks, x, size):
    """Return the second moment of A x for each factor, (m, k, k); x : (n + 1, k, q)."""
    k, q = len(size), x.shape[2]
    moment, d = np.empty((len(blocks), k, k)), np.empty((k, q))
    for f in range(len(blocks)):
        _moved(blocks[f], x[keyframe[f, 0]], x[keyframe[f, 1]], d)
        for r in range(k):
            for c in range(r + 1):
                total = 0.0
                for t in range(q):
                    total += d[r, t] * d[c, t]
                moment[f, r, c] = moment[f, c, r] = total / q
    return moment


@compiled
def _moved(pair, x_i, x_j, d):
    """Write J_i x_i + J_j x_j of one factor, (k, q)."""
    for r in range(len(d)):
        for t in range(d.shape[1]):
            d[r, t] = 0.0
        for c in range(len(d)):
            _subtract(d[r], -pair[0, r, c], x_i[c])
            _subtract(d[r], -pair[1, r, c], x_j[c])


@compiled
def moved(keyframe, blocks, x, size):
    """Return A x of each factor and sample, (m, k, q); x : (n + 1, k, q)."""
    d = np.empty((len(blocks), len(size), x.shape[2]))
    for f in range(len(blocks)):
        _moved(blocks[f], x[keyframe[f, 0]], x[keyframe[f, 1]], d[f])
    return d
