# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Sums over factors of products of their two blocks with vectors.

`size` is as many zeros as a block has rows, see `cholesky`.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import ANY_SIZE, for_sizes


@for_sizes('i8[:, ::1], f8[:, :, :, ::1], f8[:, ::1], f8[:, ::1]', ANY_SIZE)
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


@for_sizes('i8[:, ::1], f8[:, :, :, ::1], f8[:, ::1], f8[:, ::1]', ANY_SIZE)
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


@for_sizes('f8[:, :, ::1], f8[:, ::1]')
def whiten(roots, vectors, size):
    """Return L' e for each factor, (m, k); roots : (m, k, k), upper triangular."""
    k = len(size)
    product = np.empty((len(roots), k))
    for f in range(len(roots)):
        for r in range(k):
            total = 0.0
            for c in range(r, k):
                total += roots[f, r, c] * vectors[f, c]
            product[f, r] = total
    return product


@for_sizes('f8[:, :, ::1], f8[:, ::1]')
def unwhiten_dual(roots, duals, size):
    """Return L y for each factor, (m, k); roots : (m, k, k) L', upper triangular."""
    k = len(size)
    product = np.empty((len(roots), k))
    for f in range(len(roots)):
        for r in range(k):
            total = 0.0
            for c in range(r + 1):
                total += roots[f, c, r] * duals[f, c]
            product[f, r] = total
    return product


@for_sizes('f8[:, :, ::1], f8[:, :, :, ::1]')
def whiten_blocks(roots, blocks, size):
    """
    Turn J_i and J_j of each factor into L'J_i and L'J_j, (m, 2, k, k), in place.

    roots : (m, k, k), upper triangular: a row needs none above it, which may be done already
    """
    k = len(size)
    for f in range(len(roots)):
        for side in range(2):
            for r in range(k):
                for c in range(k):
                    total = 0.0
                    for a in range(r, k):
                        total += roots[f, r, a] * blocks[f, side, a, c]
                    blocks[f, side, r, c] = total
