# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Poses of some frame of their own -> poses in the frame of the world.

In: a graph with absolute factors, and poses that its other factors hold together. Out: the same,
each part moved as one. It is a start: nothing is bent, and a few false fixes do not matter.
"""

import numpy as np

from l1slam_ros.core.geometry.alignment import align
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import whiten
from l1slam_ros.core.graph.factor_graph import FactorGraph, lowest_joined

# What is in its place stays there: else the cost falls to less than this part.
_BETTER = 0.8
# So many of the absolute factors, and of tuples of them, say where a part may be.
_ASKED = 200


def placed(graph: FactorGraph, poses: Array) -> Array:
    """
    Return poses (n, p), each part moved as one to where its absolute factors say it is.

    A part is what other factors join. Of the motions that single absolute factors or a few
    positions ask for, it is that of the lowest L1 cost; none where that is hardly lower.
    """
    is_absolute = graph.between.is_absolute
    if not is_absolute.any():
        return poses
    part_of = lowest_joined(graph.subset(~is_absolute))[:-1]
    tied = part_of[graph.between.j]
    poses = poses.copy()
    for part in np.unique(tied[is_absolute]):
        rows = np.flatnonzero(is_absolute & (tied == part))
        inside = part_of == part
        rows = rows[:: -(-len(rows) // _ASKED)]
        motion = _best_motion(graph.subset(rows), poses)
        poses[inside] = graph.manifold.compose(
            np.broadcast_to(motion, poses[inside].shape), poses[inside])
    return poses


def _best_motion(graph: FactorGraph, poses: Array) -> Array:
    """Return how a part with these absolute factors alone is best moved, (1, p)."""
    manifold, factors = graph.manifold, graph.between
    here = poses[factors.j]
    speaks = factors.speaks
    there = manifold.retract(here, speaks * manifold.local(here, factors.measurement))
    motions = np.concatenate((
        manifold.identity(1), manifold.compose(there, manifold.inverse(here)),
        _motions_of_positions(graph, poses)))
    m, count = len(factors), len(motions)
    moved = manifold.compose(np.repeat(motions, m, axis=0), np.tile(here, (count, 1)))
    e = manifold.local(np.tile(factors.measurement, (count, 1)), moved)
    cost = np.abs(whiten(np.tile(factors.sqrt_information, (count, 1, 1)), e))
    costs = cost.reshape(count, -1).sum(axis=1)
    best = int(np.argmin(costs))
    best = best if costs[best] < _BETTER * costs[0] else 0
    return motions[best:best + 1]


def _motions_of_positions(graph: FactorGraph, poses: Array) -> Array:
    """Return the motions that tuples of positions ask for, neighbours and far ones, (k, p)."""
    manifold, factors = graph.manifold, graph.between
    rows = np.flatnonzero(factors.speaks[:, manifold.TRANSLATION].all(axis=1))
    here = manifold.positions(poses[factors.j[rows]])
    there = manifold.positions(factors.measurement[rows])
    size = here.shape[1]
    m = len(rows)
    if m < 2:
        return manifold.identity(0)
    # Each of them with those so many strides on, round in a circle.
    tuples = np.concatenate([(np.arange(m)[:, None] + stride * np.arange(size)) % m
                             for stride in {1, max(m // size, 1)}])
    return manifold.from_rotation(*align(here[tuples], there[tuples]))
