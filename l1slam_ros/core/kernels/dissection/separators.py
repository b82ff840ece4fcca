# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Which nodes hold two halves of a graph together: a cut of a small graph, brought to larger ones.

Each graph gets the cut of the one that was merged of it (`coarsening`), moved node by node while
that makes the separator lighter.

Source: Fiduccia and Mattheyses, "A linear-time heuristic for improving network partitions" (1982),
for the moves, here of separators.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop
from l1slam_ros.core.kernels.dissection.coarsening import POOL

# The types of the memory to work in, see `cut`.
SPACE = 'Tuple((i4[:, ::1], i8[:, ::1], i4[::1], i4[::1], i8[:, ::1]))'
# So many cuts are made of a smallest graph.
_TRIES = 2
# Passes of moves over each graph, and moves that one goes on without a lighter separator.
_PASSES, _HOPE = 3, 100
# No side may be a larger share of what is cut. Of a sphere it pays to cut off a cap.
_MOST = 0.72
# The sides of a cut, and what is between.
_LEFT = 0
_RIGHT = 1
_BETWEEN = 2


@loop('(' + POOL + ', i8, i8, f8, i4[:, ::1], ' + SPACE + ')')
def cut(pool, level, to, least, sides, space):
    """
    Cut a small graph and bring its cut back to a larger one; return what the lightest costs.

    pool : see `coarsening.take_part`; level, to : of the small graph and of the larger one
    least : what the cut of that graph in sides[3] costs; it is replaced if the new one costs less
    sides : (4, n), memory for the sides of each node in four graphs
    space : what each node in the separator would pull into it, to either side; those that wait, by
        gain; in which pass each was moved; all moves; the weight of each side, and how many wait
    """
    side = _first_cut(_graph(pool, level), sides, space)
    side = _back(pool, level, to, side, sides, space)
    costs = _costs(_graph(pool, to), side)
    if costs < least:
        least = costs
        for k in range(len(side)):
            sides[3, k] = side[k]
    return least


@loop('(' + POOL + ', i8, i4[:, ::1], ' + SPACE + ')')
def separate(pool, level, sides, space):
    """Bring the cut in sides[3] back to the first graph; return the side of each of its nodes."""
    return _back(pool, level, 0, sides[3][:len(_graph(pool, level)[3])], sides, space)


@compiled
def _graph(pool, level):
    """Return a graph of the pool: start, adjacent, weights of neighbours and of nodes."""
    first, neighbour, heavy, weight, _, ends = pool
    low, high = ends[level], ends[level + 1]
    return (first[low[0] + level:high[0] + level + 1], neighbour[low[1]:high[1]],
            heavy[low[1]:high[1]], weight[low[0]:high[0]])


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
def _first_cut(graph, sides, space):
    """Return the best of some cuts of a small graph, each grown around a node anywhere."""
    n = len(graph[3])
    least = np.inf
    own = 0
    best = 1
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
    left = 0
    right = 0
    between = 0
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
    queue = space[3]
    at = 0
    end = 0
    grown = 0
    other = 0
    total = 0
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
    weights = space[4][0]
    locked = space[2]
    total = 0
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
    heaps = space[1]
    locked = space[2]
    undo = space[3]
    counts = space[4]
    weights, size = counts[0], counts[1]
    size[0] = size[1] = 0
    for k in range(len(side)):
        if side[k] == _BETWEEN:
            _enter(k, graph, side, space)
    least, uneven = weights[2], abs(weights[0] - weights[1])
    done = 0
    kept = 0
    since = 0
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
            least = weights[2]
            uneven = now
            kept = done
            since = 0
    _undo(graph[3], side, weights, undo, done, kept)
    return kept > 0


@compiled
def _move(k, to, graph, side, space, done):
    """Let a node leave to a side; what it touches on the other side comes in."""
    start, adjacent, _, weight = graph
    pulled = space[0]
    heaps = space[1]
    undo = space[3]
    weights = space[4][0]
    size = space[4][1]
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
    pulled = space[0]
    heaps = space[1]
    size = space[4][1]
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
    pulled, heaps, locked, _, counts = space
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
    entry = heap[size[to]]
    at = 0
    end = size[to]
    while 2 * at + 1 < end:
        child = 2 * at + 1
        if child + 1 < end and heap[child + 1] > heap[child]:
            child += 1
        if heap[child] <= entry:
            break
        heap[at] = heap[child]
        at = child
    heap[at] = entry
