# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Explain rejected loops by a change of the odometry: the search that a robust solve ends with.

In: a robust state that accepts no more loops. Out: a state after a change of the odometry that is
likelier than the one without (see `hypotheses`), from which the rounds go on; and for the
confidence, the odds of the drifts that were tried beside the one that was taken.
"""

from collections.abc import Callable, Iterator

import numpy as np

from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.inspection import OFF_SCALE
from l1slam_ros.core.robust.odometry.drift import Straight, hypotheses_of, margin_of, straightened
from l1slam_ros.core.robust.odometry.drift_likelihood import likely_drifts
from l1slam_ros.core.robust.odometry.hypotheses import Hypothesis, best, noisier_run
from l1slam_ros.core.robust.odometry.motion import log_odds_of_slips, usual_motion
from l1slam_ros.core.robust.odometry.slips import slips
from l1slam_ros.core.robust.rounds.growth import Growth

# The rounds from a state on, until `repaired` returns no other state.
Rounds = Callable[[Growth, Callable[[Growth, Growth], Growth | None]], Iterator[Growth]]


class Repair:
    """
    The changes of the odometry of a graph that may explain rejected loops.

    drift : that of the odometry [rad/m]; rival : by how much another likely one differs, 0: there
    is none; odds : ln of those of the drift against all its rivals.
    """

    def __init__(self, graph: FactorGraph, rounds: Rounds, check: Callable[[], None]):
        self._graph, self._rounds, self._check = graph, rounds, check
        self._is_straightened = False
        self.drift = self.rival = 0.0
        self.odds = np.inf

    def __call__(self, growth: Growth, as_stated: Growth) -> Growth | None:
        """
        Return the state after the likeliest change, None: none is likelier than no change.

        Drifts are compared once; a slip or a noisier run as long as one is found.

        growth : the state with the estimated noise; as_stated : that with the larger of this and
        the stated noise
        """
        drift = None if self._is_straightened else self._straightened(growth, as_stated)
        self._is_straightened = True
        if drift:
            return drift.state
        change = best([*slips(growth, as_stated), *noisier_run(growth)])
        if change:
            return change.state
        if growth.cut.any():  # more loops are accepted than when these were cut
            odds = log_odds_of_slips(growth, usual_motion(growth))
            growth.slip_odds |= {
                step: float(odds[step]) for step in growth.slip_odds if growth.cut[step]}
        return None

    def _straightened(self, growth: Growth, as_stated: Growth) -> Hypothesis | None:
        """Return the likeliest drift of those that loops propose, None: rather none."""
        # Odometry much noisier than stated may drift.
        if not len(as_stated.undecided()) and as_stated.noise.variance[0] <= OFF_SCALE:
            return None
        some = [Straight(0.0, growth, as_stated)]
        for drift in likely_drifts(self._graph).tolist():
            begun = Growth(straightened(self._graph, drift), self._check)
            begun.begin()
            some += self._ends(drift, begun)
        if len(some) == 1:
            return None
        if not len(some[0].loops):
            for run in self._runs(growth):
                some += self._ends(0.0, run)
        drifts = hypotheses_of(some)
        change = best(drifts)
        if change:
            self.drift = change.drift
            margin = margin_of(as_stated)
            others = [(change.log_odds - one.log_odds, one.drift - change.drift)
                      for one in drifts if one.drift != change.drift]
            near = [other for other in others if other[0] < margin]
            if near:
                self.rival = min(near)[1]
                self.odds = -float(np.logaddexp.reduce([-less for less, _ in near]))
        return change

    def _ends(self, drift: float, growth: Growth) -> list[Straight]:
        """Return the ends of the rounds from a state, without loops also by a noisier run."""
        ends: list[Straight] = []

        def ended(*states: Growth) -> Growth | None:
            ends.append(Straight(drift, *states))
            return None if len(ends[-1].loops) else next(iter(self._runs(states[0])), None)

        for _ in self._rounds(growth, ended):
            self._check()
        return ends

    def _runs(self, growth: Growth) -> list[Growth]:
        return [one.state for one in noisier_run(growth) if one.log_odds > 0]
