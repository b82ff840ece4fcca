# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Runs of loops that are left out, and that odometry noisier than was found explains.

In: a state in which nothing more comes in. Out: one with such a run, where it is worth what the
noise of all other loops costs then.
"""

from dataclasses import replace

import numpy as np

from l1slam_ros.core.robust.pairwise_consistency import RUN, runs
from l1slam_ros.core.robust.rounds.growth import Growth, gain_of_places

# By so much more the odometry may vary than its good steps say, for a run to be looked at.
FAR_NOISIER = 30.0


def with_runs(growth: Growth) -> tuple[Growth | None, float]:
    """
    Return a state with the runs that are left out and noisier odometry explains, None: without.

    The noise is learnt of the loops that came in, which are those that it is small for: a robot
    that backs up, or slides on one floor, errs by more where nothing else looks. A run that is off
    by no more than that, of whose place nothing is accepted, is rather true than a lie.
    """
    given, noise = growth.given, growth.noise
    rows, loops = growth.undecided(), growth.loops
    rows = rows[~np.isin(given.place[rows], given.place[loops])]
    most = np.unique(given.place[rows], return_counts=True)[1].max(initial=0)
    if most < RUN or growth.ventured.any() or (
            loops.any() and given.may_err_as_one(np.flatnonzero(loops))):
        return None, 0.0
    noisier = growth.copy()
    noisier.noise = replace(noise, variance=noise.variance * (FAR_NOISIER, 1.0))
    noisier.solve()
    found = noisier.innovations(rows)
    groups = runs(growth, rows[found.square < given.gate(found.freedom)])
    if not groups:
        return None, 0.0
    state = growth.copy()
    for group in groups:
        state.accepted[group] = state.ventured[group] = True
    state.noise = replace(noise, variance=noisier.noise.variance)
    state.drops[:] = 0
    state.learn_noise_anew()
    state.accept_more()
    odds = gain_of_places(growth, growth, state) - max(_noisier_costs(growth, state), 0.0)
    return (state, odds) if odds > 0 else (None, odds)


def _noisier_costs(growth: Growth, noisier: Growth) -> float:
    """
    Return how much less likely what accepted loops say is by odometry that is so noisy, ln.

    The mean of n squares of normal numbers being their variance v, a variance w in its place makes
    them less likely by n / 2 ln(w / v), if further squares make w the mean of all. The loops of
    one place say each component of a pose once, and half of what that says tells of the odometry,
    the other half of the loops.
    """
    given = growth.given
    squares = given.count_places(growth.loops) * given.graph.manifold.TANGENT_SIZE / 2
    ratio = noisier.noise.variance[0] / growth.noise.variance[0]
    return float(squares / 2 * np.log(ratio))
