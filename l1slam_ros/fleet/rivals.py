# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Another place where one input could lie, as refused loops between two inputs have it.

In: a solved graph, and which of its factors are believed. Out: a doubt for each two inputs whose
refused loops agree with each other, and are not far fewer than those that are believed: two halves
of a symmetric building look alike, and what joins two drives knows no better.
"""

from collections.abc import Iterator

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.judgement import OTHER_MAP, Doubt, listed

# Loops agree where they put the second input within so far of each other [m], [rad].
_NEAR, _TURN = 1.0, 0.2
# So many at least, and so large a part of those that are believed, may be right instead.
_FEWEST = 3
_PART = 1 / 3
# Of so many of them, evenly chosen, the neighbours are counted.
_CENTRES = 500


def rival_doubts(graph: FactorGraph, poses: Array, accepted: Mask,
                 of_input: Indices) -> tuple[Doubt, ...]:
    """
    Return a doubt for each two inputs that refused loops join in another way.

    Parameters
    ----------
    graph, poses : the graph and its map, (n, p)
    accepted : (m,) bool, of the factors
    of_input : (n,) the input that each keyframe is of

    """
    return tuple(_doubts(graph, poses, accepted, of_input))


def _doubts(graph: FactorGraph, poses: Array, accepted: Mask,
            of_input: Indices) -> Iterator[Doubt]:
    factors = graph.between
    ends = np.sort(of_input[factors.pairs], axis=1)
    between = (ends[:, 0] != ends[:, 1]) & ~factors.struck
    for pair in np.unique(ends[between], axis=0):
        own = between & (ends == pair).all(axis=1)
        believed = int((own & accepted).sum())
        refused = np.flatnonzero(own & ~accepted)
        if len(refused) < max(_FEWEST, _PART * believed):
            continue
        agree = refused[_largest_group(graph, _placed(graph, poses, refused, of_input))]
        if len(agree) >= max(_FEWEST, _PART * believed):
            pairs = factors.pairs[agree]
            yield Doubt(OTHER_MAP, len(agree), int(pairs.min()), int(pairs.max()),
                        pairs=listed(pairs))


def _placed(graph: FactorGraph, poses: Array, rows: Indices, of_input: Indices) -> Array:
    """Return where each loop has the middle of the later input, in the map, (k, p)."""
    manifold, factors = graph.manifold, graph.between
    i = factors.i[rows]
    j = factors.j[rows]
    Z = factors.measurement[rows]
    turned = of_input[i] > of_input[j]
    Z = np.where(turned[:, None], manifold.inverse(Z), Z)
    i, j = np.where(turned, j, i), np.where(turned, i, j)
    later = np.flatnonzero(of_input == of_input[j[0]])
    middle = poses[later[np.argmin(np.linalg.norm(
        manifold.positions(poses[later]) - manifold.positions(poses[later]).mean(axis=0),
        axis=1))]]
    seen = manifold.between(poses[j], np.broadcast_to(middle, poses[j].shape))
    return manifold.compose(manifold.compose(poses[i], Z), seen)


def _largest_group(graph: FactorGraph, places: Array) -> Indices:
    """Return the most of some places (k, p) that are near one of them."""
    best = np.zeros(0, np.int64)
    for centre in places[:: max(len(places) // _CENTRES, 1)]:
        length, angle = graph.manifold.motion(
            graph.manifold.between(np.broadcast_to(centre, places.shape), places))
        near = np.flatnonzero((length < _NEAR) & (angle < _TURN))
        best = near if len(near) > len(best) else best
    return best
