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
the cut of the one below it, made better. The loops of both are compiled, what goes through the
parts is not.

Source: Karypis and Kumar, "A fast and high quality multilevel scheme for partitioning irregular
graphs" (1998).
"""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.kernels.dissection import coarsening, separators

Places = NDArray[np.int32]

# Parts of no more nodes are not cut: minimum degree orders them as well. Nor are those of which a
# separator would be so large a share.
_WHOLE, _CUT = 120, 0.3
# Of a part of more than so many nodes so many cuts are made, each of a graph that is so many times
# smaller, by merging on in different ways. One cut alone costs a third more work; most of the work
# is in the separators of large parts, most of the time to find them goes to small ones.
_CUTS = (2000, 7), (500, 4), (0, 3)
_SMALLER = 5
# An order whose separators promise so many times the work of another's is not tried: levels of
# grids promise .4 to .7 of it and do .6 to 1, of a torus in space .9 and 1.2, of streets and towns
# 1.3 to 2.6 and 1.8 to 2.2.
_WORSE = 1.2
# The merged graphs of a part may have so many times its own nodes and edges together, and are so
# many at most.
_ROOM, _LEVELS = 4, 64


def is_promising(stages: list[Places]) -> bool:
    """
    Tell whether the last stages (n,) of nodes are worth an order by minimum degree.

    That takes longer than to find them. They are not where their separators promise more work
    than those of the first ones.
    """
    return len(stages) < 2 or _promised_work(stages[-1]) <= _WORSE * _promised_work(stages[0])


def _promised_work(stage: Places) -> float:
    """Return the cubes of all separators, as if those of a stage were of one size."""
    nodes = np.bincount(stage)[:0:-1].astype(float)
    parts = 2.0 ** np.arange(len(nodes))
    return float((nodes**3 / parts**2).sum())


def dissect(start: Places, adjacent: Places) -> Places:
    """
    Return the stage of each node, (n,): the higher, the later it is to be eliminated.

    start, adjacent : as of `ordering.minimum_degree`
    """
    n = len(start) - 1
    depth, part = np.zeros(n, np.int32), np.zeros(n, np.int32)
    local, nodes = np.empty(n, np.int32), np.arange(n, dtype=np.int32)
    memory = _Memory(n, len(adjacent))
    parts, number = [(0, n, 1)], 0
    while parts:
        low, high, below = parts.pop()
        if high - low <= _WHOLE:
            continue
        number += 1
        own = nodes[low:high]
        coarsening.take_part(own, number, start, adjacent, part, local, memory.pool)
        side = memory.cut(len(own))
        left, right, between = np.bincount(side, minlength=3).tolist()
        if between > _CUT * len(own) or not left or not right:
            continue
        own[:] = own[np.argsort(side, kind='stable')]
        depth[own[left + right:]] = below
        parts += (low, low + left, below + 1), (low + left, high - between, below + 1)
    stage: Places = np.where(depth > 0, depth.max(initial=0) + 1 - depth, 0).astype(np.int32)
    return stage


class _Memory:
    """
    What all parts share.

    pool, lists : see `coarsening`; sides, space : see `separators.cut`.
    """

    def __init__(self, n: int, edges: int):
        self.pool = (*(np.empty(size, np.int32) for size in (
            _ROOM * n + _LEVELS, _ROOM * edges, _ROOM * edges, _ROOM * n, _ROOM * n)),
            np.zeros((_LEVELS + 1, 2), np.int64))
        self._lists, self._sides = np.empty((3, n), np.int32), np.empty((4, n), np.int32)
        self._space = (np.empty((2, n), np.int32), np.empty((2, n + edges), np.int64),
                       np.empty(n, np.int32), np.empty(n + edges, np.int32),
                       np.empty((2, 3), np.int64))

    def cut(self, size: int) -> Places:
        """Return the side of each node of the pool's first graph: left 0, right 1, between 2."""
        top = coarsening.coarsen(self.pool, self._lists, 0, size // _SMALLER, 0)
        least = np.inf
        for attempt in range(next(cuts for most, cuts in _CUTS if size > most)):
            bottom = coarsening.coarsen(self.pool, self._lists, top, 0, attempt)
            least = separators.cut(self.pool, bottom, top, least, self._sides, self._space)
        side: Places = separators.separate(self.pool, top, self._sides, self._space)
        return side
