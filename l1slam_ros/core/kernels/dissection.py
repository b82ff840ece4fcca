# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Nested dissection: which keyframes hold two halves of a graph together, and so on in the halves.

Eliminated last, these separators keep large graphs, and those that are alike everywhere (a sphere,
a torus), from filling in. A good one is found on a small graph that is like the large one: nodes
are merged in pairs, over and over; the smallest graph is cut; and on the way back each graph gets
the cut of the one below it, moved node by node while that makes the separator lighter.

Source: Karypis and Kumar, "A fast and high quality multilevel scheme for partitioning irregular
graphs" (1998); Fiduccia and Mattheyses (1982) for the moves, here of separators.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop

# Parts of no more nodes are not cut: minimum degree orders them as well. Nor are those of which a
# separator would be so large a share.
_WHOLE, _CUT = 120, 0.3
# Nodes are merged until so few are left, or until so many of them find no partner.
_FEW, _STUCK, _LEVELS = 20, 0.9, 64
# The merged graphs of a part may have so many times its own edges together.
_ROOM = 4
# So many cuts are made of a graph that is so many times smaller than the part, by merging on in
# different ways, and so many of each smallest graph. One cut alone costs a tenth more work.
_SMALLER, _CUTS, _TRIES = 5, 7, 2
# Passes of moves over each graph, and moves that one goes on without a lighter separator.
_PASSES, _HOPE = 3, 100
# No side may be a larger share of what is cut. Of a sphere it pays to cut off a cap.
_MOST = 0.72
# The sides of a cut, and what is between.
_LEFT, _RIGHT, _BETWEEN = 0, 1, 2


@loop('(i4[::1], i4[::1])')
def dissect(start, adjacent):
    """
    Return the stage of each node, (n,): the higher, the later it is to be eliminated.

    start, adjacent : as of `ordering.minimum_degree`
    """
    n = len(start) - 1
    pool, space, sides = _room(n, len(adjacent))
    cut, part, local = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    nodes, split = np.empty(n, np.int32), np.empty(n, np.int32)
    for k in range(n):
        nodes[k], cut[k], part[k] = k, 0, 0
    parts = np.empty((n + 2, 3), np.int64)
    parts[0, 0], parts[0, 1], parts[0, 2] = 0, n, 1
    count, number, deepest = 1, 0, 0
    while count:
        count -= 1
        low, high, depth = parts[count]
        if high - low <= _WHOLE:
            continue
        number += 1
        own = nodes[low:high]
        _take_part(own, number, start, adjacent, part, local, pool)
        side = _separate(pool, space, sides)
        middle, behind = _arrange(own, side, split)
        if len(own) - behind > _CUT * len(own) or not middle or middle == behind:
            continue
        for k in own[behind:]:
            cut[k], deepest = depth, max(deepest, depth)
        for first, end in ((low, low + middle), (low + middle, low + behind)):
            parts[count, 0], parts[count, 1], parts[count, 2] = first, end, depth + 1
            count += 1
    for k in range(n):
        cut[k] = deepest + 1 - cut[k] if cut[k] else 0
    return cut


@compiled
def _room(n, edges):
    """
    Return the memory that all parts share: see `_graph`, `_pass` and `_back`.

    pool : of the merged graphs, where the nodes of each begin, its neighbours and their weights,
    the weights of nodes, the node of the next graph that each belongs to, and where nodes and
    neighbours of each graph begin, (levels + 1, 2)
    space : what each node in the separator would pull into it, to either side; those that wait, by
    gain; in which pass each was moved; all moves; three lists of nodes; the weight of each side,
    and how many wait
    sides : (4, n) of each node in four graphs
    """
    pool = (np.empty(_ROOM * n + _LEVELS, np.int32), np.empty(_ROOM * edges, np.int32),
            np.empty(_ROOM * edges, np.int32), np.empty(_ROOM * n, np.int32),
            np.empty(_ROOM * n, np.int32), np.zeros((_LEVELS + 1, 2), np.int64))
    space = (np.empty((2, n), np.int32), np.empty((2, n + edges), np.int64),
             np.empty(n, np.int32), np.empty(n + edges, np.int32), np.empty((3, n), np.int32),
             np.empty((2, 3), np.int64))
    return pool, space, np.empty((4, n), np.int32)


@compiled
def _arrange(own, side, split):
    """Put nodes to the left first, those between last; return where those to the right are."""
    at, middle, behind = 0, 0, 0
    for which in range(3):
        middle, behind = behind, at
        for k in range(len(own)):
            if side[k] == which:
                split[at] = own[k]
                at += 1
    for k in range(at):
        own[k] = split[k]
    return middle, behind


@compiled
def _take_part(own, number, start, adjacent, part, local, pool):
    """Write the graph of some nodes to the pool, as its first."""
    first, neighbour, heavy, weight, _, ends = pool
    for k in range(len(own)):
        part[own[k]], local[own[k]], weight[k] = number, k, 1
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


@compiled
def _separate(pool, space, sides):
    """Return the side of each node of the pool's first graph: left, right, or between."""
    size, none, few = pool[-1][1, 0], np.int64(0), np.int64(_FEW)
    top = _coarsen(pool, none, max(few, size // _SMALLER), none, space)
    best, least = sides[3], np.inf
    for attempt in range(_CUTS):
        bottom = _coarsen(pool, top, few, attempt, space)
        side = _first_cut(_graph(pool, bottom), sides, space)
        side = _back(pool, bottom, top, side, sides, space)
        costs = _costs(_graph(pool, top), side)
        if costs < least:
            least = costs
            for k in range(len(side)):
                best[k] = side[k]
    return _back(pool, top, none, best[:len(_graph(pool, top)[3])], sides, space)


@compiled
def _back(pool, level, to, side, sides, space):
    """Return the side of each node of a larger graph; that of the smaller one is `side`."""
    while level > to:
        low, high = pool[-1][level - 1, 0], pool[-1][level, 0]
        into = pool[4][low:high]
        larger = sides[level % 2][:high - low]
        for k in range(len(into)):
            larger[k] = side[into[k]]
        side = larger
        level -= 1
        _improve(_graph(pool, level), side, space)
    return side


@compiled
def _coarsen(pool, level, most, attempt, space):
    """Merge nodes until no more than `most` are left; return the level of the last graph."""
    first, neighbour, heavy, weight, into, ends = pool
    total = ends[1, 0]
    while ends[level + 1, 0] - ends[level, 0] > most and level + 1 < _LEVELS:
        graph = _graph(pool, level)
        nodes, edges = ends[level + 1]
        if nodes + len(graph[3]) > len(into) or edges + len(graph[1]) > len(heavy):
            break
        own = into[ends[level, 0]:nodes]
        count = _match(graph, total, attempt, own, space)
        if count > _STUCK * len(own):
            break
        added = _merge(graph, own, count, first[nodes + level + 1:], neighbour[edges:],
                       heavy[edges:], weight[nodes:], space)
        level += 1
        ends[level + 1, 0], ends[level + 1, 1] = nodes + count, edges + added
    return level


@compiled
def _match(graph, total, attempt, into, space):
    """Write the merged node that each belongs to: heavy edges first; return how many there are."""
    start, adjacent, heavy, weight = graph
    n = len(weight)
    order = space[4][0][:n]
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
def _merge(graph, into, count, new_start, new_adjacent, new_heavy, new_weight, space):
    """Write the graph of the merged nodes; return how many neighbours they have."""
    start, adjacent, heavy, weight = graph
    members, place = space[4][:2], space[4][2]
    for c in range(count):
        members[0, c], place[c], new_weight[c] = -1, -1, 0
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
                    place[v], new_adjacent[at], new_heavy[at] = at, v, 0
                    at += 1
                new_heavy[place[v]] += heavy[edge]
        new_start[c + 1] = at
    return at


@compiled
def _first_cut(graph, sides, space):
    """Return the best of some cuts of a small graph, each grown around a node anywhere."""
    n, least, own, best = len(graph[3]), np.inf, 0, 1
    for attempt in range(_TRIES):
        side = sides[own][:n]
        _grow(graph, attempt * 7919 % n, side, space)
        _improve(graph, side, space)
        costs = _costs(graph, side)
        if costs < least:
            least, own, best = costs, best, own
    # Out of the way of those of larger graphs.
    for k in range(n):
        sides[2, k] = sides[best, k]
    return sides[2][:n]


@compiled
def _costs(graph, side):
    """Return the weight of the separator, a little more where it cuts unevenly."""
    left, right, between = 0, 0, 0
    for k in range(len(side)):
        if side[k] == _BETWEEN:
            between += graph[3][k]
        elif side[k] == _LEFT:
            left += graph[3][k]
        else:
            right += graph[3][k]
    return between * (1 + ((left - right) / (left + right + between)) ** 2)


@compiled
def _grow(graph, root, side, space):
    """Write a cut: half of the weight around a root, and the nodes behind that touch it."""
    start, adjacent, _, weight = graph
    queue, at, end, grown, other, total = space[4][1], 0, 0, 0, 0, 0
    for k in range(len(side)):
        side[k] = -1
        total += weight[k]
    while 2 * grown < total:
        if at == end:
            # Nothing more is tied to the root.
            k = root
            while side[k] >= 0:
                k, other = other, other + 1
            queue[end], side[k] = k, _RIGHT
            end += 1
        k = queue[at]
        at += 1
        side[k] = _LEFT
        grown += weight[k]
        for v in adjacent[start[k]:start[k + 1]]:
            if side[v] < 0:
                queue[end], side[v] = v, _BETWEEN
                end += 1
    for k in range(len(side)):
        if side[k] < 0:
            side[k] = _RIGHT


@compiled
def _improve(graph, side, space):
    """Move nodes out of the separator, and their neighbours into it, while it gets lighter."""
    weights, locked, total = space[5][0], space[2], 0
    weights[0] = weights[1] = weights[2] = 0
    for k in range(len(side)):
        weights[side[k]] += graph[3][k]
        total += graph[3][k]
        locked[k] = -1
    for turn in range(_PASSES):
        if not _pass(graph, side, space, _MOST * total, turn):
            break


@compiled
def _pass(graph, side, space, most, turn):
    """Do one pass of moves and undo those behind the best; False: it found nothing better."""
    heaps, locked, undo, counts = space[1], space[2], space[3], space[5]
    weights, size = counts[0], counts[1]
    size[0] = size[1] = 0
    for k in range(len(side)):
        if side[k] == _BETWEEN:
            _enter(k, graph, side, space)
    least, uneven = weights[2], abs(weights[0] - weights[1])
    done, kept, since = 0, 0, 0
    while since < _HOPE:
        to = _choose(graph, side, space, most, turn)
        if to < 0:
            break
        k = heaps[to, 0] & 0xffffffff
        locked[k] = turn
        done = _move(k, to, graph, side, space, done)
        since += 1
        now = abs(weights[0] - weights[1])
        if weights[2] < least or (weights[2] == least and now < uneven):
            least, uneven, kept, since = weights[2], now, done, 0
    _undo(graph[3], side, weights, undo, done, kept)
    return kept > 0


@compiled
def _move(k, to, graph, side, space, done):
    """Let a node leave to a side; what it touches on the other side comes in."""
    start, adjacent, _, weight = graph
    pulled, heaps, undo, weights, size = space[0], space[1], space[3], space[5][0], space[5][1]
    weights[2] -= weight[k]
    weights[to] += weight[k]
    side[k] = to
    undo[done] = k
    done += 1
    for v in adjacent[start[k]:start[k + 1]]:
        if side[v] == _BETWEEN:
            pulled[1 - to, v] += weight[k]
        elif side[v] == 1 - to:
            side[v] = _BETWEEN
            weights[1 - to] -= weight[v]
            weights[2] += weight[v]
            undo[done] = -1 - v
            done += 1
            _enter(np.int64(v), graph, side, space)
            for u in adjacent[start[v]:start[v + 1]]:
                if side[u] == _BETWEEN and u != v:
                    pulled[to, u] -= weight[v]
                    _push(heaps, size, to, np.int64(u), weight[u] - pulled[to, u])
    return done


@compiled
def _undo(weight, side, weights, undo, done, kept):
    """Take the moves behind `kept` back, the last one first: a node, and those it pulled in."""
    at = done
    while at > kept:
        first = at - 1
        while undo[first] < 0:
            first -= 1
        k = undo[first]
        to = side[k]
        for which in range(first + 1, at):
            v = -1 - undo[which]
            side[v] = 1 - to
            weights[2] -= weight[v]
            weights[1 - to] += weight[v]
        side[k] = _BETWEEN
        weights[to] -= weight[k]
        weights[2] += weight[k]
        at = first


@compiled
def _enter(k, graph, side, space):
    """Let a node that came into the separator wait for its turn to leave it."""
    start, adjacent, _, weight = graph
    pulled, heaps, size = space[0], space[1], space[5][1]
    pulled[0, k] = pulled[1, k] = 0
    for v in adjacent[start[k]:start[k + 1]]:
        if side[v] < _BETWEEN:
            pulled[1 - side[v], k] += weight[v]
    for to in range(2):
        _push(heaps, size, to, k, weight[k] - pulled[to, k])


@compiled
def _choose(graph, side, space, most, turn):
    """Return the side that the best node is to go to, -1: none may move."""
    weight = graph[3]
    pulled, heaps, locked, _, _, counts = space
    weights, size = counts[0], counts[1]
    best, highest = -1, 0
    for to in range(2):
        while size[to]:
            k, gain = heaps[to, 0] & 0xffffffff, heaps[to, 0] >> 32
            fits = weights[to] + weight[k] <= most or weights[to] < weights[1 - to]
            if (side[k] == _BETWEEN and locked[k] != turn and fits
                    and gain == weight[k] - pulled[to, k]):
                if best < 0 or gain > highest or (
                        gain == highest and weights[to] < weights[1 - to]):
                    best, highest = to, gain
                break
            _pop(heaps[to], size, to)
    return best


@compiled
def _push(heaps, size, to, k, gain):
    """Put a node into the heap of a side, the highest gain on top."""
    if size[to] == heaps.shape[1]:
        return
    heap, at = heaps[to], size[to]
    size[to] += 1
    entry = (np.int64(gain) << 32) | np.int64(k)
    while at and heap[(at - 1) // 2] < entry:
        heap[at] = heap[(at - 1) // 2]
        at = (at - 1) // 2
    heap[at] = entry


@compiled
def _pop(heap, size, to):
    """Take the top from the heap of a side."""
    size[to] -= 1
    entry, at, end = heap[size[to]], 0, size[to]
    while 2 * at + 1 < end:
        child = 2 * at + 1
        if child + 1 < end and heap[child + 1] > heap[child]:
            child += 1
        if heap[child] <= entry:
            break
        heap[at] = heap[child]
        at = child
    heap[at] = entry
