# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The prepared graph of a robust solve, which no round changes.

In: a graph. Out: its factors with the earlier keyframe first, and one for each gap of the
odometry; which factors are loops, and their places.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import BetweenFactors, FactorGraph, turned
from l1slam_ros.core.graph.parts import as_sure, bridged, vague_odometry
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.robust.innovation import BY_CHANCE, stated_variance, student_quantile
from l1slam_ros.core.robust.places import mates, places

# A place may have one error, but two hardly agree by chance: two join parts, and a hypothesis less
# likely by no more than two places is a rival. Noise is estimated, and slips suspected, from
# FEWEST_PLACES at least. A place across more than this part of the keyframes has no single error.
# Of 89 runs joining by 4 places makes 3 worse; noise from 6 changes 3, slips from 2 or 6 none,
# none worse; twice the part makes 1 worse.
TWO_PLACES, FEWEST_PLACES = 2, 3
_SMALL = 0.5


@dataclass(frozen=True)
class Evidence:
    """
    The prepared graph of a robust solve.

    Attributes
    ----------
    graph : earlier keyframes first, with an odometry factor for each gap
    size : number of given factors
    chain : (n, p) poses along the odometry
    is_loop : (m,) bool of the between factors
    gap : (m,) bool, odometry without information
    place, mates : (m,), pairs of loops, see `places`
    stated : (2,) stated variance of odometry and loops

    """

    graph: FactorGraph
    size: int
    chain: Array
    is_loop: Mask
    gap: Mask
    place: Indices
    mates: tuple[Indices, Indices]
    stated: Array

    @property
    def factors(self) -> BetweenFactors:
        """All between factors, m."""
        return self.graph.between

    @property
    def trusted(self) -> Mask:
        """(m,) bool: factors a person vouches for."""
        return self.factors.trusted

    @property
    def low(self) -> Indices:
        """(m,) the earlier keyframe of each factor."""
        return self.factors.i

    @property
    def high(self) -> Indices:
        """(m,) the later keyframe of each factor."""
        return self.factors.j

    @property
    def is_step(self) -> Mask:
        """(m,) bool: odometry, without sightings that place landmarks."""
        return np.asarray(~self.is_loop & ~self.graph.is_landmark[self.high])

    def spanning(self, step: int) -> Mask:
        """Return which loops span an odometry factor, (m,) bool."""
        span: Mask = self.is_loop & (self.low < self.high[step]) & (self.high > self.low[step])
        return span

    def gate(self, freedom: Indices, refused: float = BY_CHANCE) -> Array:
        """Return the bound on squared innovations of inliers, (m,), by freedom (m,)."""
        return student_quantile(1 - refused, freedom, self.graph.manifold.TANGENT_SIZE)

    @property
    def log_odds_of_place(self) -> float:
        """Log odds that a place contributes: half a gate."""
        return float(self.gate(np.array([self.graph.manifold.TANGENT_SIZE]))[0] / 2)

    def count_places(self, loops: Indices | Mask) -> int:
        """Return the number of places of some loops."""
        return len(np.unique(self.place[loops]))

    def may_err_as_one(self, loops: Indices, fewest: int = FEWEST_PLACES) -> bool:
        """Return whether loops are from fewer places, none of which spans much of the path."""
        place = self.place[loops]
        each = (loops[place == number] for number in np.unique(place))
        return self.count_places(loops) < fewest and all(
            np.ptp(self.low[own]) + np.ptp(self.high[own]) < _SMALL * self.graph.n_poses
            for own in each)


def evidence_of(graph: FactorGraph) -> Evidence:
    """Return the prepared graph."""
    size = len(graph.between)
    whole = bridged(graph)
    # Results must not depend on the end that is named first.
    in_order = turned(whole, whole.between.i > whole.between.j)
    gap: Mask = vague_odometry(in_order) | (np.arange(len(whole.between)) >= size)
    # A gap keeps its sides in place, see `Growth.subgraph`. With as little information as may be
    # stated, rounding would turn a long part about it.
    graph = as_sure(in_order, gap)
    chain = odometry_poses(graph)
    is_loop: Mask = ~graph.between.is_odometry
    place, ends = places(graph, chain)
    loops = np.flatnonzero(is_loop)
    one, other = mates(place[loops], ends[loops])
    return Evidence(graph, size, chain, is_loop, gap, place, (loops[one], loops[other]),
                    stated_variance(graph.between))
