# SPDX-License-Identifier: Apache-2.0
"""
Where the entries of a block Cholesky factor lie: elimination tree, postorder, supernodes.

A supernode is a run of columns with one pattern below, stored as one dense panel. Source: Davis,
"Direct Methods for Sparse Linear Systems" (2006), chapter 4; Ashcraft and Grimes (1989) for the
merging of supernodes that costs few zeros.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled

# A panel may hold this part of zeros for the sake of being larger.
_ZEROS = 0.2


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
    parent = np.full(n, n, np.int32)
    child, sibling = np.full(n + 1, -1, np.int32), np.empty(n, np.int32)
    for k in range(n - 1, -1, -1):
        for row in rows[column[k]:column[k + 1]]:
            parent[k] = min(parent[k], step[row])
        # The child with the longest column comes last, next to its parent, to be merged with it.
        sibling[k], child[parent[k]] = child[parent[k]], k
    old, stack, place, top = np.empty(n, np.int32), np.empty(n + 1, np.int32), 0, 0
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
    for k in range(n):
        position[order[k]] = new[k]
    below = (column[1:] - column[:-1])[old]
    return position, new[parent[old]], below, old


@compiled
def supernodes(parent, below):
    """
    Return the first column of each supernode and n, (supernodes + 1,); arguments as above.

    A run of columns is merged with the run before it where that hangs on it and few zeros are
    stored for it.
    """
    n = len(parent)
    first, zeros = np.empty(n + 1, np.int32), np.zeros(n, np.int64)
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
    return first[: count + 1].copy()


@compiled
def panel_rows(first, column, rows, old, position):
    """
    Return the rows of every panel: start of each (supernodes + 1,), and the positions, sorted.

    The columns of the supernode themselves come first; those of its last column follow.
    """
    count = len(first) - 1
    start = np.zeros(count + 1, np.int64)
    for s in range(count):
        last = old[first[s + 1] - 1]
        start[s + 1] = start[s] + first[s + 1] - first[s] + column[last + 1] - column[last]
    pattern = np.empty(start[count], np.int32)
    for s in range(count):
        width = first[s + 1] - first[s]
        last = old[first[s + 1] - 1]
        for k in range(width):
            pattern[start[s] + k] = first[s] + k
        lower = position[rows[column[last]:column[last + 1]]]
        pattern[start[s] + width:start[s + 1]] = np.sort(lower)
    return start, pattern
