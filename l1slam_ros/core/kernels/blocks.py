# SPDX-License-Identifier: Apache-2.0
"""
Sums over factors of products of their two blocks: with vectors, and with each other.

`size` is a tuple of as many zeros as a block has rows: the length of a tuple is known when a loop
is compiled, so loops over the rows of a block are unrolled.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled


@compiled
def multiply(keyframe, blocks, x, product, size):
    """Write A x, (m, k); x : (n + 1, k), the last row zero; other arrays as in LinearSystem."""
    k = len(size)
    for f in range(len(blocks)):
        i, j = keyframe[f, 0], keyframe[f, 1]
        for r in range(k):
            total = 0.0
            for c in range(k):
                total += blocks[f, 0, r, c] * x[i, c] + blocks[f, 1, r, c] * x[j, c]
            product[f, r] = total


@compiled
def multiply_transposed(keyframe, blocks, y, product, size):
    """Add A'y to product, (n + 1, k), whose last row gathers what is held fixed; y : (m, k)."""
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


@compiled
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


@compiled
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


@compiled
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


@compiled
def add_normal(panels, blocks, weights, address, width, turned, size):
    """
    Add J' W J of every factor to the panels of a lower triangle.

    blocks : (m, 2, k, k) J_i and J_j; weights : (m, k)
    address, width : (m, 3) where the blocks (i, i), (j, j) and the one between i and j lie, and
    the width of their panels; address -1: there is none
    turned : (m,) bool, the block between them is that of row i and column j
    """
    k = len(size)
    scaled = np.empty((2, k, k))
    for f in range(len(blocks)):
        for side in range(2):
            for r in range(k):
                for c in range(k):
                    scaled[side, r, c] = weights[f, r] * blocks[f, side, r, c]
        for part in range(3):
            if address[f, part] < 0:
                continue
            left = part if part < 2 else (0 if turned[f] else 1)
            right = part if part < 2 else 1 - left
            for r in range(k):
                for c in range(k):
                    total = 0.0
                    for a in range(k):
                        total += blocks[f, left, a, r] * scaled[right, a, c]
                    panels[address[f, part] + r * width[f, part] + c] += total


@compiled
def add_blocks(panels, values, factor, address, width, turned, size):
    """Add factor values, (m, 2 k, 2 k), the lower part of it, to the panels; see `add_normal`."""
    k = len(size)
    for f in range(len(values)):
        for part in range(3):
            if address[f, part] < 0:
                continue
            left = part if part < 2 else (0 if turned[f] else 1)
            right = part if part < 2 else 1 - left
            for r in range(k):
                for c in range(k):
                    panels[address[f, part] + r * width[f, part] + c] += (
                        factor * values[f, left * k + r, right * k + c])
