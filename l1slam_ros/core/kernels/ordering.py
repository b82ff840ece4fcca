# SPDX-License-Identifier: Apache-2.0
"""
In which order to eliminate keyframes so that little fills in: approximate minimum degree.

The graph left after some eliminations is kept as a quotient graph: each keyframe still there has
neighbours by a factor (variables) and cliques that eliminations made (elements, named by the
keyframe eliminated). Its degree is bounded from above without merging the cliques. What it lists
for each elimination is the column of the Cholesky factor, so the fill comes out exactly.

Source: Amestoy, Davis, Duff, "An approximate minimum degree ordering algorithm" (1996), without
its supervariables: a pose's block plays that part.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop


@loop('(i4[::1], i4[::1], i8)')
def minimum_degree(start, adjacent, limit):
    """
    Order the nodes of a graph; stop when the factor would have more than `limit` blocks.

    start, adjacent : the neighbours of node k are adjacent[start[k]:start[k + 1]], each once, both
    ways round, k itself left out; int32.

    Returns
    -------
    order : (n,) nodes in the order of elimination, or as far as it came
    column : (n + 1,) and rows : the nodes below the diagonal in each column, as eliminated

    """
    n = len(start) - 1
    lists = np.empty_like(adjacent)  # of each node: variables, then elements
    for at in range(len(adjacent)):
        lists[at] = adjacent[at]
    n_variables, n_elements = np.empty(n, np.int32), np.empty(n, np.int32)
    degree, head = np.empty(n, np.int32), np.empty(n + 1, np.int32)
    after, before = np.empty(n, np.int32), np.empty(n, np.int32)
    seen, absorbed = np.empty(n, np.int32), np.empty(n, np.bool_)
    outside, counted = np.empty(n, np.int32), np.empty(n, np.int32)
    order, place = np.empty(n, np.int32), np.empty(n, np.int32)
    column, rows = np.empty(n + 1, np.int64), np.empty(limit, np.int32)
    column[0], head[n] = 0, -1
    for k in range(n):
        degree[k] = n_variables[k] = start[k + 1] - start[k]
        n_elements[k], outside[k], absorbed[k] = 0, 0, False
        head[k] = seen[k] = counted[k] = place[k] = -1
    for k in range(n):
        _put(head, after, before, k, degree[k])
    lowest = 0
    for step in range(n):
        while head[lowest] < 0:
            lowest += 1
        pivot = head[lowest]
        _take(head, after, before, pivot, lowest)
        order[step], place[pivot], seen[pivot] = pivot, step, pivot
        end = _gather(pivot, start, lists, n_variables, n_elements, column, rows, place, seen,
                      absorbed, column[step])
        if end < 0:
            return order[:step], column[: step + 1], rows[: column[step]]
        column[step + 1] = end
        size = end - column[step]
        _count_outside(rows[column[step]:end], start, lists, n_variables, n_elements, column,
                       place, absorbed, outside, counted, pivot)
        for k in rows[column[step]:end]:
            _take(head, after, before, k, degree[k])
            bound = _reduce(k, pivot, start, lists, n_variables, n_elements, place, seen,
                            absorbed, outside)
            degree[k] = min(n - step - 2, degree[k] + size - 1, bound + size - 1)
            _put(head, after, before, k, degree[k])
            lowest = min(lowest, degree[k])
    return order, column, rows[: column[n]]


@compiled
def _gather(pivot, start, lists, n_variables, n_elements, column, rows, place, seen, absorbed,
            end):
    """Write the pivot's neighbours to rows from `end` on; its elements are absorbed."""
    first, n_var = start[pivot], n_variables[pivot]
    for k in lists[first:first + n_var]:
        if place[k] < 0 and seen[k] != pivot:
            if end == len(rows):
                return -1
            seen[k] = pivot
            rows[end] = k
            end += 1
    for e in lists[first + n_var:first + n_var + n_elements[pivot]]:
        if absorbed[e]:
            continue
        absorbed[e] = True
        for k in rows[column[place[e]]:column[place[e] + 1]]:
            if place[k] < 0 and seen[k] != pivot:
                if end == len(rows):
                    return -1
                seen[k] = pivot
                rows[end] = k
                end += 1
    return end


@compiled
def _count_outside(clique, start, lists, n_variables, n_elements, column, place, absorbed, outside,
                   counted, pivot):
    """Count, for every element that touches the clique, its members outside of it."""
    for k in clique:
        first = start[k] + n_variables[k]
        for e in lists[first:first + n_elements[k]]:
            if absorbed[e]:
                continue
            if counted[e] != pivot:
                counted[e] = pivot
                outside[e] = column[place[e] + 1] - column[place[e]]
            outside[e] -= 1


@compiled
def _reduce(k, pivot, start, lists, n_variables, n_elements, place, seen, absorbed, outside):
    """Drop from k's lists what the new element covers, add it, and bound k's other neighbours."""
    first = start[k]
    old_variables, old_elements = n_variables[k], n_elements[k]
    write, bound = first, np.int32(0)
    for v in lists[first:first + old_variables]:
        if place[v] < 0 and seen[v] != pivot:
            lists[write] = v
            write += 1
            bound += 1
    n_variables[k] = write - first
    for e in lists[first + old_variables:first + old_variables + old_elements]:
        if absorbed[e]:
            continue
        if outside[e] == 0:
            absorbed[e] = True
            continue
        lists[write] = e
        write += 1
        bound += outside[e]
    lists[write] = pivot
    n_elements[k] = write + 1 - first - n_variables[k]
    return bound


@compiled
def _put(head, after, before, k, degree):
    """Put k in front of the nodes of a degree."""
    after[k], before[k] = head[degree], -1
    if head[degree] >= 0:
        before[head[degree]] = k
    head[degree] = k


@compiled
def _take(head, after, before, k, degree):
    """Take k out of the nodes of a degree."""
    if before[k] >= 0:
        after[before[k]] = after[k]
    else:
        head[degree] = after[k]
    if after[k] >= 0:
        before[after[k]] = before[k]
