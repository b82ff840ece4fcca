# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Where the entries of a block Cholesky factor lie: elimination tree, postorder, supernodes.

A supernode is a run of columns with one pattern below, stored as one dense panel. Source: Davis,
"Direct Methods for Sparse Linear Systems" (2006), chapter 4; Ashcraft and Grimes (1989) for the
merging of supernodes that costs few zeros.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop

# A panel may hold this part of zeros for the sake of being larger.
_ZEROS = 0.1


@loop('(i8[:, ::1], i8)')
def neighbours(keyframe, size):
    """Return the neighbours of each node, see `linear_system.neighbours`."""
    begin = np.zeros(size + 1, np.int64)
    for f in range(len(keyframe)):
        i, j = keyframe[f, 0], keyframe[f, 1]
        if i < size and j < size:
            begin[i + 1] += 1
            begin[j + 1] += 1
    for k in range(size):
        begin[k + 1] += begin[k]
    other, sorted_ = np.empty(begin[size], np.int32), np.empty(begin[size], np.int32)
    end = begin[:size].copy()
    for f in range(len(keyframe)):
        i, j = keyframe[f, 0], keyframe[f, 1]
        if i < size and j < size:
            other[end[i]] = j
            end[i] += 1
            other[end[j]] = i
            end[j] += 1
    # Given to their neighbours in order, nodes come in order.
    end[:] = begin[:size]
    for k in range(size):
        for at in range(begin[k], begin[k + 1]):
            to = other[at]
            sorted_[end[to]] = k
            end[to] += 1
    start, count = np.zeros(size + 1, np.int32), 0
    for k in range(size):
        for at in range(begin[k], begin[k + 1]):
            if at == begin[k] or sorted_[at] != sorted_[at - 1]:
                sorted_[count] = sorted_[at]
                count += 1
        start[k + 1] = count
    return start, sorted_[:count].copy()


@loop('(i4[::1], i8[::1], i4[::1])')
def lay_out(order, column, rows):
    """
    Return the layout of a factor; arguments as of `postorder`.

    Returns
    -------
    position : (n,) of each node in the new order
    first : (supernodes + 1,), see `supernodes`
    start, pattern : see `panel_rows`
    halves : (supernodes,), see `halves`
    work : multiplications of entries that one factorisation takes

    """
    position, parent, below, old = postorder(order, column, rows)
    first = supernodes(parent, below)
    start, pattern = panel_rows(first, column, rows, old, position)
    work = 0.0
    for k in range(len(below)):
        work += (below[k] + 1.0) ** 2 / 2
    return position, first, start, pattern, halves(first, start, pattern), work


@compiled
def postorder(order, column, rows):
    """
    Renumber an elimination so that every subtree of the elimination tree is one run.

    order, column, rows : as `ordering.minimum_degree` gives them

    Returns
    -------
    position : (n,) of each node in the new order
    parent : (n,) position of the parent of each position, n for a root
    below : (n,) entries below the diagonal at each position
    old : (n,) the elimination step of each position

    """
    n = len(order)
    step = np.empty(n, np.int32)
    for k in range(n):
        step[order[k]] = k
    parent = np.empty(n, np.int32)
    child, sibling = np.empty(n + 1, np.int32), np.empty(n, np.int32)
    child[n] = -1
    for k in range(n - 1, -1, -1):
        parent[k], child[k] = n, -1
        for at in range(column[k], column[k + 1]):
            parent[k] = min(parent[k], step[rows[at]])
        # The child with the longest column comes last, next to its parent, to be merged with it.
        sibling[k], child[parent[k]] = child[parent[k]], k
    old = np.empty(n, np.int32)
    stack = np.empty(n + 1, np.int32)
    place, top = 0, 0
    stack[0] = n
    while top >= 0:
        k = stack[top]
        if child[k] >= 0:
            top += 1
            stack[top] = child[k]
            child[k] = sibling[child[k]]
        else:
            top -= 1
            if k < n:
                old[place] = k
                place += 1
    new = np.empty(n + 1, np.int32)
    new[n] = n
    for k in range(n):
        new[old[k]] = k
    position = np.empty(n, np.int32)
    above = np.empty(n, np.int32)
    below = np.empty(n, np.int64)
    for k in range(n):
        position[order[k]] = new[k]
        above[k] = new[parent[old[k]]]
        below[k] = column[old[k] + 1] - column[old[k]]
    return position, above, below, old


@compiled
def supernodes(parent, below):
    """
    Return the first column of each supernode and n, (supernodes + 1,); arguments as above.

    A run of columns is merged with the run before it where that hangs on it and few zeros are
    stored for it.
    """
    n = len(parent)
    first, zeros = np.empty(n + 1, np.int32), np.empty(n, np.int64)
    count = 0
    for k in range(n):
        first[count], zeros[count] = k, 0
        count += 1
        while count > 1:
            middle, start = first[count - 1], first[count - 2]
            if parent[middle - 1] > k:
                break
            left = middle - start
            # All columns of the left run get the rows of the merged one.
            added = left * (k + 1 - middle + below[k] - below[middle - 1])
            width = k + 1 - start
            total = zeros[count - 2] + zeros[count - 1] + added
            if total > _ZEROS * width * (width + 1 + 2 * below[k]) / 2:
                break
            count -= 1
            zeros[count - 1] = total
    first[count] = n
    return first[:count + 1].copy()


@compiled
def panel_rows(first, column, rows, old, position):
    """
    Return the rows of every panel: start of each (supernodes + 1,), and the positions, sorted.

    The columns of the supernode themselves come first; those of its last column follow.
    """
    count, n = len(first) - 1, len(position)
    start, end = np.empty(count + 1, np.int64), np.empty(count, np.int64)
    start[0] = 0
    # Sorted by going through all rows in order: each is in the lower part of these supernodes.
    member = np.zeros(n + 1, np.int64)
    for s in range(count):
        last, end[s] = old[first[s + 1] - 1], start[s] + first[s + 1] - first[s]
        start[s + 1] = end[s] + column[last + 1] - column[last]
        for at in range(column[last], column[last + 1]):
            member[position[rows[at]] + 1] += 1
    for k in range(n):
        member[k + 1] += member[k]
    owner = np.empty(member[n], np.int32)
    for s in range(count):
        last = old[first[s + 1] - 1]
        for at in range(column[last], column[last + 1]):
            row = position[rows[at]]
            owner[member[row]] = s
            member[row] += 1
    pattern = np.empty(start[count], np.int32)
    for s in range(count):
        for k in range(first[s], first[s + 1]):
            pattern[start[s] + k - first[s]] = k
    at = 0
    for row in range(n):
        while at < member[row]:
            s = owner[at]
            pattern[end[s]] = row
            end[s] += 1
            at += 1
    return start, pattern


@compiled
def halves(first, start, pattern):
    """
    Return what to factorise at the same time, 0 and 1, and what after both, 2, (supernodes,).

    A cut through the postorder leaves whole subtrees on either side, 0 and 1; the supernodes with
    descendants on both are 2. Of all cuts the one that takes least time.
    """
    count = len(first) - 1
    owner, lowest = np.empty(first[count], np.int64), np.empty(count, np.int64)
    own, crossing = np.empty(count), np.zeros(count + 2)
    for s in range(count):
        lowest[s] = s
        for column in range(first[s], first[s + 1]):
            owner[column] = s
        width, height = first[s + 1] - first[s], start[s + 1] - start[s]
        own[s] = width * (height - width / 2.0) ** 2
    whole = 0.0
    for s in range(count):
        # The first of its subtree is known by now.
        below = start[s] + first[s + 1] - first[s]
        if below < start[s + 1]:
            above = owner[pattern[below]]
            lowest[above] = min(lowest[above], lowest[s])
        crossing[lowest[s] + 1] += own[s]
        crossing[s + 1] -= own[s]
        whole += own[s]
    cut = 0
    least = np.inf
    left = 0.0
    after = 0.0
    for s in range(count + 1):
        after += crossing[s]
        if max(left, whole - left - after) + after < least:
            cut, least = s, max(left, whole - left - after) + after
        if s < count:
            left += own[s]
    sides = np.zeros(count, np.int8)
    for s in range(cut, count):
        sides[s] = 1 if lowest[s] >= cut else 2
    return sides


@loop('(i8[:, ::1], i4[::1], i4[::1], i8[::1], i4[::1], i8[::1], i8[::1], i8)')
def block_addresses(keyframe, position, first, start, pattern, offset, stride, k):
    """
    Find where the blocks of a matrix of k x k blocks lie in the panels.

    keyframe : (m, 2) what each factor joins, the number of keyframes for none; position : (n,)

    Returns
    -------
    address, width, turned : of the block between the keyframes of each factor, (m,) each, see
        `blocks.assemble`
    corner, own : where each keyframe's own block begins and its panel's stride, (n,)

    """
    n, m = len(position), len(keyframe)
    corner, own = np.empty(n, np.int64), np.empty(n, np.int64)
    owner = np.empty(n, np.int64)
    for s in range(len(first) - 1):
        for column in range(first[s], first[s + 1]):
            owner[column] = s
    for v in range(n):
        column = position[v]
        s = owner[column]
        own[v] = stride[s]
        corner[v] = offset[s] + (column - first[s]) * k * (own[v] + 1)
    address = np.empty(m, np.int64)
    width = np.empty(m, np.int64)
    turned = np.empty(m, np.bool_)
    for f in range(m):
        i, j = keyframe[f, 0], keyframe[f, 1]
        address[f] = -1
        width[f] = 0
        turned[f] = False
        if i < n and j < n:
            turned[f] = position[i] > position[j]
            row, v = (position[i], j) if turned[f] else (position[j], i)
            s = owner[position[v]]
            low, high = start[s], start[s + 1]
            while low < high:
                middle = (low + high) // 2
                if pattern[middle] < row:
                    low = middle + 1
                else:
                    high = middle
            width[f] = own[v]
            address[f] = (offset[s] + (low - start[s]) * k * own[v]
                          + (position[v] - first[s]) * k)
    return address, width, turned, corner, own
