# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Graphs with lies in them, drawn by a seed.

In: a place, a kind of `kinds`, a share, a seed. Out: `FalseCase`, a graph and which of its loops
are false, and what its map is to be compared with.
"""

from dataclasses import dataclass, replace

import numpy as np
from robust.changes import changed
from robust.kinds import EXCUSES, KINDS, Bar, Kind
from robust.places import Place
from robust.variants import VARIANTS

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.spanning_tree import odometry_poses, pair_key
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS, insert_loops


@dataclass(frozen=True)
class FalseCase:
    """
    A graph with lies.

    graph : all of it; is_false, is_true : (m,) bool, its loops, neither where nobody knows;
    clean : the graph whose map is to be found; slips : rows of the odometry factors that lie;
    session : (n,) the part each keyframe is of, where nothing says how the parts lie to each
    other; start : (n, p) the odometry, the second of two sessions anywhere; bar : to pass.
    """

    place: Place
    kind: Kind
    share: float
    seed: int
    graph: FactorGraph
    is_false: Mask
    is_true: Mask
    clean: FactorGraph
    slips: Indices
    session: Indices
    start: Array
    bar: Bar


def false_case(place: Place, kind: Kind, share: float, seed: int) -> FalseCase:
    """Return a graph of which `share` of all loops are false; count = true share / (1 - share)."""
    rng = np.random.default_rng((seed, KINDS.index(kind), round(100 * share)))
    if kind.change in VARIANTS:
        place, kind = VARIANTS[kind.change](place, *kind.amounts), replace(kind, change='')
    change = changed(place, kind.change, kind.amounts, rng)
    graph, n = change.graph, change.graph.n_poses
    start, session = odometry_poses(graph), np.zeros(n, bool)
    false, true = (_pairs(place.graph)[rows] for rows in (place.is_false, place.is_true))
    more = [] if change.lies is None else [change.lies]
    if kind.lies:
        count = round(np.count_nonzero(~graph.between.is_odometry) * share / (1 - share))
        more.append(FALSE_LOOPS[kind.lies](graph, place.best, count, rng))
    for lies in more:
        graph = insert_loops(graph, lies)
        false = np.concatenate((false, pair_key(lies.i, lies.j, n)))
    if change.cut:
        second = np.arange(n) >= change.cut
        graph = graph.subset(~(_steps(graph) == change.cut - 1))
        start = np.where(second[:, None], _elsewhere(graph, start, rng), start)
        session = second & (not change.joined)
    pairs, is_loop = _pairs(graph), ~graph.between.is_odometry
    is_false = is_loop & np.isin(pairs, false)
    clean, bar = change.clean, kind.bar_at(place.name, share)
    told = clean.between.is_odometry | ~np.isin(_pairs(clean), false)
    return FalseCase(
        place, kind, share, seed, graph, is_false, is_loop & np.isin(pairs, true) & ~is_false,
        clean.subset(told), np.flatnonzero(np.isin(_steps(graph), change.steps)),
        session.astype(np.int64), start,
        replace(bar, doubt=EXCUSES) if change.outnumbered else bar)


def _pairs(graph: FactorGraph) -> Indices:
    return pair_key(graph.between.i, graph.between.j, graph.n_poses)


def _steps(graph: FactorGraph) -> Indices:
    """Return the earlier keyframe of each odometry factor, -1 of each loop, (m,)."""
    factors = graph.between
    return np.where(factors.is_odometry, np.minimum(factors.i, factors.j), -1)


def _elsewhere(graph: FactorGraph, poses: Array, rng: np.random.Generator) -> Array:
    """Return poses (n, p) in some other frame."""
    tangent = 10 * rng.standard_normal((1, graph.manifold.TANGENT_SIZE))
    frame = graph.manifold.retract(graph.manifold.identity(1), tangent)
    return graph.manifold.compose(np.broadcast_to(frame, poses.shape), poses)
