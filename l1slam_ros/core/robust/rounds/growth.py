# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The rounds of a robust solve: predict, gate, accept, solve.

In: the evidence and what is accepted of it. Out: the same with more loops accepted. See `batch`.
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

# A loop that was dropped that often is not tried again; half and double make none of 89 worse.
_CHANCES = 2
# So often noise is learnt anew of other factors: each time half of what it was before may stay.
_LEARNT_ANEW = 8
# Numbers of a step that have one variance, in units of what is stated: moves and turns; in space
# those of the floor and of the height apart.
_GROUPS = {3: (slice(0, 2), slice(2, 3)),
           6: (slice(0, 2), slice(2, 3), slice(3, 5), slice(5, 6))}
# While driving so many of the last absolute factors are looked at, with their neighbours.
_LATEST = 50


class Growth:
    """
    The state of a robust solve, which each round changes.

    given : the evidence; accepted : (m,) bool of its factors; cut : (m,) bool, odometry that says
    nothing: the gaps, and where it slipped; part : (n,) number of the part of each keyframe;
    poses : (n, p) the L2 map of the accepted; posterior : of these; noise : as it was found;
    slip_odds : ln P(slipped) / P(measured) of the odometry factors that were suspected;
    ventured : (m,) bool, loops of runs that noisier odometry explained; drops : (m,) how often
    each was accepted and did not fit; check : called before long steps, raises where the work
    shall stop.
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
        """Solve for what is accepted, and learn from the loops how large the noise is."""
        self._tie_to_world()
        self.solve()
        rows = self.undecided()
        graph = self.given.graph
        first = first_told(graph, parallel_factors(graph))
        # Odometry that stands there twice fits itself, whatever the noise.
        rows = rows[~self.given.factors.is_absolute[rows] & (first[rows] == rows)]
        # Else the noise that is learnt of them would fit their mistake.
        if not self.given.may_err_as_one(rows):
            self.noise = self.noise.found(
                self.noise.variance * noise_variance(self.innovations(rows)))
            self.solve()

    def resume(self, poses: Array, accepted: Mask, variance: Array) -> None:
        """Go on from an earlier state: poses (n, p), accepted (m,), variance (2,)."""
        self.poses, self.noise = poses, self.noise.found(variance)
        self.accepted[: self.given.size] = accepted | self.given.trusted[: self.given.size]
        self.cut |= ~self.accepted & ~self.given.is_loop
        self.accepted |= self.cut
        self._tie_to_world(_LATEST)
        # What the noise of these is, is known.
        self.noise = replace(self.noise, learnt_of=self.accepted.copy())
        if self.loops.any():
            self.solve()
        else:
            self.begin()

    @property
    def loops(self) -> Mask:
        """(m,) bool: the loops that are accepted."""
        return self.accepted & self.given.is_loop

    @property
    def may_be_predicted(self) -> Mask:
        """(m,) bool: not absolute factors while none of these is accepted."""
        absolute = self.given.factors.is_absolute
        return ~absolute | (self.accepted & absolute).any()

    def _tie_to_world(self, latest: int | None = None) -> None:
        """
        Accept the absolute factors that agree with their neighbours, if these are more than are.

        Until some are, the map says nothing of any; and behind a long way, little of the next.

        latest : so many of them are looked at; None: all
        """
        absolute = self.given.factors.is_absolute
        held = self.accepted & absolute
        if (held != absolute).any():
            # As many may have been accepted for want of others.
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
        # A part that no other factor joins is where most of its own absolute factors say.
        placing = (self.accepted | absolute) & ~self.cut if self.cut.any() else self.accepted
        self.poses = placed(self.given.graph.subset(placing), self.poses)

    def copy(self) -> 'Growth':
        """Return a state to try something in."""
        clone = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray | dict):
                setattr(clone, name, value.copy())
        return clone

    def uncut(self) -> 'Growth':
        """Return the state, where all odometry says what it measured."""
        state = self.copy()
        state.cut[:] = False
        return state

    def subgraph(self, rows: Indices) -> FactorGraph:
        """Return the graph of some factors, with the noise as it was found."""
        self._check()  # with this, each long step begins
        variance = np.where(self.given.factors.is_absolute[rows, None], 1.0,
                            self.noise.assumed[self.given.is_loop[rows].astype(np.int64)])
        cut = self.cut[rows]
        # Where loops hold both sides, they alone decide, be it to some hundred sigmas; where
        # nothing does, it is all there is. Either way the keyframes are where they are.
        low, high = self.given.factors.i[rows[cut]], self.given.factors.j[rows[cut]]
        variance[cut] *= np.where(self.part[low] == self.part[high], 1 / TINY, 1.0)[:, None]
        subgraph = self.given.graph.subset(rows, variance)
        subgraph.between.measurement[cut] = self.given.graph.manifold.between(
            self.poses[low], self.poses[high])
        return subgraph

    def take_at_their_word(self) -> None:
        """From now on let factors be as noisy as they say."""
        self.noise = replace(self.noise, at_their_word=True)
        self.drops[:] = 0

    def undecided(self) -> Indices:
        """Return the loops within a part that may yet be accepted, (k,)."""
        return self._open(~self.across() & self.may_be_predicted)

    def joining(self) -> Indices:
        """Return the loops from one part to another that may yet be accepted, (k,)."""
        return self._open(self.across())

    def _open(self, some: Mask) -> Indices:
        return np.asarray(np.flatnonzero(some & ~self.accepted & (self.drops < _CHANCES)))

    def across(self) -> Mask:
        """Return which factors lead from one part to another, (m,) bool."""
        across: Mask = self.part[self.given.low] != self.part[self.given.high]
        return across & ~self.given.factors.is_absolute

    def label_parts(self) -> None:
        """Give each keyframe the number of its part, of what is accepted now."""
        self.part = component_labels(self.given.graph.subset(self.accepted & ~self.cut))

    def accept_more(self) -> None:
        """Go through the rounds until there is nothing more to accept."""
        while len(news := self.news()):
            self.accepted[news] = True
            self.solve()

    def learn_noise_anew(self) -> None:
        """Solve, and learn the noise of what is accepted now alone, until it is what it was."""
        for _ in range(_LEARNT_ANEW):
            before = self.noise.variance
            self.noise = self.noise.forgotten()
            self.solve()
            if np.allclose(self.noise.variance, before, rtol=SAME, atol=0.0):
                break

    def solve(self) -> None:
        """Solve for the accepted factors, drop what does not fit any more, measure the noise."""
        while True:
            vars(self).pop('posterior', None)  # nearly as large as the factor that is made now
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
        """Raise the variance where half of the factors, checked by others, say it is too small."""
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
        """Return the accepted loops that do not fit, or that all others speak against."""
        freedom = self.given.factors.freedom[rows]
        may_go = self.given.is_loop[rows] & ~self.given.trusted[rows]
        far = (residual**2).sum(axis=1) > self.given.gate(freedom)
        against = np.where(may_go, self.posterior.left_out(), 0.0)
        # Next to a false loop the true ones look bad too: only the worst go.
        doubted = self.given.gate(freedom, DOUBT / len(rows))
        far |= against > np.maximum(doubted, against.max(initial=0.0) / 2)
        return np.asarray(rows[far & may_go])

    def _learn_noise(self, rows: Indices) -> None:
        """
        Compare the residuals with what the noise makes of them, for each number of either kind.

        Absolute factors are as noisy as they say: of theirs a few tell nothing.
        """
        kind, k = self.given.is_loop[rows].astype(np.int64), self.given.graph.manifold.TANGENT_SIZE
        own = ~self.given.factors.is_absolute[rows]
        found, stated = np.zeros((2, 2, k))
        np.add.at(found, kind[own], self.posterior.residual[own]**2)
        np.add.at(stated, kind[own], np.diagonal(self.posterior.moment[own], 0, 1, 2))
        for group in _GROUPS[k]:
            for sums in (found, stated):
                sums[:, group] = sums[:, group].mean(axis=1, keepdims=True)
        # Each number is drawn to the mean of all, and that to what is stated.
        known = FEWEST * k
        mean = ((found.sum(axis=1) + known) / (stated.sum(axis=1) + known))[:, None]
        self.noise = self.noise.learnt((found + known * mean) / (stated + known), self.accepted)

    def innovations(self, rows: Indices) -> Innovations:
        """Return how factors that are not accepted fit the map."""
        widths = claimed_volume(self.given.graph.manifold, self.poses)
        return innovations(self.subgraph(rows), self.poses, self.posterior, widths)

    def news(self) -> Indices:
        """Return the loops to accept next, (k,); in the end what was dropped, all at once."""
        news = self.believable(self.undecided())
        fresh: Indices = news[self.drops[news] == 0]
        if len(fresh):
            return fresh
        self.drops[self.drops > 0] += 1
        return news

    def believable(self, rows: Indices) -> Indices:
        """Return which of some loops may be accepted: each by itself, or else together, (k,)."""
        if not len(rows):
            return rows
        found = self.innovations(rows)
        fits = found.square < self.given.gate(found.freedom)
        # Taken at their word, or by the noise that one run taught, all are noisier than they are,
        # so that more fit by chance: then only the rest says how many of the rest are false.
        true = (0 if self.noise.at_their_word or self.ventured.any()
                else np.count_nonzero(self.loops))
        return np.asarray(rows[believable(
            found, self.posterior, self.given.gate, fits, int(true), self.given.place[rows])])


def gain_of_places(growth: Growth, as_stated: Growth, cut: Growth) -> float:
    """Return what the places say that are won and lost by a cut, ln of odds."""
    before, explained, after = (np.unique(growth.given.place[state.loops])
                                for state in (growth, as_stated, cut))
    won = len(np.setdiff1d(after, np.union1d(before, explained)))
    # Of a place that is long, too, what is lost had to be a mistake.
    lost = growth.given.count_places(growth.loops & ~cut.loops)
    return growth.given.log_odds_of_place * (won - lost)
