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
more, so a map is made by each: the one that wins most places with the least noise is taken. Where
another one is nearly as likely, the map is doubtful.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import whiten
from l1slam_ros.core.graph.factor_graph import BetweenFactors, FactorGraph
from l1slam_ros.core.robust.odometry.drift_likelihood import USUAL, log_prior
from l1slam_ros.core.robust.rounds.evidence import TWO_PLACES, Evidence
from l1slam_ros.core.robust.rounds.growth import Growth

# A drift is believed of loops of so many places at least, if it is likelier by what these are
# worth, or if no more than this part of them fits without it. Of 3 places one of 420 worlds has a
# false drift, half (2) changed none of 89, double made 2 worse; without the part 5 of 40 are
# worse, by half or double of it none of 89.
_DRIFT_PLACES = 4
_FEW = 0.1
# Odometry whose variance is so many times what it states may drift; by half or double none of 89
# runs is another.
NOISY = 4.0


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
    along = np.where(factors.i[rows] < factors.j[rows], 1.0, -1.0)
    step = np.zeros((len(rows), 3))
    step[:, 2] = drift * along * np.hypot(measured[:, 0], measured[:, 1])
    return se2.retract(measured, step)


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

    def log_odds(self, other: 'Straight') -> float:
        """Return the ln of its odds against another drift, by what they lead to."""
        usual = log_prior(self.drift, USUAL**2) - log_prior(other.drift, USUAL**2)
        return float(usual) + _log_odds(self.told, other.told)

    def keeps_places(self, as_stated: Growth) -> bool:
        """Return whether loops of as many places are accepted as without."""
        return _places(as_stated, self.told) >= _places(as_stated, as_stated)


def likeliest(some: list[Straight], as_stated: Growth) -> tuple[Straight | None, float]:
    """
    Return the likeliest of some drifts, and by how much more a rival drifts [rad/m], or 0.

    None where it does not explain the loops.
    """
    best = None
    for straight in some:
        if not best or straight.log_odds(best) > 0:
            best = straight
    if not best or not _explains(best, as_stated):
        return None, 0.0
    odds, more = min(((best.log_odds(other), other.drift - best.drift)
                      for other in some if other is not best), default=(np.inf, 0.0))
    return best, more if odds < TWO_PLACES * as_stated.given.log_odds_of_place else 0.0


def _log_odds(one: Growth, other: Growth) -> float:
    """
    Return the ln of the odds of one map against another, of odometry with and without a drift.

    Of each place that only one of them accepts, half a gate. The variances q of odometry and of
    loops were found, so what loops measure has a density proportional to det C(q)^-1/2, and the
    derivative of ln det C by ln q are the degrees of freedom f that the map leaves of the kind:
    1/2 sum f ln(q of the other / q).
    """
    freedom = sum(np.bincount(state.given.is_loop[state.accepted], np.trace(
        state.posterior.moment, axis1=1, axis2=2), 2) for state in (one, other)) / 2
    calmer = np.log(other.noise.variance / one.noise.variance)
    more = _places(one, one) - _places(one, other)
    return float(freedom @ calmer / 2 + more * one.given.log_odds_of_place)


def _explains(straight: Straight, as_stated: Growth) -> bool:
    """
    Return whether loops need the odometry to be rid of a drift.

    That is, hardly any fit without, or its odds are those of several places and the odometry is
    no noisier, as it would be if lies came in by chance. A drift by which no place is won and
    which is within what the odometry states is left, whether lies make it be asked for or not.
    And the loops are of several places: a lap that closes at one place closes as well if it has a
    turn more.
    """
    told = straight.told
    loops, before = (np.flatnonzero(state.accepted & state.given.is_loop)
                     for state in (told, as_stated))
    if told.given.may_err_as_one(loops, _DRIFT_PLACES):
        return False
    noise = as_stated.noise.variance[0]
    calmer = told.noise.variance[0] <= noise
    needed = (noise > NOISY or _places(told, told) > _places(told, as_stated)
              or not _is_stated(straight.drift, as_stated.given))
    enough = _DRIFT_PLACES * told.given.log_odds_of_place
    return (len(before) <= _FEW * len(loops)
            or bool(needed and calmer and _log_odds(told, as_stated) >= enough))


def _is_stated(drift: float, given: Evidence) -> bool:
    """Return whether a drift is within what the odometry states, as a loop is within its gate."""
    factors = given.factors
    turn = drift * drift_turn(factors, np.flatnonzero(factors.is_odometry))
    return bool((turn**2).sum() < given.gate(np.array([1]))[0])


def _places(known: Growth, growth: Growth) -> int:
    """Return of how many places, as one state knows them, the loops are that another accepts."""
    return len(np.unique(known.given.place[growth.accepted & growth.given.is_loop]))
