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

from l1slam_ros.core.kernels.compiled import ANY_SIZE, compiled, for_sizes
from l1slam_ros.core.kernels.vectors.inline import Inline

_FACTORS = ('f8[::1], i8[:, ::1], i8[::1], i8[::1], b1[::1], i8[::1], i8[::1], f8[:, :, :, ::1], '
            'f8[:, ::1], f8[:, ::1], f8[:, :, :, ::1], f8')
# Rows of a block of whole poses in space.
_IN_SPACE = 6
# Factors whose blocks are fetched at the same time.
_AHEAD = 16


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


@for_sizes(_FACTORS, ANY_SIZE)
def assemble(panels, keyframe, address, width, turned, corner, stride, blocks, weights, diagonal,
             curvature, share, size):
    """
    Write the lower triangle of J'WJ + diag(diagonal) + share C to the panels.

    keyframe : (m, 2), blocks : (m, 2, k, k), see `LinearSystem`; weights : (m, k); diagonal :
    (n, k)
    curvature : (m', 2, k // 2, 2 k) of the first m' factors, of each the rows of the turns, the
        last entries, of keyframe i, and of j, which are its columns, too; all else is zero. C is
        their sum
    address, width : (m,) where the block between the keyframes i and j of each factor lies, and
    the stride of its panel; address -1: there is none
    turned : (m,) bool, that block is the one of row i and column j
    corner, stride : (n,) where each keyframe's own block begins, and its panel's stride

    Returns the sum of what it read ahead, which is of no use.
    """
    k = len(size)
    for at in range(len(panels)):
        panels[at] = 0.0
    # Keyframes' own blocks are summed up side by side: in the panels they lie far apart, and each
    # factor would wait for two of them.
    own = _own_blocks(diagonal)
    scaled, seen = np.empty((2, k, k)), 0.0
    for f in range(len(blocks)):
        if f % _AHEAD == 0:
            seen += _read_ahead(panels, address[f:f + _AHEAD], width[f:f + _AHEAD], k)
        left = 0 if turned[f] else 1
        right = 1 - left
        if k == _IN_SPACE:
            _add_in_space(own, panels, keyframe, address, width, left, blocks, weights, f)
        else:
            for side in range(2):
                for r in range(k):
                    for c in range(k):
                        scaled[side, r, c] = weights[f, r] * blocks[f, side, r, c]
                for r in range(k):
                    for c in range(r + 1):
                        total = 0.0
                        for a in range(k):
                            total += blocks[f, side, a, r] * scaled[side, a, c]
                        own[keyframe[f, side], r, c] += total
            if address[f] >= 0:
                for r in range(k):
                    for c in range(k):
                        total = 0.0
                        for a in range(k):
                            total += blocks[f, left, a, r] * scaled[right, a, c]
                        panels[address[f] + r * width[f] + c] += total
        if f < len(curvature):
            _add_curvature(own, panels, keyframe[f], address[f], width[f], left, curvature[f],
                           share, k)
    _write_own(own, panels, corner, stride, k)
    return seen


@compiled
def _add_in_space(own, panels, keyframe, address, width, left, blocks, weights, f):
    """Add the products of the blocks of factor f, which is in space; see `assemble`."""
    k = _IN_SPACE
    for side in range(2):
        block = 2 * f + side
        _add_products(blocks, block, block, weights, f, own, keyframe[f, side] * k * k, k)
    if address[f] >= 0:
        _add_products(blocks, 2 * f + left, 2 * f + 1 - left, weights, f, panels, address[f],
                      width[f])


def _products_tile(vectors, blocks, one, other, weights, f, to, begin, stride):
    """
    Add the product of two blocks of a factor in space to rows of what is there.

    one, other : numbers of the blocks; f : of the factor; begin, stride : of the rows
    """
    k = _IN_SPACE
    mask = vectors.first(k)
    left, right = (vectors.at(blocks, vectors.times(block, k * k)) for block in (one, other))
    weights = vectors.at(weights, vectors.times(f, k))
    scaled = [vectors.scaled(vectors.load(vectors.at(right, k * a), mask),
                             vectors.spread(vectors.entry(weights, a))) for a in range(k)]
    for r in range(k):
        total = vectors.variable(vectors.zeros)
        for a in range(k):
            vectors.add(total, vectors.spread(vectors.entry(left, k * a + r)), scaled[a])
        row = vectors.at(vectors.at(to, begin), vectors.times(stride, r))
        vectors.store(vectors.sum(vectors.load(row, mask), vectors.value(total)), row, mask)


_add_products = Inline(_products_tile, 8)


@compiled
def _add_curvature(own, panels, keyframe, at, width, left, curvature, share, k):
    """
    Add a factor's curvature to its keyframes' own blocks, and to the one between, if it has one.

    keyframe : (2,); at, width, left : of its block, see `assemble`; curvature : (2, k // 2, 2 k)
    """
    # Of three and of six numbers a step turns by one and by three.
    still = k - k // 2
    for side in range(2):
        for r in range(still, k):
            for c in range(r + 1):
                own[keyframe[side], r, c] += share * curvature[side, r - still, side * k + c]
    if at < 0:
        return
    right = 1 - left
    for r in range(still):
        for c in range(still, k):
            panels[at + r * width + c] += share * curvature[right, c - still, left * k + r]
    for r in range(still, k):
        for c in range(k):
            panels[at + r * width + c] += share * curvature[left, r - still, right * k + c]


@compiled
def _own_blocks(diagonal):
    """Return a block for each keyframe, with this diagonal, and one for what is held fixed."""
    n, k = diagonal.shape
    own = np.zeros((n + 1, k, k))
    for v in range(n):
        for a in range(k):
            own[v, a, a] = diagonal[v, a]
    return own


@compiled
def _write_own(own, panels, corner, stride, k):
    """Write the lower triangles of keyframes' own blocks to the panels, see `assemble`."""
    for v in range(len(corner)):
        for r in range(k):
            for c in range(r + 1):
                panels[corner[v] + r * stride[v] + c] = own[v, r, c]


@compiled
def _read_ahead(panels, address, width, k):
    """
    Return the sum of a number of each row of some blocks.

    They lie anywhere in memory. Read one right after the other, they are fetched at the same time;
    and a sum that is returned is not left out by the compiler.
    """
    seen = 0.0
    for f in range(len(address)):
        for r in range(k):
            seen += panels[max(address[f], 0) + r * width[f]]
    return seen
