# SPDX-License-Identifier: Apache-2.0
"""
Sums over factors of products of their two blocks with vectors.

`size` is as many zeros as a block has rows, see `cholesky`.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop


@loop('(i8[:, ::1], f8[:, :, :, ::1], f8[:, ::1], f8[:, ::1])')
def multiply(keyframe, blocks, x, product):
    """Write A x, (m, k); x : (n + 1, k), the last row zero; other arrays as in LinearSystem."""
    if x.shape[1] == 3:
        _multiply(keyframe, blocks, x, product, (0, 0, 0))
    else:
        _multiply(keyframe, blocks, x, product, np.empty(x.shape[1]))


@compiled
def _multiply(keyframe, blocks, x, product, size):
    k = len(size)
    for f in range(len(blocks)):
        i, j = keyframe[f, 0], keyframe[f, 1]
        for r in range(k):
            total = 0.0
            for c in range(k):
                total += blocks[f, 0, r, c] * x[i, c] + blocks[f, 1, r, c] * x[j, c]
            product[f, r] = total


@loop('(i8[:, ::1], f8[:, :, :, ::1], f8[:, ::1], f8[:, ::1])')
def multiply_transposed(keyframe, blocks, y, product):
    """Add A'y to product, (n + 1, k), whose last row gathers what is held fixed; y : (m, k)."""
    if y.shape[1] == 3:
        _multiply_transposed(keyframe, blocks, y, product, (0, 0, 0))
    else:
        _multiply_transposed(keyframe, blocks, y, product, np.empty(y.shape[1]))


@compiled
def _multiply_transposed(keyframe, blocks, y, product, size):
    k = len(size)
    for f in range(len(blocks)):
        i, j = keyframe[f, 0], keyframe[f, 1]
        for c in range(k):
            at_i = at_j = 0.0
            for r in range(k):
                at_i += blocks[f, 0, r, c] * y[f, r]
                at_j += blocks[f, 1, r, c] * y[f, r]
            product[i, c] += at_i
            product[j, c] += at_j


@loop('(f8[:, :, :, ::1], f8[:, ::1], UniTuple(i8, 3))')
def gradients(blocks, y, size):
    """Return J_i'y and J_j'y of each factor, (m, 2, k); y : (m, k)."""
    k = len(size)
    product = np.empty((len(blocks), 2, k))
    for f in range(len(blocks)):
        for side in range(2):
            for c in range(k):
                total = 0.0
                for r in range(k):
                    total += blocks[f, side, r, c] * y[f, r]
                product[f, side, c] = total
    return product


@loop('(f8[:, :, ::1], f8[:, ::1], UniTuple(i8, 3))')
def whiten(roots, vectors, size):
    """Return L' e for each factor, (m, k); roots : (m, k, k)."""
    k = len(size)
    product = np.empty((len(roots), k))
    for f in range(len(roots)):
        for r in range(k):
            total = 0.0
            for c in range(k):
                total += roots[f, r, c] * vectors[f, c]
            product[f, r] = total
    return product


@loop('(f8[:, :, ::1], f8[:, :, ::1], i8, f8[:, :, :, ::1], UniTuple(i8, 3))')
def whiten_blocks(roots, J, side, blocks, size):
    """Write L'J to blocks[:, side] for each factor; J : (m, k, k), blocks : (m, 2, k, k)."""
    k = len(size)
    for f in range(len(roots)):
        for r in range(k):
            for c in range(k):
                total = 0.0
                for a in range(k):
                    total += roots[f, r, a] * J[f, a, c]
                blocks[f, side, r, c] = total
