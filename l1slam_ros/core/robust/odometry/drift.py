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
    def log_evidence(self) -> float:
        """
        Return the ln of how likely its loops are, see `log_evidence`, if the odometry drifts so.

        A drift is normal about none, and the map tells it to within a variance: of the density of
        both together the integral (P.-S. Laplace) is left.
        """
        square = USUAL**2 * drift_information(self.told) if self.drift else 0.0
        return log_evidence(self.told) - ((self.drift / USUAL)**2 + float(np.log1p(square))) / 2


def likeliest(some: list[Straight]) -> tuple[Straight, float]:
    """Return the likeliest of some drifts, and by how much more a rival drifts [rad/m], or 0."""
    best = max(some, key=lambda straight: straight.log_evidence)
    less, more = min(((best.log_evidence - other.log_evidence, other.drift - best.drift)
                      for other in some if other.drift != best.drift), default=(np.inf, 0.0))
    return best, more if less < TWO_PLACES * best.told.given.log_odds_of_place else 0.0


def log_evidence(growth: Growth) -> float:
    """
    Return ln p(loops if they are true | odometry) / p(loops if they are lies), of those accepted.

    With the Jacobian J and the residuals r of what is accepted, whitened by roots of information
    U, H = J'J, and V what a lie could claim on this map: the loops would fit a small map by
    chance, too.

        sum over the loops (ln V + ln det U - k/2 ln 2 pi) - (r'r + ln det H - ln det H_odometry) / 2
    """
    rows = np.flatnonzero(growth.accepted)
    loops = growth.given.is_loop[rows]
    graph = growth.subgraph(rows)
    cholesky = cholesky_of(graph)
    factorised(graph, growth.poses, cholesky)
    free = np.zeros(graph.manifold.TANGENT_SIZE)
    claims = np.where(loops, log_claims(graph.between, claimed_volume(graph.manifold, growth.poses)),
                      log_claims(graph.between, free))
    numbers = graph.between.freedom[loops].sum()
    square = float((growth.posterior.residual**2).sum())
    return float(claims.sum() - (numbers * np.log(2 * np.pi) + square + cholesky.log_det()) / 2)


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
