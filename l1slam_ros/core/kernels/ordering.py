# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
In which order to eliminate keyframes so that little fills in: approximate minimum degree.

The graph left after some eliminations is kept as a quotient graph: each keyframe still there has
neighbours by a factor (variables) and cliques that eliminations made (elements, named by the
keyframe eliminated). Its degree is bounded from above without merging the cliques. What it lists
for each elimination is the column of the Cholesky factor, so the fill comes out exactly.

Source: Amestoy, Davis, Duff, "An approximate minimum degree ordering algorithm" (1996), without
its supervariables: a pose's block plays that part.

Graphs that are alike everywhere (a sphere, a torus) fill in less where those keyframes come last
that hold two halves of them together, and so on in the halves. Keyframes are put in levels by how
many factors they are from one at the edge; those of one level that touch the next separate what is
before from what is behind. Source: George and Liu, "Computer Solution of Large Sparse Positive
Definite Systems" (1981), chapter 8.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop

# Parts of no more nodes are not halved: from 30 to 300, a sphere and a torus fill in alike. A half
# has this part of the nodes at least.
_WHOLE, _LEAST = 120, 0.2
# Searches for a node at the edge.
_SEARCHES = 4


@loop('(i4[::1], i4[::1], i8, i4[::1], i4[::1], i8[::1], i4[::1])')
def minimum_degree(start, adjacent, limit, stage, order_begun, column_begun, rows_begun):
    """
    Order the nodes of a graph; stop when the factor would have more than `limit` blocks.

    start, adjacent : the neighbours of node k are adjacent[start[k]:start[k + 1]], each once, both
    ways round, k itself left out; int32.
    stage : (n,) from 0; nodes of a higher one come later, whatever their degree
    order_begun, column_begun, rows_begun : as returned, of the first nodes to eliminate: none, or
        what `growth.untouched` left of an elimination

    Returns
    -------
    order : (n,) nodes in the order of elimination, or as far as it came
    column : (n + 1,) and rows : the nodes below the diagonal in each column, as eliminated

    """
    n, done = len(start) - 1, len(order_begun)
    # The lists of nodes by stage and degree.
    head = _empty_lists(stage)
    after, before = np.empty(n, np.int32), np.empty(n, np.int32)
    seen, counted = _range(n, -1, 0), _range(n, -1, 0)
    outside = np.zeros(n, np.int32)
    order, column, rows, place, absorbed = _resumed(
        n, limit, order_begun, column_begun, rows_begun)
    start, lists, n_variables, n_elements, degree = _quotient(
        start, adjacent, order_begun, column, rows, place, absorbed)
    for k in range(n):
        if place[k] < 0:
            _put(head, after, before, k, stage[k] * n + degree[k])
    lowest = 0
    for step in range(done, n):
        while head[lowest] < 0:
            lowest += 1
        pivot = head[lowest]
        _take(head, after, before, pivot, lowest)
        order[step], place[pivot] = pivot, step
        seen[pivot] = pivot
        end = _gather(pivot, start, lists, n_variables, n_elements, column, rows, place, seen,
                      absorbed, column[step])
        if end < 0:
            return order[:step], column[: step + 1], rows[: column[step]]
        column[step + 1] = end
        size = end - column[step]
        _count_outside(rows[column[step]:end], start, lists, n_variables, n_elements, column,
                       place, absorbed, outside, counted, pivot)
        for k in rows[column[step]:end]:
            _take(head, after, before, k, stage[k] * n + degree[k])
            bound = _reduce(k, pivot, start, lists, n_variables, n_elements, place, seen,
                            absorbed, outside)
            degree[k] = min(n - step - 2, degree[k] + size - 1, bound + size - 1)
            _put(head, after, before, k, stage[k] * n + degree[k])
            lowest = min(lowest, stage[k] * n + degree[k])
    # Of the room that there was for rows nothing is kept.
    return order, column, rows[: column[n]].copy()


@compiled
def _range(n, first, step):
    """Return so many numbers, each a step above the one before, (n,) int32."""
    numbers = np.empty(n, np.int32)
    for k in range(n):
        numbers[k] = first + step * k
    return numbers


@compiled
def _empty_lists(stage):
    """Return the first node of each list, by stage and degree: -1, none."""
    highest = 0
    for k in range(len(stage)):
        highest = max(highest, stage[k])
    return _range(len(stage) * (1 + highest), -1, 0)


@compiled
def _resumed(n, limit, order_begun, column_begun, rows_begun):
    """
    Return room for order, column and rows, with what has begun at the front.

    And the step of each node, -1 if it is to come, and whether its element is absorbed.
    """
    order, rows = np.empty(n, np.int32), np.empty(limit, np.int32)
    column = np.empty(n + 1, np.int64)
    place, absorbed = _range(n, -1, 0), np.zeros(n, np.bool_)
    column[0] = 0
    for step in range(len(order_begun)):
        order[step], column[step + 1] = order_begun[step], column_begun[step + 1]
        place[order[step]] = step
    for at in range(column[len(order_begun)]):
        rows[at] = rows_begun[at]
    for step in range(len(order_begun)):
        for k in rows[column[step]:column[step + 1]]:
            absorbed[order[step]] |= place[k] >= 0
    return order, column, rows, place, absorbed


@compiled
def _quotient(start, adjacent, order, column, rows, place, absorbed):
    """Return where the lists of each node that is left begin, the lists, and its degree."""
    n = len(place)
    n_variables, n_elements = np.zeros(n, np.int32), np.zeros(n, np.int32)
    degree, first = np.zeros(n, np.int32), np.zeros(n + 1, np.int32)
    for k in range(n):
        for v in adjacent[start[k]:start[k + 1]]:
            n_variables[k] += place[v] < 0
        degree[k] = n_variables[k]
    for step in range(len(order)):
        if not absorbed[order[step]]:
            for k in rows[column[step]:column[step + 1]]:
                n_elements[k] += 1
                degree[k] = min(degree[k] + column[step + 1] - column[step] - 1,
                                n - len(order) - 1)
    for k in range(n):
        first[k + 1] = first[k] + n_variables[k] + n_elements[k]
    lists, end = np.empty(first[n], np.int32), first.copy()
    for k in range(n):
        for v in adjacent[start[k]:start[k + 1]]:
            if place[v] < 0:
                lists[end[k]] = v
                end[k] += 1
    for step in range(len(order)):
        if not absorbed[order[step]]:
            for k in rows[column[step]:column[step + 1]]:
                lists[end[k]] = order[step]
                end[k] += 1
    return first, lists, n_variables, n_elements, degree


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


@loop('(i4[::1], i4[::1])')
def dissect(start, adjacent):
    """
    Return the stage of each node, (n,): the higher, the later it is to be eliminated.

    start, adjacent : as of `minimum_degree`
    """
    n = len(start) - 1
    cut, part = np.zeros(n, np.int32), np.zeros(n, np.int32)
    level, queue = np.empty(n, np.int32), np.empty(n, np.int32)
    nodes = _range(n, 0, 1)
    begin, end = np.zeros(n + 2, np.int32), np.empty(n + 2, np.int32)
    depth, deepest = np.zeros(n + 2, np.int32), 0
    count, number = 1, 0
    end[0] = n
    while count:
        count -= 1
        low, below = begin[count], depth[count] + 1
        own = nodes[low:end[count]]
        if len(own) <= _WHOLE:
            continue
        number += 1
        reached = _edge(own, number, start, adjacent, part, level, queue)
        middle = n
        if reached == len(own):
            middle = _middle(queue[:reached], number, start, adjacent, part, level)
            if middle < 0:
                continue
            for k in own:
                if level[k] == middle and _touches(k, number, start, adjacent, part, level):
                    cut[k] = below
            deepest = max(deepest, below)
        at = 0
        for behind in (False, True):
            begin[count], depth[count] = low + at, below
            for k in own:
                if not cut[k] and (level[k] > middle) == behind:
                    queue[at] = k
                    at += 1
            end[count] = low + at
            count += 1
        for k in range(at):
            nodes[low + k] = queue[k]
    for k in range(n):
        cut[k] = deepest + 1 - cut[k] if cut[k] else 0
    return cut


@compiled
def _edge(own, number, start, adjacent, part, level, queue):
    """Put nodes in levels from one at the edge of the part; return how many are tied to it."""
    reached = _levels(own[0], own, number, start, adjacent, part, level, queue)
    for _ in range(_SEARCHES):
        farthest = queue[reached - 1]
        before = level[farthest]
        _levels(farthest, own, number, start, adjacent, part, level, queue)
        if level[queue[reached - 1]] <= before:
            break
    return reached


@compiled
def _levels(root, own, number, start, adjacent, part, level, queue):
    """Write the part and level of own nodes, and those tied to the root to the queue, in order."""
    far = len(level) + 1
    for k in own:
        part[k] = number
        level[k] = far
    level[root], queue[0] = 0, root
    at, end = 0, 1
    while at < end:
        k = queue[at]
        at += 1
        for v in adjacent[start[k]:start[k + 1]]:
            if part[v] == number and level[v] == far:
                level[v], queue[end] = level[k] + 1, v
                end += 1
    return end


@compiled
def _middle(queue, number, start, adjacent, part, level):
    """Return the level that separates with the fewest nodes, and evenly; -1: none does."""
    best, least = -1, np.inf
    at, size = 0, len(queue)
    while at < size:
        own, touching = level[queue[at]], 0
        while at < size and level[queue[at]] == own:
            touching += _touches(queue[at], number, start, adjacent, part, level)
            at += 1
        before, behind = at - touching, size - at
        costs = touching * (1 + ((before - behind) / size) ** 2)
        if min(before, behind) >= _LEAST * size and costs < least:
            best, least = own, costs
    return best


@compiled
def _touches(k, number, start, adjacent, part, level):
    """Tell whether a node has a neighbour in the next level."""
    for v in adjacent[start[k]:start[k + 1]]:
        if part[v] == number and level[v] == level[k] + 1:
            return True
    return False
