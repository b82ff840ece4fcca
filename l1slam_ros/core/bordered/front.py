# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Innovation gating (NIS) of new factors, on a map that they move at once.

In: a map, the factors that it is of, and factors as they come. Out: which of them to believe, and
where all keyframes are. An update costs what has come since the map was factored, whatever the
size of the map: see `bordered_system`.

Two systems are kept, of two maps. In the least squares map the innovation of a true factor has a
known distribution: that is the gate. The other one has the weights 1 / sqrt(e^2 + mu^2), with
which least squares has nearly the optimum of the L1 norm: that is the map that is published.

Jacobians of new factors are taken where their keyframes were first linearised, residuals where
they are: with Jacobians at poses that have moved since, a map turns for which no factor speaks
(Huang, Mourikis and Roumeliotis, "Observability-based rules for designing consistent EKF SLAM
estimators", 2010).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l1slam_ros.core.bordered.bordered_system import BorderedSystem, Prediction, Steps
from l1slam_ros.core.bordered.linearised import Linearised, Pair, in_order
from l1slam_ros.core.bordered.points import FIXED
from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import WORLD, BetweenFactors, FactorGraph
from l1slam_ros.core.graph.growable_array import GrowingArray, few_rows
from l1slam_ros.core.graph.linear_system import anchor, linearise
from l1slam_ros.core.robust.innovation import chi2_quantile, claimed_volume
from l1slam_ros.core.robust.odometry.drift import corrected
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.optimality import smoothing

# The two maps.
L1, L2 = 0, 1
# mu, where the weights of the L1 map turn over, in mean |e|.
_SMOOTHING = 0.1
# One in so many true loops may be left to the judge for its noise alone.
_REFUSED = 1e-3
# Of the loops admitted, one in so many may be false.
_SURE = 1000.0
# Rows of a border, and keyframes it touches, that one more update has the time and the memory for.
# What comes then waits for the next map.
MOST_ROWS, _MOST_POINTS = 1800, 1400
# What to do with a factor: accept it; skip it, since the map has it or shall not have it; gate it.
BELIEVE = 1
SKIP = 0
GATE = -1


@dataclass(frozen=True)
class Look:
    """What the gate says of a factor; see `Judgement`."""

    accepted: bool
    suspect: bool
    sigmas: float


# The look at a factor that was skipped.
_SKIPPED = Look(False, False, np.nan)


@dataclass(frozen=True)
class View:
    """
    One of the maps at one moment, to be worked out at leisure.

    first : (n, p) where the keyframes began; fixed : so many are held fixed; steps : of the others
    """

    manifold: Manifold
    first: Array
    fixed: int
    steps: Steps

    @cached_property
    def poses(self) -> Array:
        """All keyframes, (n, p)."""
        moved = self.manifold.retract(self.first[self.fixed:], self.steps.all())
        return np.concatenate((self.first[:self.fixed], moved))


class Front:
    """
    A factored map, and the factors that came since.

    Parameters
    ----------
    part : the factors that the map is of
    poses : their L1 map, (n, p), and their L2 map with the noise as it was found
    choleskys : of the part, the second holds the factor of that L2 map; the front keeps them
    variance : (2,) of odometry and loops, in units of what they state
    log_odds : of a false loop to a true one
    rows : factors of the graph that grows, when `part` was taken from it
    drift : of the odometry that is to come, see `Judgement`

    Attributes
    ----------
    rows : how many of them it knows; taken : of those that came since, it was not to skip so many
    closed : it takes no more
    pattern : of its factors
    variance : (2,) as above

    Raises
    ------
    GraphError : some keyframe is not tied to the anchor.

    """

    def __init__(self, part: FactorGraph, poses: tuple[Array, Array],
                 choleskys: tuple[BlockCholesky, BlockCholesky], variance: Array,
                 log_odds: float, rows: int, drift: float = 0.0):
        self._drift = drift
        self.rows = rows
        self.taken = 0
        self.closed = False
        self.pattern = choleskys[L1].pattern
        self.variance = variance
        self._manifold = part.manifold
        self._fixed = anchor(part)
        system = linearise(part, poses[L1])
        k = part.manifold.TANGENT_SIZE
        # What a square stays below, and the log ratio but for what hangs on the factor.
        self._limit = float(chi2_quantile(1 - _REFUSED, np.array([k]))[0])
        self._volume = (float(claimed_volume(part.manifold, poses[L1]).sum())
                        - k * np.log(2 * np.pi) / 2 - np.log(_SURE - 1) - log_odds)
        self._variance = np.repeat(variance[:, None], k, axis=1)
        self._mu = _SMOOTHING * smoothing(system.b)
        weights = 1 / np.hypot(system.b, self._mu)
        if not choleskys[L1].factorise(system, weights):
            raise GraphError('a part of the graph is not tied to the anchor')
        # The weight of a new factor in the L1 map hangs on the residual that those to come will
        # leave of it. Till then: of the first factor of a keyframe the mean of all weights and of
        # one without a residual; of a loop the geometric mean of that and of its own.
        self._usual = np.full(k, 1 / np.append(weights, 1 / self._mu).mean())
        self._systems = [BorderedSystem(cholesky, system.size, k, _MOST_POINTS, MOST_ROWS)
                         for cholesky in choleskys]
        self._first = GrowingArray((2, part.manifold.POSE_SIZE))
        self._first.extend(np.stack(poses, axis=1))

    @property
    def keyframes(self) -> int:
        """How many keyframes it knows."""
        # What a factor that failed wanted to see does not count.
        return self._fixed + self._systems[L1].keyframes

    @property
    def border(self) -> int:
        """How many rows the bordered system has."""
        return self._systems[L1].rows

    @property
    def views(self) -> tuple[View, View]:
        """The L1 and the L2 map as they are now."""
        first = self._first.view()[:self.keyframes]
        return (View(self._manifold, first[:, L1], self._fixed, self._systems[L1].steps()),
                View(self._manifold, first[:, L2], self._fixed, self._systems[L2].steps()))

    def poses_of(self, keyframes: Indices) -> Array:
        """Return the L1 poses of some keyframes that it knows, (m, p)."""
        steps = self._systems[L1].step(list(map(self._end, keyframes.tolist())))
        first = few_rows(self._first.view(), keyframes)[:, L1]
        return self._manifold.retract(first, steps)

    def covariance(self, keyframe: int, seen_from: int | None = None) -> Array:
        """
        Return the covariance of a keyframe in its own axes, in the L2 map, (k, k).

        seen_from : relative to this keyframe, None: to what the map is held by
        """
        turn = np.zeros((len(self._usual),) * 2)
        other = FIXED
        if seen_from is not None:
            here, there = self.poses_of(np.array([keyframe, seen_from]))[:, None]
            turn = self._manifold.adjoint(self._manifold.between(here, there))[0]
            other = self._end(seen_from)
        return self._systems[L2].covariance(self._end(keyframe), other, turn)

    def take(self, factors: BetweenFactors, what: Indices) -> list[Look]:
        """
        Take the next factors, from row `rows` on; return what the gate says of those it took.

        what : to do with each, `BELIEVE`, `SKIP` or `GATE`, a few at a time. It returns looks at
        fewer where the next one is beyond it: it takes no more then
        """
        looks: list[Look] = []
        wanted = what.tolist()
        rows = range(self.rows, self.rows + len(wanted))
        asked = [row for row, one in zip(rows, wanted, strict=True) if one != SKIP]
        if not asked:
            self.rows += len(wanted)
            return len(wanted) * [_SKIPPED]
        pairs = list(zip(factors.i[rows.start:rows.stop].tolist(),
                         factors.j[rows.start:rows.stop].tolist(), strict=True))
        first = asked[0] - rows.start
        self.closed = self._is_beyond(pairs[first], wanted[first])
        if self.closed:
            return looks
        # Only these: each keyframe that is touched makes the next one cost more.
        before = [system.points for system in self._systems]
        linearised = self._linearise(factors, asked, [pairs[row - rows.start] for row in asked])
        at = 0
        for pair, one in zip(pairs, wanted, strict=True):
            if one == SKIP:
                look: Look | None = _SKIPPED
            elif self._is_beyond(pair, one):
                look = None
            else:
                look = self._look(factors, linearised, at, pair, one)
                at += 1
            if look is None:
                self.closed = True
                break
            self.rows += 1
            self.taken += one != SKIP
            looks.append(look)
        for system, points in zip(self._systems, before, strict=True):
            system.forget_unused(points)
        return looks

    def _is_beyond(self, pair: Pair, what: int) -> bool:
        """Tell whether a factor must wait for the next map."""
        return (max(pair) > self.keyframes or (what == BELIEVE and self._turns(pair))
                or self.border > MOST_ROWS or self._systems[L2].points > _MOST_POINTS)

    def _turns(self, pair: Pair) -> bool:
        """Tell whether a factor is the first that names the world: the gauge is another."""
        return pair[0] == WORLD and self._fixed > 0

    def _look(self, factors: BetweenFactors, new: Linearised, at: int, pair: Pair,
              what: int) -> Look | None:
        """Gate a factor, and make it part of the map where it is accepted; None: it cannot be."""
        own = factors.sqrt_information[self.rows].diagonal()
        # A factor that leaves a component unsaid is left to the judge.
        if what == GATE and (self._turns(pair) or not own.all()):
            return Look(False, True, np.nan)
        first_seen = self.keyframes in pair
        l1, l2 = self._systems
        try:
            if first_seen:
                l2.begin(*new.of(L2, at), self._variance[0])
                l1.begin(*new.of(L1, at), self._usual)
                return Look(True, False, 0.0)
            variance = self._variance[1]
            predicted = l2.predict(*new.of(L2, at))
            look, left = self._gate(predicted, own, variance, what == BELIEVE)
            if look.accepted:
                l2.add(predicted, variance)
                noise = np.sqrt(self._usual * np.hypot(left, self._mu))
                l1.add(l1.predict(*new.of(L1, at)), noise)
        except np.linalg.LinAlgError:
            # Beyond double precision here; the next map may be able to take it.
            return None
        return look

    def _gate(self, predicted: Prediction, own: Array, variance: Array,
              sure: bool) -> tuple[Look, Array]:
        """
        Return what the innovation of a loop says, and its residual once it is accepted, (k,).

        own : diagonal of the root of its information; variance : of its noise, (k,); sure : it is
        accepted whatever the gate says. The NIS has to be below the limit of chi2, and the log
        ratio of a true loop to a false one, anywhere on the map, above 0.
        """
        covariance = predicted.covariance + np.diag(variance)
        whitened = np.linalg.solve(covariance, predicted.residual)
        nis = float(predicted.residual @ whitened)
        left = variance * whitened
        sigmas = float(np.sqrt(left @ (left / variance)))
        if sure:
            return Look(True, False, sigmas), left
        log_ratio = float(self._volume + np.log(own).sum() - nis / 2
                          - np.linalg.slogdet(covariance)[1] / 2)
        fits = nis < self._limit
        accepted = fits and log_ratio > 0
        return Look(accepted, fits and not accepted,
                    sigmas if accepted else float(np.sqrt(nis))), left

    def _linearise(self, factors: BetweenFactors, asked: list[int],
                   pairs: list[Pair]) -> Linearised:
        """
        Return factors as the bordered systems want them, up to the first that is beyond them.

        A keyframe that a factor sees for the first time is put where it says; keyframes have to
        be seen in the order of their indices, so a factor that skips one is beyond.
        """
        manifold = self._manifold
        pairs = pairs[:in_order(pairs, len(self._first))]
        rows = np.array(asked[:len(pairs)])
        Z, root = few_rows(factors.measurement, rows), few_rows(factors.sqrt_information, rows)
        if self._drift:
            odometry = factors.is_odometry[rows]
            Z[odometry] = corrected(factors, rows[odometry], self._drift)
        self._put_new(pairs, Z)
        first, steps, poses = self._moved([*(i for i, _ in pairs), *(j for _, j in pairs)])
        p, k = first.shape[2], steps.shape[2]
        # Of each factor in both maps: Jacobians at the first poses, residuals at those of now.
        Z = np.repeat(Z, 2, axis=0)
        root = root[:, None]
        J = manifold.residual_jacobians(Z, *first.reshape(2, -1, p)).reshape(-1, 2, 2, k, k)
        e = manifold.residual(Z, *poses.reshape(2, -1, p)).reshape(-1, 2, k)
        blocks = root[:, None] @ J
        whitened = (root @ e[..., None])[..., 0]
        # As it would be at no step: r + J x is e then at the step there is.
        steps = steps.reshape(2, -1, 2, k).transpose(1, 2, 0, 3)
        residual = whitened - (blocks @ steps[..., None])[..., 0].sum(axis=2)
        return Linearised([(self._end(i), self._end(j)) for i, j in pairs], blocks, residual)

    def _put_new(self, pairs: list[Pair], Z: Array) -> None:
        """Put keyframes that are seen for the first time where Z (m, p) says."""
        manifold = self._manifold
        for pair, seen in zip(pairs, Z, strict=True):
            new = len(self._first)
            if max(pair) == new:
                _, _, seen_from = self._moved([min(pair)])
                self._first.extend(manifold.compose(
                    seen_from, seen if pair[1] == new else manifold.inverse(seen)))

    def _moved(self, keyframes: list[int]) -> tuple[Array, Array, Array]:
        """Return where keyframes began, their steps and where they are, (m, 2, p or k) each."""
        manifold, known = self._manifold, self._first.view()
        first = np.empty((len(keyframes), *known.shape[1:]))
        steps = np.empty((*first.shape[:2], len(self._usual)))
        for at, keyframe in enumerate(keyframes):
            first[at] = known[keyframe] if keyframe != WORLD else manifold.identity(1)
        ends = list(map(self._end, keyframes))
        for which, system in enumerate(self._systems):
            steps[:, which] = system.step(ends)
        return first, steps, manifold.retract(first, steps)

    def _end(self, keyframe: int) -> int:
        """Return what a keyframe is called in the bordered systems."""
        return max(keyframe - self._fixed, FIXED)
