# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Small graphs that are like a large one: nodes are merged in pairs, over and over.

Source: Karypis and Kumar, "A fast and high quality multilevel scheme for partitioning irregular
graphs" (1998).
"""

from l1slam_ros.core.kernels.compiled import compiled, loop

# The types of a pool of graphs, see `take_part`.
POOL = 'Tuple((i4[::1], i4[::1], i4[::1], i4[::1], i4[::1], i8[:, ::1]))'
# Nodes are merged until so few are left, or until so many of them find no partner.
_FEW, _STUCK = 20, 0.9


@loop('(i4[::1], i8, i4[::1], i4[::1], i4[::1], i4[::1], ' + POOL + ')')
def take_part(own, number, start, adjacent, part, local, pool):
    """
    Write the graph of some nodes to the pool, as its first.

    own : the nodes; number : of no part before
    start, adjacent : as of `ordering.minimum_degree`
    part, local : (n,), of each node the number of its part, and its place in it
    pool : of the merged graphs, where the nodes of each begin, its neighbours and their weights,
        the weights of nodes, the node of the next graph that each belongs to, and where nodes and
        neighbours of each graph begin, (levels + 1, 2)
    """
    first, neighbour, heavy, weight, _, ends = pool
    for k in range(len(own)):
        part[own[k]] = number
        local[own[k]] = k
        weight[k] = 1
    at = 0
    for k in range(len(own)):
        first[k] = at
        for v in adjacent[start[own[k]]:start[own[k] + 1]]:
            if part[v] == number:
                neighbour[at], heavy[at] = local[v], 1
                at += 1
    first[len(own)] = at
    ends[1, 0], ends[1, 1] = len(own), at


@compiled
def _graph(pool, level):
    """Return a graph of the pool: start, adjacent, weights of neighbours and of nodes."""
    first, neighbour, heavy, weight, _, ends = pool
    low, high = ends[level], ends[level + 1]
    return (first[low[0] + level:high[0] + level + 1], neighbour[low[1]:high[1]],
            heavy[low[1]:high[1]], weight[low[0]:high[0]])


@loop('(' + POOL + ', i4[:, ::1], i8, i8, i8)')
def coarsen(pool, lists, level, most, attempt):
    """
    Merge nodes until no more than `most` are left, or few; return the level of the last graph.

    pool : of graphs as `take_part` writes them; new ones are written behind that of `level`
    lists : (3, n), memory to work in
    attempt : which pairs are merged differs from one to the next
    """
    first, neighbour, heavy, weight, into, ends = pool
    total = ends[1, 0]
    while ends[level + 1, 0] - ends[level, 0] > max(most, _FEW) and level + 2 < len(ends):
        graph = _graph(pool, level)
        nodes, edges = ends[level + 1]
        if nodes + len(graph[3]) > len(into) or edges + len(graph[1]) > len(heavy):
            break
        own = into[ends[level, 0]:nodes]
        count = _match(graph, total, attempt, own, lists[0])
        if count > _STUCK * len(own):
            break
        added = _merge(graph, own, count, first[nodes + level + 1:], neighbour[edges:],
                       heavy[edges:], weight[nodes:], lists)
        level += 1
        ends[level + 1, 0], ends[level + 1, 1] = nodes + count, edges + added
    return level


@compiled
def _match(graph, total, attempt, into, order):
    """Write the merged node that each belongs to: heavy edges first; return how many there are."""
    start, adjacent, heavy, weight = graph
    n = len(weight)
    order = order[:n]
    _shuffle(order, attempt)
    most, count = max(1.5 * total / _FEW, 2), 0
    for k in range(n):
        into[k] = -1
    for k in order:
        if into[k] >= 0:
            continue
        best, heaviest = k, 0
        for at in range(start[k], start[k + 1]):
            v = adjacent[at]
            if into[v] < 0 and heavy[at] > heaviest and weight[k] + weight[v] <= most:
                best, heaviest = v, heavy[at]
        into[k] = into[best] = count
        count += 1
    return count


@compiled
def _shuffle(order, attempt):
    """Write 0, 1, ... in an order that is always the same and like none of the graph's."""
    n = len(order)
    state = n + attempt
    for k in range(n):
        order[k] = k
    for k in range(n - 1, 0, -1):
        state = (state * 1103515245 + 12345) & 0x7fffffff
        v = (state >> 3) % (k + 1)
        order[k], order[v] = order[v], order[k]


@compiled
def _merge(graph, into, count, new_start, new_adjacent, new_heavy, new_weight, lists):
    """Write the graph of the merged nodes; return how many neighbours they have."""
    start, adjacent, heavy, weight = graph
    members, place = lists[:2], lists[2]
    for c in range(count):
        members[0, c] = -1
        place[c] = -1
        new_weight[c] = 0
    for k in range(len(into)):
        c = into[k]
        members[1, c] = k
        if members[0, c] < 0:
            members[0, c] = k
        new_weight[c] += weight[k]
    new_start[0], at = 0, 0
    for c in range(count):
        begin = at
        for which in range(1 + (members[0, c] != members[1, c])):
            k = members[which, c]
            for edge in range(start[k], start[k + 1]):
                v = into[adjacent[edge]]
                if v == c:
                    continue
                if place[v] < begin:
                    place[v] = at
                    new_adjacent[at] = v
                    new_heavy[at] = 0
                    at += 1
                new_heavy[place[v]] += heavy[edge]
        new_start[c + 1] = at
    return at
