# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A drift of the heading: each metre of the odometry turns by some angle too little.

In: a graph, and the robust states that its odometry leads to with and without a drift. Out: the
odometry without it, and the log evidence of each drift. Wheels of unequal size or the offset of a
gyroscope cause one. In space the heading is about the vertical axis of the robot.

`drift_likelihood` proposes drifts, for laps that close also those with a full turn more on each
lap. So a map is solved with each, and the one with the largest evidence is taken. Where another
one is nearly as likely, the map is doubtful.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import whiten
from l1slam_ros.core.graph.factor_graph import BetweenFactors, FactorGraph
from l1slam_ros.core.robust.innovation import claimed_volume, factorised, log_claims
from l1slam_ros.core.robust.odometry.drift_likelihood import HEADING, USUAL
from l1slam_ros.core.robust.odometry.hypotheses import Hypothesis
from l1slam_ros.core.robust.rounds.evidence import TWO_PLACES
from l1slam_ros.core.robust.rounds.growth import Growth
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import l2_map


def straightened(graph: FactorGraph, drift: float) -> FactorGraph:
    """Return a graph with `drift` added to the turn of each metre of odometry."""
    if not drift:
        return graph
    other = graph.subset(np.arange(len(graph.between)))
    factors = other.between
    rows = np.flatnonzero(other.between.is_odometry)
    factors.measurement[rows] = corrected(factors, rows, drift)
    return other


def corrected(factors: BetweenFactors, rows: Indices, drift: float) -> Array:
    """Return the measurements of odometry factors without a drift, (k, p)."""
    measured = factors.measurement[rows]
    step = np.zeros((len(rows), factors.sqrt_information.shape[1]))
    step[:, HEADING] = drift * _way(factors, rows)
    return _manifold(measured).retract(measured, step)


def correction(factors: BetweenFactors, rows: Indices, made: Array) -> float:
    """Return the drift [rad/m] for which `corrected` returns `made`, (k, p); none: 0."""
    turn = _manifold(made).local(factors.measurement[rows], made)[:, HEADING]
    way = _way(factors, rows)
    return float(turn @ way / (way @ way)) if way.any() else 0.0


def _manifold(poses: Array) -> Manifold:
    return se2 if poses.shape[1] == se2.POSE_SIZE else se3


def _way(factors: BetweenFactors, rows: Indices) -> Array:
    """Return the length of odometry factors [m], (k,), negative for those backwards in time."""
    along = np.where(factors.i[rows] < factors.j[rows], 1.0, -1.0)
    return along * np.hypot(*factors.measurement[rows, :2].T)


def drift_turn(factors: BetweenFactors, rows: Indices) -> Array:
    """Return the derivative of odometry residuals by the drift, whitened, (k, d)."""
    turn = np.zeros((len(rows), factors.sqrt_information.shape[1]))
    turn[:, HEADING] = np.hypot(*factors.measurement[rows, :2].T)
    return whiten(factors.sqrt_information[rows], turn)


@dataclass(frozen=True)
class Straight:
    """
    The states that odometry without a drift leads to.

    drift : [rad/m]; found, as_stated : with the estimated noise, and with the larger of this and
    the stated one.
    """

    drift: float
    found: Growth
    as_stated: Growth

    @cached_property
    def log_room(self) -> float:
        """The ln of the volume of the claims of an outlier on this map."""
        growth = self.as_stated
        return float(claimed_volume(growth.given.graph.manifold, growth.poses).sum())

    @cached_property
    def log_evidence(self) -> float:
        """
        Return ln p(loops as inliers | odometry) / p(loops as outliers), one loop a place.

        A loop alone at its place is one of many that could have fitted by chance. The drift has a
        normal prior about 0, and the map estimates it with information S: Laplace's approximation
        of the integral over it.
        """
        growth = self.as_stated
        alone = np.count_nonzero(np.bincount(growth.given.place[self.loops]) == 1)
        known = np.log1p(USUAL**2 * drift_information(growth)) if self.drift else 0.0
        return float(
            _log_likelihood(growth, self._one_each) + len(self._one_each) * self.log_room
            - alone * np.log(len(growth.given.factors)) - ((self.drift / USUAL)**2 + known) / 2)

    @cached_property
    def stretches(self) -> float:
        """The number of stretches along which loops are, less that of places."""
        one, other = self.as_stated.given.mates
        loops = np.isin(np.arange(len(self.as_stated.accepted)), self.loops)
        near = np.bincount(one, loops[other], len(loops))[loops]
        return float((1 / (1 + near)).sum()) - len(self._one_each)

    @cached_property
    def _one_each(self) -> Indices:
        place = self.as_stated.given.place[self.loops]
        return np.asarray(self.loops[np.unique(place, return_index=True)[1]])

    @cached_property
    def loops(self) -> Indices:
        """The loops that are accepted, (k,)."""
        return np.asarray(np.flatnonzero(self.as_stated.loops))


def hypotheses_of(some: list[Straight]) -> list[Hypothesis]:
    """
    Return the drifts that explain loops, against the first state, that without a drift.

    The longer the stretches along which places are, the larger is the map: on a smaller one there
    would be more such places than loops were found at. Where loops are explained without a drift,
    another one has to be likelier by `margin_of`.
    """
    widest = max(straight.log_room for straight in some)
    values = [straight.log_evidence + straight.stretches * (straight.log_room - widest)
              for straight in some]
    least = values[0] + (margin_of(some[0].as_stated) if len(some[0].loops) else 0.0)
    return [Hypothesis(straight.found, value - least, straight.drift)
            for straight, value in zip(some[1:], values[1:], strict=True) if len(straight.loops)]


def margin_of(growth: Growth) -> float:
    """Return ln of the odds by which one drift has to be likelier than another: two places."""
    return TWO_PLACES * growth.given.log_odds_of_place


def _log_likelihood(growth: Growth, loops: Indices) -> float:
    """
    Return ln p(loops as inliers | odometry), of some loops, (k,).

    With the Jacobian J and the residuals r of both, whitened by roots U of information, H = J'J:

        sum over loops (ln det U - 3/2 ln 2 pi) - (r'r + ln det H - ln det H_odometry) / 2
    """
    graph = growth.subgraph(np.union1d(
        np.flatnonzero(growth.accepted & ~growth.given.is_loop), loops))
    cholesky = cholesky_of(graph)
    system = factorised(graph, l2_map(graph, growth.poses, cholesky), cholesky)
    numbers = growth.given.factors.freedom[loops].sum()
    square = float(system.b @ system.b) + numbers * np.log(2 * np.pi) + cholesky.log_det()
    no_volume = np.zeros(graph.manifold.TANGENT_SIZE)
    return float(log_claims(graph.between, no_volume).sum() - square / 2)


def drift_information(growth: Growth) -> float:
    """Return the information of a map on the drift of its odometry, the inverse of a variance."""
    accepted = np.flatnonzero(growth.accepted)
    rows = np.flatnonzero(~(growth.given.is_loop | growth.cut)[accepted])
    turn = drift_turn(growth.given.factors, accepted[rows]) / np.sqrt(growth.noise.assumed[0])
    by_noise = np.einsum('mi,miq->q', turn, growth.posterior.left_over(rows))
    return float((by_noise**2).mean())
