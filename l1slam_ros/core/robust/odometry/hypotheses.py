# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Changes of the odometry that explain rejected loops, compared on one scale: ln of odds.

In: a robust state that accepts no more loops. Out: the state that a change leads to, and ln of its
odds against the state without it. The odometry may drift (`drift`), factors of it may have slipped
(`slips`), or it is noisier along a run of loops that repeat one way (`noisier_run`).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.robust.pairwise_consistency import RUN, runs
from l1slam_ros.core.robust.rounds.growth import Growth, gain_of_places

# Factor on the variance of the odometry for which a run of loops is tested.
FAR_NOISIER = 30.0


@dataclass(frozen=True)
class Hypothesis:
    """
    A change of the odometry.

    state : the robust state after it; log_odds : ln P(change | loops) / P(no change | loops);
    drift : by how much each metre of the odometry turns too little [rad/m]
    """

    state: Growth
    log_odds: float
    drift: float = 0.0


def best(hypotheses: Iterable[Hypothesis]) -> Hypothesis | None:
    """Return the likeliest hypothesis, None if no change is at least as likely."""
    likeliest = max(hypotheses, key=lambda one: one.log_odds, default=None)
    return likeliest if likeliest and likeliest.log_odds > 0 else None


def noisier_run(growth: Growth) -> list[Hypothesis]:
    """
    Return the hypothesis that odometry is noisier where a run of rejected loops spans it, or none.

    The noise is estimated from accepted loops, hence where it is small: a robot that backs up or
    slides errs by more where no accepted loop shows it. A run within the gate of odometry of
    `FAR_NOISIER` times the variance, none of whose place is accepted, is rather true than an
    outlier.
    """
    given, noise = growth.given, growth.noise
    rows, loops = growth.undecided(), growth.loops
    rows = rows[~np.isin(given.place[rows], given.place[loops])]
    most = np.unique(given.place[rows], return_counts=True)[1].max(initial=0)
    if most < RUN or growth.ventured.any() or (
            loops.any() and given.may_err_as_one(np.flatnonzero(loops))):
        return []
    noisier = growth.copy()
    noisier.noise = replace(noise, variance=noise.variance * (FAR_NOISIER, 1.0))
    noisier.solve()
    found = noisier.innovations(rows)
    groups = runs(growth, rows[found.square < given.gate(found.freedom)])
    if not groups:
        return []
    state = growth.copy()
    for group in groups:
        state.accepted[group] = state.ventured[group] = True
    state.noise = replace(noise, variance=noisier.noise.variance)
    state.drops[:] = 0
    state.learn_noise_anew()
    state.accept_more()
    costs = max(_log_likelihood_loss(growth, state), 0.0)
    return [Hypothesis(state, gain_of_places(growth, growth, state) - costs)]


def _log_likelihood_loss(growth: Growth, noisier: Growth) -> float:
    """
    Return by how much the log likelihood of accepted loops falls with the noise of another state.

    A variance w in place of v, the mean of n squared normal numbers, lowers it by n / 2 ln(w / v),
    if further squares make w the mean of all. The loops of a place measure each component of a
    pose once, and half of that informs on the odometry, the other half on the loops.
    """
    given = growth.given
    squares = given.count_places(growth.loops) * given.graph.manifold.TANGENT_SIZE / 2
    ratio = noisier.noise.variance[0] / growth.noise.variance[0]
    return float(squares / 2 * np.log(ratio))
