# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The rounds of a robust solve: predict, gate, accept, solve; see `batch`.

In: the prepared graph and its accepted factors. Out: the same with more loops accepted.
"""

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph, component_labels
from l1slam_ros.core.graph.first_fixes import first_fixes
from l1slam_ros.core.graph.world_frame import placed
from l1slam_ros.core.robust.gating import DOUBT, SAME, TINY, believable, noise_variance
from l1slam_ros.core.robust.innovation import (
    CHECKED,
    LEAST_RATIO,
    Innovations,
    Posterior,
    chi2_quantile,
    claimed_volume,
    innovations,
    sample_posterior,
)
from l1slam_ros.core.robust.inspection import FEWEST, OFF_SCALE, parallel_factors
from l1slam_ros.core.robust.places import first_told
from l1slam_ros.core.robust.rounds.evidence import evidence_of
from l1slam_ros.core.robust.rounds.noise import Noise
from l1slam_ros.core.solvers.block_cholesky import with_pattern
from l1slam_ros.core.solvers.gauss_newton import ChangingOrder, l2_optimum

# A loop dropped this often is not tried again; half or double makes none of 89 runs worse.
_CHANCES = 2
# Iterations of noise estimation after factors changed: each may keep half of the last estimate.
_LEARNT_ANEW = 8
# Components that share a variance, in stated units: translation and rotation; in space those of
# the floor and of the height apart.
_GROUPS = {3: (slice(0, 2), slice(2, 3)),
           6: (slice(0, 2), slice(2, 3), slice(3, 5), slice(5, 6))}
# While driving, this many of the last absolute factors are considered, with neighbours.
_LATEST = 50


class Growth:
    """
    The state of a robust solve, which each round changes.

    Attributes
    ----------
    given : the prepared graph
    accepted : (m,) bool of its factors
    cut : (m,) bool, odometry not used: gaps and slips
    part : (n,) connected component of each keyframe
    poses, posterior : (n, p) the L2 map, and its posterior
    noise : as estimated
    slip_odds : ln P(slipped) / P(measured) of suspected odometry factors
    ventured : (m,) bool, loops of runs that noisier odometry explained
    drops : (m,) how often each was accepted and did not fit
    check : called before long steps, raises to stop

    """

    def __init__(self, graph: FactorGraph, check: Callable[[], None] = lambda: None):
        self._check = check
        given = self.given = evidence_of(graph)
        self.cut: Mask = given.gap.copy()
        self.accepted: Mask = ~given.is_loop | given.trusted
        self.poses = placed(given.graph.subset(self.accepted), given.chain)
        self.part = np.zeros(graph.n_poses, np.int64)
        self.noise = Noise.of(given.stated, given.graph.manifold.TANGENT_SIZE)
        self.posterior: Posterior
        self._order: ChangingOrder | None = None
        self.slip_odds: dict[int, float] = {}
        none = np.zeros(len(given.factors), bool)
        self.ventured = none
        self.drops = none.astype(np.int64)

    def begin(self) -> None:
        """Solve for the accepted factors, and estimate the noise from innovations of loops."""
        self._tie_to_world()
        self.solve()
        rows = self.undecided()
        graph = self.given.graph
        first = first_told(graph, parallel_factors(graph))
        # A loop that repeats an odometry factor fits whatever the noise.
        rows = rows[~self.given.factors.is_absolute[rows] & (first[rows] == rows)]
        # An estimate from them would absorb their common error.
        if not self.given.may_err_as_one(rows):
            self.noise = self.noise.found(
                self.noise.variance * noise_variance(self.innovations(rows)))
            self.solve()

    def resume(self, poses: Array, accepted: Mask, variance: Array) -> None:
        """Continue from an earlier state: poses (n, p), accepted (m,), variance (2,)."""
        self.poses, self.noise = poses, self.noise.found(variance)
        self.accepted[: self.given.size] = accepted | self.given.trusted[: self.given.size]
        self.cut |= ~self.accepted & ~self.given.is_loop
        self.accepted |= self.cut
        self._tie_to_world(_LATEST)
        # The noise was estimated from these factors.
        self.noise = replace(self.noise, learnt_of=self.accepted.copy())
        if self.loops.any():
            self.solve()
        else:
            self.begin()

    @property
    def loops(self) -> Mask:
        """(m,) bool: the accepted loops."""
        return self.accepted & self.given.is_loop

    @property
    def may_be_predicted(self) -> Mask:
        """(m,) bool: all but absolute factors while none of these is accepted."""
        absolute = self.given.factors.is_absolute
        return ~absolute | (self.accepted & absolute).any()

    def _tie_to_world(self, latest: int | None = None) -> None:
        """
        Accept absolute factors that agree with neighbours, if they extend or outnumber the old.

        Until some are accepted the map predicts none, and after a long path the next one poorly.

        latest : consider this many of the last; None: all
        """
        absolute = self.given.factors.is_absolute
        held = self.accepted & absolute
        if (held != absolute).any():
            # Up to this number may have been accepted for lack of others.
            count = np.count_nonzero(held)
            known = count > self.given.graph.manifold.TRANSLATION.stop
            rows, variance = first_fixes(
                self.given.graph, latest, self.noise.variance[0] if known else None)
            if known and held[rows].any():
                self.accepted[rows] = True
            elif len(rows) > count:
                self.accepted &= ~absolute | self.given.trusted
                self.accepted[rows] = True
                self.noise = self.noise.found(
                    np.array([max(variance, LEAST_RATIO), self.noise.variance[1]]))
        # Place a part that no other factor joins where most of its absolute factors agree.
        placing = (self.accepted | absolute) & ~self.cut if self.cut.any() else self.accepted
        self.poses = placed(self.given.graph.subset(placing), self.poses)

    def copy(self) -> 'Growth':
        """Return a copy to try a hypothesis in."""
        clone = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray | dict):
                setattr(clone, name, value.copy())
        return clone

    def uncut(self) -> 'Growth':
        """Return a copy that uses all odometry as measured."""
        state = self.copy()
        state.cut[:] = False
        return state

    def subgraph(self, rows: Indices) -> FactorGraph:
        """Return the graph of some factors, weighted by the assumed noise."""
        self._check()  # each long step begins here
        variance = np.where(self.given.factors.is_absolute[rows, None], 1.0,
                            self.noise.assumed[self.given.is_loop[rows].astype(np.int64)])
        cut = self.cut[rows]
        # A cut keeps the current relative pose. Where loops join both sides, it has negligible
        # information, even to hundreds of sigmas; else it alone ties them.
        low, high = self.given.factors.i[rows[cut]], self.given.factors.j[rows[cut]]
        variance[cut] *= np.where(self.part[low] == self.part[high], 1 / TINY, 1.0)[:, None]
        subgraph = self.given.graph.subset(rows, variance)
        subgraph.between.measurement[cut] = self.given.graph.manifold.between(
            self.poses[low], self.poses[high])
        return subgraph

    def take_at_their_word(self) -> None:
        """From now on use max(estimated, stated) covariance."""
        self.noise = replace(self.noise, at_their_word=True)
        self.drops[:] = 0

    def undecided(self) -> Indices:
        """Return the loops within a part that are still open, (k,)."""
        return self._open(~self.across() & self.may_be_predicted)

    def joining(self) -> Indices:
        """Return the loops between parts that are still open, (k,)."""
        return self._open(self.across())

    def _open(self, some: Mask) -> Indices:
        return np.asarray(np.flatnonzero(some & ~self.accepted & (self.drops < _CHANCES)))

    def across(self) -> Mask:
        """Return which factors join two parts, (m,) bool."""
        across: Mask = self.part[self.given.low] != self.part[self.given.high]
        return across & ~self.given.factors.is_absolute

    def label_parts(self) -> None:
        """Label the connected components of accepted factors without cuts."""
        self.part = component_labels(self.given.graph.subset(self.accepted & ~self.cut))

    def accept_more(self) -> None:
        """Run rounds until none accepts a loop."""
        while len(news := self.news()):
            self.accepted[news] = True
            self.solve()

    def learn_noise_anew(self) -> None:
        """Estimate the noise from accepted factors alone, until it converges."""
        for _ in range(_LEARNT_ANEW):
            before = self.noise.variance
            self.noise = self.noise.forgotten()
            self.solve()
            if np.allclose(self.noise.variance, before, rtol=SAME, atol=0.0):
                break

    def solve(self) -> None:
        """Solve for the accepted factors, drop those that do not fit, estimate the noise."""
        while True:
            vars(self).pop('posterior', None)  # frees nearly a Cholesky factor's memory
            if self.cut.any():
                self.label_parts()
            rows = np.flatnonzero(self.accepted)
            subgraph = self.subgraph(rows)
            self._order = ChangingOrder.of(subgraph, rows, self._order)
            cholesky = with_pattern(self._order.pattern, subgraph)
            self._check()
            self.poses, residual, solved = l2_optimum(subgraph, self.poses, cholesky,
                                                      lambda *_: self._check())
            self._check()
            self.posterior = sample_posterior(subgraph, self.poses, cholesky, solved)
            if self._is_noisier(rows):
                continue
            misfits = self._misfits(rows, residual.reshape(len(rows), -1))
            if not len(misfits):
                break
            self.accepted[misfits] = False
            self.drops[misfits] += 1
        if not self.noise.is_known(self.accepted):
            self._learn_noise(rows)

    def _is_noisier(self, rows: Indices) -> bool:
        """Raise variances that checked residuals show too small; return whether any was."""
        loops = self.given.is_loop[rows]
        if self.noise.is_known(self.accepted) or self.given.may_err_as_one(rows[loops]):
            return False
        square = (self.posterior.residual**2).sum(axis=1)
        stated = np.trace(self.posterior.moment, axis1=1, axis2=2)
        known = (stated > CHECKED) & ~self.given.factors.is_absolute[rows]
        scale = np.array([np.median(square[known & kind] / stated[known & kind])
                          if (known & kind).any() else 0.0 for kind in (~loops, loops)])
        k = self.given.graph.manifold.TANGENT_SIZE
        scale *= k / chi2_quantile(0.5, np.array([k]))
        noisier = scale > OFF_SCALE
        self.noise = self.noise.found(np.where(noisier, scale, 1.0) * self.noise.variance)
        return bool(noisier.any())

    def _misfits(self, rows: Indices, residual: Array) -> Indices:
        """Return accepted loops that fail the gate, also if left out."""
        freedom = self.given.factors.freedom[rows]
        may_go = self.given.is_loop[rows] & ~self.given.trusted[rows]
        far = (residual**2).sum(axis=1) > self.given.gate(freedom)
        against = np.where(may_go, self.posterior.left_out(), 0.0)
        # True loops beside a false one fit badly, too: drop only the worst.
        doubted = self.given.gate(freedom, DOUBT / len(rows))
        far |= against > np.maximum(doubted, against.max(initial=0.0) / 2)
        return np.asarray(rows[far & may_go])

    def _learn_noise(self, rows: Indices) -> None:
        """
        Estimate variances from residuals and their expectation, by component and kind.

        Absolute factors keep their stated noise: a few do not determine it.
        """
        kind, k = self.given.is_loop[rows].astype(np.int64), self.given.graph.manifold.TANGENT_SIZE
        own = ~self.given.factors.is_absolute[rows]
        found, stated = np.zeros((2, 2, k))
        np.add.at(found, kind[own], self.posterior.residual[own]**2)
        np.add.at(stated, kind[own], np.diagonal(self.posterior.moment[own], 0, 1, 2))
        for group in _GROUPS[k]:
            for sums in (found, stated):
                sums[:, group] = sums[:, group].mean(axis=1, keepdims=True)
        # Shrink each component to the mean of all, and this to the noise assumed before.
        known = FEWEST * k
        mean = ((found.sum(axis=1) + known) / (stated.sum(axis=1) + known))[:, None]
        self.noise = self.noise.learnt((found + known * mean) / (stated + known), self.accepted)

    def innovations(self, rows: Indices) -> Innovations:
        """Return the innovations of factors that are not accepted."""
        widths = claimed_volume(self.given.graph.manifold, self.poses)
        return innovations(self.subgraph(rows), self.poses, self.posterior, widths)

    def news(self) -> Indices:
        """Return the loops to accept next, (k,); at the end dropped ones once more."""
        news = self.believable(self.undecided())
        fresh: Indices = news[self.drops[news] == 0]
        if len(fresh):
            return fresh
        self.drops[self.drops > 0] += 1
        return news

    def believable(self, rows: Indices) -> Indices:
        """Return the loops to accept of some: each on its own odds, else in pairs, (k,)."""
        if not len(rows):
            return rows
        found = self.innovations(rows)
        fits = found.square < self.given.gate(found.freedom)
        # With stated noise, or noise from one run, covariances are too large and more loops fit by
        # chance: estimate the outlier rate from undecided loops alone.
        true = (0 if self.noise.at_their_word or self.ventured.any()
                else np.count_nonzero(self.loops))
        return np.asarray(rows[believable(
            found, self.posterior, self.given.gate, fits, int(true), self.given.place[rows])])


def gain_of_places(growth: Growth, as_stated: Growth, cut: Growth) -> float:
    """Return the log odds of a cut by the places it wins and loses."""
    before, explained, after = (np.unique(growth.given.place[state.loops])
                                for state in (growth, as_stated, cut))
    won = len(np.setdiff1d(after, np.union1d(before, explained)))
    # A place counts if any of its loops is lost, also a long one.
    lost = growth.given.count_places(growth.loops & ~cut.loops)
    return growth.given.log_odds_of_place * (won - lost)
