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

    @cached_property
    def log_room(self) -> float:
        """The ln of the volume that a lie could claim on this map, in its units."""
        return float(claimed_volume(se2, self.told.poses).sum())

    @cached_property
    def log_evidence(self) -> float:
        """
        Return ln p(loops if they are true | odometry) / p(loops if they are lies), one a place.

        Of those that are accepted. With the Jacobian J and the residuals r of these and of the
        odometry, whitened by roots of information U, H = J'J, and V of `log_room`:

            sum over loops (ln V + ln det U - k/2 ln 2 pi) - (r'r + ln det H - ln det H_odometry)/2

        A drift d is normal about none, and the map tells it as well as S, the inverse of a
        variance: of the density of both the integral is left (P.-S. Laplace).
        """
        growth = self.told
        loops = np.flatnonzero(growth.accepted & growth.given.is_loop)
        one_each = loops[np.unique(growth.given.place[loops], return_index=True)[1]]
        graph = growth.subgraph(np.union1d(
            np.flatnonzero(growth.accepted & ~growth.given.is_loop), one_each))
        cholesky = cholesky_of(graph)
        system = factorised(graph, l2_map(graph, growth.poses, cholesky), cholesky)
        roots = log_claims(graph.between, np.zeros(graph.manifold.TANGENT_SIZE)).sum()
        numbers = growth.given.factors.freedom[one_each].sum()
        square = float(system.b @ system.b) + numbers * np.log(2 * np.pi) + cholesky.log_det()
        if self.drift:
            square += (self.drift / USUAL)**2 + np.log1p(USUAL**2 * drift_information(growth))
        return float(roots + len(one_each) * self.log_room - square / 2)

    @cached_property
    def others_of_places(self) -> int:
        """How many loops are accepted beside one a place."""
        loops = self.told.accepted & self.told.given.is_loop
        return int(np.count_nonzero(loops)) - _places(self.told)


def likeliest(some: list[Straight]) -> tuple[Straight, float]:
    """
    Return the likeliest of some drifts, and by how much more a rival drifts [rad/m], or 0.

    The other loops of a place tell how large the map is: on a smaller one there would be more
    such places than loops were found at.
    """
    widest = max(straight.log_room for straight in some)
    value = {id(straight): straight.log_evidence
             + straight.others_of_places * (straight.log_room - widest) for straight in some}
    best = max(some, key=lambda straight: value[id(straight)])
    less, more = min(((value[id(best)] - value[id(other)], other.drift - best.drift)
                      for other in some if other.drift != best.drift), default=(np.inf, 0.0))
    return best, more if less < TWO_PLACES * best.told.given.log_odds_of_place else 0.0


def _places(growth: Growth) -> int:
    """Return of how many places loops are accepted."""
    return len(np.unique(growth.given.place[growth.accepted & growth.given.is_loop]))


def drift_information(growth: Growth) -> float:
    """Return what a map says of the drift of its odometry, as the inverse of a variance."""
    rows, turn = _turns(growth)
    by_noise = np.einsum('mi,miq->q', turn, growth.posterior.left_over(rows))
    return float((by_noise**2).mean())


def drift_left(growth: Growth) -> float:
    """Return what the residuals say of the drift that is left in a map, times its information."""
    rows, turn = _turns(growth)
    return float((turn * growth.posterior.residual[rows]).sum())


def _turns(growth: Growth) -> tuple[Indices, Array]:
    """Return the odometry among what is accepted, (k,), and its `drift_turn`, as it is weighed."""
    rows = np.flatnonzero(growth.accepted)
    at = np.flatnonzero(~(growth.given.is_loop | growth.cut)[rows])
    return at, drift_turn(growth.given.factors, rows[at]) / np.sqrt(growth.noise.assumed[0])
