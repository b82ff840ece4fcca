# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A heading that drifts: each metre of the odometry turns by some angle too little.

In: a graph in the plane, and the states that its odometry leads to with and without a drift. Out:
the odometry without it, and which drift is to be believed. Wheels of unequal size, or a gyroscope
with an offset, do that.

`drift_likelihood` proposes drifts. Of laps that close also those by which each has a full turn
more, so a map is made by each: the one by which the loops are likeliest is taken. Where another
one is nearly as likely, the map is doubtful.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import whiten
from l1slam_ros.core.graph.factor_graph import BetweenFactors, FactorGraph
from l1slam_ros.core.robust.innovation import claimed_volume, factorised, log_claims
from l1slam_ros.core.robust.odometry.drift_likelihood import USUAL
from l1slam_ros.core.robust.rounds.evidence import TWO_PLACES
from l1slam_ros.core.robust.rounds.growth import Growth
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import l2_map


def straightened(graph: FactorGraph, drift: float) -> FactorGraph:
    """Return a graph in the plane, each step of whose odometry turns by `drift` more a metre."""
    if not drift:
        return graph
    other = graph.subset(np.arange(len(graph.between)))
    factors = other.between
    rows = np.flatnonzero(other.between.is_odometry)
    factors.measurement[rows] = corrected(factors, rows, drift)
    return other


def corrected(factors: BetweenFactors, rows: Indices, drift: float) -> Array:
    """Return what some odometry factors in the plane measured, without its drift, (k, 3)."""
    measured = factors.measurement[rows]
    step = np.zeros((len(rows), 3))
    step[:, 2] = drift * _way(factors, rows)
    return se2.retract(measured, step)


def correction(factors: BetweenFactors, rows: Indices, made: Array) -> float:
    """Return the drift [rad/m] for which `corrected` returns `made`, (k, 3); none: 0."""
    turn, way = se2.local(factors.measurement[rows], made)[:, 2], _way(factors, rows)
    return float(turn @ way / (way @ way)) if way.any() else 0.0


def _way(factors: BetweenFactors, rows: Indices) -> Array:
    """Return how far some odometry factors lead [m], (k,), below 0 of those backwards in time."""
    along = np.where(factors.i[rows] < factors.j[rows], 1.0, -1.0)
    return along * np.hypot(*factors.measurement[rows, :2].T)


def drift_turn(factors: BetweenFactors, rows: Indices) -> Array:
    """Return by how much some odometry factors turn for a drift of 1 rad/m, whitened, (k, 3)."""
    turn = np.zeros((len(rows), 3))
    turn[:, 2] = np.hypot(*factors.measurement[rows, :2].T)
    return whiten(factors.sqrt_information[rows], turn)


@dataclass(frozen=True)
class Straight:
    """
    What odometry without a drift leads to.

    drift : it [rad/m]; found, told : the states with the noise as it was found, and where all may
    be as noisy as they say.
    """

    drift: float
    found: Growth
    told: Growth

    @cached_property
    def log_room(self) -> float:
        """The ln of the volume that a lie could claim on this map, in its units."""
        return float(claimed_volume(se2, self.told.poses).sum())

    @cached_property
    def log_evidence(self) -> float:
        """
        Return ln p(loops if they are true | odometry) / p(loops if they are lies), one a place.

        A loop alone at its place is one of many that could have fitted by chance. A drift d is
        normal about none, and the map tells it as well as S, the inverse of a variance: of the
        density of both the integral is left (P.-S. Laplace).
        """
        growth = self.told
        alone = np.count_nonzero(np.bincount(growth.given.place[self.loops]) == 1)
        known = np.log1p(USUAL**2 * drift_information(growth)) if self.drift else 0.0
        return float(
            _log_likelihood(growth, self._one_each) + len(self._one_each) * self.log_room
            - alone * np.log(len(growth.given.factors)) - ((self.drift / USUAL)**2 + known) / 2)

    @cached_property
    def stretches(self) -> float:
        """Along how many stretches more than places loops are."""
        one, other = self.told.given.mates
        loops = np.isin(np.arange(len(self.told.accepted)), self.loops)
        near = np.bincount(one, loops[other], len(loops))[loops]
        return float((1 / (1 + near)).sum()) - len(self._one_each)

    @cached_property
    def _one_each(self) -> Indices:
        place = self.told.given.place[self.loops]
        return np.asarray(self.loops[np.unique(place, return_index=True)[1]])

    @cached_property
    def loops(self) -> Indices:
        """The loops that are accepted, (k,)."""
        return np.asarray(np.flatnonzero(self.told.loops))


def likeliest(some: list[Straight]) -> tuple[Straight, float, float]:
    """
    Return the likeliest of some drifts, by how much more a rival drifts, and ln of its odds.

    The rival is 0 [rad/m] where there is none; the odds are those against all rivals together.

    The first one is that without a drift. Where it explains loops, too, another has to be likelier
    by what two places are worth, and a rival of a drift is less likely by no more than that.

    The longer a place is, the larger is the map: on a smaller one there would be more such places
    than loops were found at.
    """
    widest = max(straight.log_room for straight in some)
    values = np.array([straight.log_evidence + straight.stretches * (straight.log_room - widest)
                       for straight in some])
    sure = TWO_PLACES * some[0].told.given.log_odds_of_place
    if len(some[0].loops):
        values[0] += sure
    first = int(np.argmax(values))
    less = values[first] - values
    rivals = [(less[k], other.drift - some[first].drift) for k, other in enumerate(some)
              if less[k] < sure and k and len(other.loops) and other.drift != some[first].drift]
    if not first or not rivals:
        return some[first], 0.0, np.inf
    return some[first], min(rivals)[1], -float(np.logaddexp.reduce([-less for less, _ in rivals]))


def _log_likelihood(growth: Growth, loops: Indices) -> float:
    """
    Return the ln of how likely some loops, (k,), are if they are true, by the odometry.

    With the Jacobian J and the residuals r of both, whitened by roots of information U, H = J'J:

        sum over loops (ln det U - 3/2 ln 2 pi) - (r'r + ln det H - ln det H_odometry) / 2
    """
    graph = growth.subgraph(np.union1d(
        np.flatnonzero(growth.accepted & ~growth.given.is_loop), loops))
    cholesky = cholesky_of(graph)
    system = factorised(graph, l2_map(graph, growth.poses, cholesky), cholesky)
    numbers = growth.given.factors.freedom[loops].sum()
    square = float(system.b @ system.b) + numbers * np.log(2 * np.pi) + cholesky.log_det()
    return float(log_claims(graph.between, np.zeros(3)).sum() - square / 2)


def drift_information(growth: Growth) -> float:
    """Return what a map says of the drift of its odometry, as the inverse of a variance."""
    accepted = np.flatnonzero(growth.accepted)
    rows = np.flatnonzero(~(growth.given.is_loop | growth.cut)[accepted])
    turn = drift_turn(growth.given.factors, accepted[rows]) / np.sqrt(growth.noise.assumed[0])
    by_noise = np.einsum('mi,miq->q', turn, growth.posterior.left_over(rows))
    return float((by_noise**2).mean())
