# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Judgement of a graph's factors, and the reasons to doubt its map.

In: the end of a robust solve, in batch or while driving. Out: accepted factors, their noise, and
doubts with keyframes to inspect. A person can vouch for a loop, strike one out, or correct the
stated noise.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.parts import part_labels
from l1slam_ros.core.robust.odometry.drift import straightened
from l1slam_ros.core.robust.pairwise_consistency import RUN
from l1slam_ros.core.robust.places import err_together
from l1slam_ros.core.robust.rounds.growth import Growth

# Kinds of doubts and their meaning.
WEAK = 'a weak map'  # no loop is accepted
UNCONFIRMED = 'unconfirmed loops'  # accepted, but hardly confirmed by the others
OTHER_MAP = 'another map'  # rejected loops may be right
SLIP = 'a slip suspected'  # an odometry factor may have slipped, or not
DRIFTS = 'a drift suspected'  # the odometry may have another drift
UNFINISHED = 'not at an end'  # the limit of rounds was reached
NORM = 'another norm'  # the same factors have another map in L2
NO_WHEELS = 'no wheels'  # scans alone show the motion
FAILED = 'judging failed'  # the map has the loops accepted before
UNSOLVED = 'solving failed'  # solving for accepted factors failed
PARTS = 'parts'  # no accepted factor joins them


@dataclass(frozen=True)
class Doubt:
    """
    A reason to doubt a map.

    Attributes
    ----------
    kind : one of the above
    loops : number concerned
    first, last : keyframes that enclose them
    detail : the error, or a number
    pairs : keyframes of each loop, in either order

    """

    kind: str
    loops: int
    first: int
    last: int
    detail: str = ''
    pairs: tuple[tuple[int, int], ...] = field(default=(), compare=False, repr=False)


@dataclass(frozen=True)
class Judgement:
    """
    Judgement of the first m between factors of a graph.

    Attributes
    ----------
    accepted : (m,) bool
    suspect : (m,) bool, loops that fit but may do so by chance; others not accepted are rejected
    sigmas : (m,) length of the whitened residual, if not accepted root of the NIS, NaN before a
        test; by the larger of stated and estimated noise, by less where the stated is far too
        large, see `as_measured`
    variance : (2,) estimated for odometry and loops, in units of the stated
    noise : (m,) variance of each in a map, in these units
    slips : (k,) odometry factors that slipped, not accepted
    doubts : reasons to doubt the map
    settled : present factors can show no more
    drift : rotation of each metre of odometry beyond the measured [rad/m]
    confidence : see `confidence`, NaN without loops
    expected_error : of the map by its posterior [m]
    is_refusal_doubted : rejected loops may be true
    meant : (2, k) variance of components of odometry and loops where the stated is a placeholder,
        in its units

    """

    accepted: Mask
    suspect: Mask
    sigmas: Array
    variance: Array
    noise: Array
    slips: Indices
    doubts: tuple[Doubt, ...] = ()
    settled: bool = True
    drift: float = 0.0
    confidence: float = float('nan')
    expected_error: float = 0.0
    is_refusal_doubted: bool = False
    meant: Array = field(default_factory=lambda: np.ones((2, 1)), compare=False, repr=False)

    @property
    def doubt(self) -> Doubt | None:
        """The first doubt; None without any."""
        return self.doubts[0] if self.doubts else None

    @staticmethod
    def nothing() -> 'Judgement':
        """Return the judgement of a graph without factors."""
        none = np.zeros(0, bool)
        return Judgement(none, none, np.zeros(0), np.ones(2), np.zeros(0),
                         np.zeros(0, np.int64))

    @property
    def is_noise_stated(self) -> bool:
        """Whether factors have their stated noise."""
        return bool((self.noise == 1).all())

    def broken_off(self, graph: FactorGraph, error: Exception) -> 'Judgement':
        """Return this judgement, doubted for a failure."""
        factors = graph.between
        left_out = ~factors.is_odometry & ~factors.struck & ~self.accepted
        doubt = doubt_of(graph, left_out, FAILED, str(error))
        return replace(self, doubts=(doubt,), settled=True, confidence=float('nan'))

    def renumbered(self, number: Indices) -> 'Judgement':
        """Return the judgement with new numbers (n,) of keyframes in its doubts."""
        if (np.diff(number) == 1).all():
            return self
        doubts = []
        for doubt in self.doubts:
            pairs = np.sort(number[np.array(doubt.pairs, np.int64).reshape(-1, 2)], axis=1)
            ends = number[doubt.first:doubt.last + 1] if not len(pairs) else pairs
            doubts.append(replace(doubt, first=int(ends.min()), last=int(ends.max()),
                                  pairs=listed(pairs)))
        return replace(self, doubts=tuple(doubts))

    def of_all(self, graph: FactorGraph) -> 'Judgement':
        """
        Return the judgement of every factor, from that of those not struck.

        Struck ones get neutral values; judged ones beyond the graph's, ties, go.
        """
        rows = graph.not_struck
        k = len(rows)

        def spread(values: Any, rest: float) -> Any:
            whole = np.full(len(graph.between), rest, values.dtype)
            whole[rows] = values[:k]
            return whole

        return replace(self, accepted=spread(self.accepted, False),
                       suspect=spread(self.suspect, False), sigmas=spread(self.sigmas, np.nan),
                       noise=spread(self.noise, 1.0), slips=rows[self.slips[self.slips < k]])

    def with_parts(self, graph: FactorGraph) -> 'Judgement':
        """Return the judgement, with a doubt if accepted factors leave parts."""
        part = part_labels(graph.subset(self.accepted))
        firsts = np.unique(part, return_index=True)[1]
        if len(firsts) < 2:
            return self
        factors = graph.between
        pairs = factors.pairs[~factors.is_odometry & ~factors.is_absolute & ~factors.struck]
        across = pairs[part[pairs[:, 0]] != part[pairs[:, 1]]]
        doubt = Doubt(PARTS, len(across), int(firsts[1]) - 1, int(firsts[-1]),
                      f'{len(firsts):,}', listed(across))
        return replace(self, doubts=(*self.doubts, doubt))

    def of_factors(self, which: Indices) -> 'Judgement':
        """Return the judgement of some factors, (k,), which may repeat."""
        slipped = np.isin(np.arange(len(self.accepted)), self.slips)
        return replace(self, accepted=self.accepted[which], suspect=self.suspect[which],
                       sigmas=self.sigmas[which], noise=self.noise[which],
                       slips=np.flatnonzero(slipped[which]))

    def believed(self, graph: FactorGraph) -> FactorGraph:
        """Return the accepted factors of a graph, with their noise."""
        return self.corrected(graph).subset(self.accepted, self.noise[self.accepted])

    def corrected(self, graph: FactorGraph) -> FactorGraph:
        """Return a graph with the variance `meant`, and without drift."""
        return straightened(weighed(graph, self.meant), self.drift)

    def found_variance(self, graph: FactorGraph) -> Array:
        """Return the estimated variance of accepted factors, (k,), in units of `believed`."""
        loops = ~graph.between.is_odometry[self.accepted]
        # With estimated noise in the map, odometry is the unit.
        return self.variance_meant[(loops & self.is_noise_stated).astype(np.int64)]

    @property
    def variance_meant(self) -> Array:
        """Estimated variance of odometry and loops, (2,), in units of `meant`."""
        return self.variance / np.exp(np.log(self.meant).mean(axis=1))

    def extended(self, graph: FactorGraph, robust: bool) -> 'Judgement':
        """
        Return the judgement of every present factor.

        New odometry is accepted; new loops are suspect until tested, accepted if not robust.
        Trusted and struck ones are updated.
        """
        factors = graph.between
        known = len(self.accepted)
        odometry = factors.is_odometry[known:]
        accepted = np.concatenate((self.accepted, odometry)) if robust else True
        accepted = (accepted | factors.trusted) & ~factors.struck
        suspect = np.concatenate((self.suspect, ~odometry)) & ~accepted & ~factors.struck
        sigmas = np.concatenate((self.sigmas, np.full(len(factors) - known, np.nan)))
        noise = np.ones(len(factors))
        if not self.is_noise_stated:
            noise[~factors.is_odometry] = self.variance_meant[1] / self.variance_meant[0]
        noise[:len(self.noise)] = self.noise
        told = not np.array_equal(accepted[:known], self.accepted)
        return replace(
            self, accepted=accepted, suspect=suspect, sigmas=sigmas, noise=noise,
            settled=not robust or (self.settled and not told and not suspect[known:].any()))


def doubt_of(graph: FactorGraph, rows: Indices | Mask, kind: str, detail: str = '') -> Doubt:
    """Return a doubt about some loops of a graph; none: about all its keyframes."""
    pairs = graph.between.pairs[rows]
    first, last = ((max(int(pairs.min()), 0), int(pairs.max())) if len(pairs)
                   else (0, graph.n_poses - 1))
    return Doubt(kind, len(pairs), first, last, detail, listed(pairs))


def listed(pairs: Indices) -> tuple[tuple[int, int], ...]:
    """Return pairs of keyframes (k, 2) in the form of a doubt."""
    return tuple((i, j) for i, j in pairs.tolist())


def weighed(graph: FactorGraph, variance: Array) -> FactorGraph:
    """Return a graph with its variance scaled by (2, k), of odometry and of loops."""
    if (variance == 1).all():
        return graph
    is_loop = ~graph.between.is_odometry
    return graph.subset(np.arange(len(is_loop)), variance[is_loop.astype(np.int64)])


def so_far(growth: Growth, drift: float = 0.0) -> Judgement:
    """Return the judgement of a state before tests; loops not accepted are suspect."""
    given = growth.given
    size = given.size
    slip = growth.cut & ~given.gap
    accepted = (growth.accepted & ~slip)[:size]
    return Judgement(accepted, given.is_loop[:size] & ~accepted, np.full(size, np.nan),
                     growth.noise.variance.copy(), np.ones(size), np.flatnonzero(slip[:size]),
                     drift=drift)


def judgement_of(growth: Growth) -> Judgement:
    """Return a state's judgement of the given factors, without doubts."""
    believed = so_far(growth)
    square, suspect = fits(growth)
    given = growth.given
    size = given.size
    loops = given.is_loop[:size]
    left_out = np.count_nonzero(loops & ~believed.accepted)
    doubted = bool(2 * left_out > np.count_nonzero(loops) >= RUN)
    return replace(believed, suspect=suspect[:size], sigmas=np.sqrt(square[:size]),
                   noise=_noise(growth)[:size], is_refusal_doubted=doubted)


def _noise(growth: Growth) -> Array:
    """
    Return the variance of each factor in a map, (m,), in units of the stated.

    Ones, unless clearly wrong: where loops are noisier than stated and those of a place share an
    error, these count as one, and all have their estimated noise, in units of odometry.
    """
    given = growth.given
    noise = np.ones(len(given.factors))
    rows = np.flatnonzero(growth.accepted)
    at = np.flatnonzero((given.is_loop & ~given.factors.is_absolute)[rows])
    loops = rows[at]
    variance = growth.noise.variance
    if len(loops) and variance[1] > 1 and err_together(
            given.place[loops], growth.posterior.residual[at], growth.posterior.left_over(at)):
        noise[given.is_loop] = variance[1] / variance[0]
        noise[given.factors.is_absolute] = 1 / variance[0]
        noise[loops] *= np.bincount(given.place[loops])[given.place[loops]]
    return noise


def fits(growth: Growth) -> tuple[Array, Mask]:
    """
    Return how well each factor fits, a square (m,) of sigmas, and suspect loops, (m,) bool.

    The squared residual, for factors not accepted the NIS. Suspect loops pass the gate but were
    not accepted.
    """
    given = growth.given
    accepted = growth.accepted & ~growth.cut
    square = np.zeros(len(given.factors))
    square[growth.accepted] = (growth.posterior.residual**2).sum(axis=1)
    # Absolute factors are not predicted before any is accepted, nor are factors between parts.
    square[~accepted] = np.nan
    outside = np.flatnonzero(~accepted & growth.may_be_predicted & ~growth.across())
    square[outside] = growth.uncut().innovations(outside).square
    far = square >= given.gate(given.factors.freedom)
    return square, ~accepted & ~far & given.is_loop
