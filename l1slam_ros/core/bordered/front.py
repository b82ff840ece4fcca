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
size of the map: the factored normal matrix is bordered by the later factors, row by row, in
`native/border.hpp`.

Two systems are kept, of two maps. In the least squares map the innovation of a true factor has a
known distribution: that is the gate. The other one has the weights 1 / sqrt(e^2 + mu^2), with
which least squares has nearly the optimum of the L1 norm: that is the map that is published.

Jacobians of new factors are taken where their keyframes were first linearised, residuals where
they are: with Jacobians at poses that have moved since, a map turns for which no factor speaks
(Huang, Mourikis and Roumeliotis, "Observability-based rules for designing consistent EKF SLAM
estimators", 2010).
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import WORLD, BetweenFactors, FactorGraph
from l1slam_ros.core.graph.linear_system import anchor, linearise
from l1slam_ros.core.robust.innovation import chi2_quantile, claimed_volume
from l1slam_ros.core.robust.odometry.drift import corrected
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.optimality import smoothing

# The two maps, as `native.front` numbers them.
L1, L2 = 0, 1
# In the place of a keyframe: what the map is held by.
_HELD = -1
# mu, where the weights of the L1 map turn over, in mean |e|.
_SMOOTHING = 0.1
# One in so many true loops may be left to the judge for its noise alone.
_REFUSED = 1e-3
# Of the loops admitted, one in so many may be false.
_SURE = 1000.0
# Rows of a border, and keyframes it touches, that one more update has the time and the memory for.
# What comes then waits for the next map.
MOST_ROWS, _MOST_POINTS = 1800, 1400
# So many keyframes of a path to the root of the elimination tree have their columns of L^-1 kept:
# 70 kB in the plane.
_LONGEST = 1024
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
# The first factor of a keyframe; a factor that no front can gate.
_FIRST = Look(True, False, 0.0)
_LEFT_TO_THE_JUDGE = Look(False, True, np.nan)


@dataclass(frozen=True)
class View:
    """
    One of the maps at one moment, to be worked out at leisure.

    first : (n, p) where the keyframes of H began; fixed : so many are held fixed; cholesky : holds
    the factor of H; pulled, pull : (o,) keyframes of H, behind the fixed ones, and (o, k) what
    pulls at them; parent (b,), turn (b, k, k), shift (b, k), began (b, p) : of the new keyframes
    """

    manifold: Manifold
    first: Array
    fixed: int
    cholesky: BlockCholesky
    pulled: Indices
    pull: Array
    parent: Indices
    turn: Array
    shift: Array
    began: Array

    @cached_property
    def poses(self) -> Array:
        """All keyframes, (n + b, p)."""
        free, new = len(self.first) - self.fixed, len(self.parent)
        steps = np.zeros((free + new, self.manifold.TANGENT_SIZE))
        # 1. Of the keyframes of H: H^-1 times what the factors of the border pull at them.
        if len(self.pulled):
            steps[self.pulled] = self.pull
            steps[:free] = self.cholesky.solve(steps[:free].ravel()).reshape(free, -1)
        # 2. Of the new ones: each follows what it hangs on.
        native.front.hang(self.parent, self.turn, self.shift, steps)
        # 3. Steps move the poses at which all was linearised.
        first = np.concatenate((self.first, self.began))
        moved = self.manifold.retract(first[self.fixed:], steps)
        return np.concatenate((first[:self.fixed], moved))


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
        mu = _SMOOTHING * smoothing(system.b)
        weights = 1 / np.hypot(system.b, mu)
        if not choleskys[L1].factorise(system, weights):
            raise GraphError('a part of the graph is not tied to the anchor')
        # The weight of a new factor in the L1 map hangs on the residual that those to come will
        # leave of it. Till then: of the first factor of a keyframe the mean of all weights and of
        # one without a residual; of a loop the geometric mean of that and of its own.
        usual = 1 / np.append(weights, 1 / mu).mean()
        self._choleskys = choleskys
        self._first = [np.ascontiguousarray(of_one) for of_one in poses]
        of_odometry, of_loops = variance.tolist()
        self._border = native.front.begin(
            self._first[L1], self._first[L2], self._fixed, usual, mu, of_odometry, of_loops,
            _LONGEST, *choleskys[L1].factor, *choleskys[L2].factor)

    @property
    def keyframes(self) -> int:
        """How many keyframes it knows."""
        return self._border.keyframes()

    @property
    def border(self) -> int:
        """How many rows the bordered system has."""
        return self._border.rows()

    @property
    def views(self) -> tuple[View, View]:
        """The L1 and the L2 map as they are now."""
        return self._view(L1), self._view(L2)

    def _view(self, of: int) -> View:
        return View(self._manifold, self._first[of], self._fixed, self._choleskys[of],
                    *self._border.moment(of))

    def poses_of(self, keyframes: Indices) -> Array:
        """Return the L1 poses of some keyframes that it knows, (m, p)."""
        return self._border.poses(L1, keyframes)

    def covariance(self, keyframe: int, seen_from: int | None = None) -> Array:
        """
        Return the covariance of a keyframe in its own axes, in the L2 map, (k, k).

        seen_from : relative to this keyframe, None: to what the map is held by
        """
        k = self._manifold.TANGENT_SIZE
        if seen_from is None:
            return self._border.covariance(keyframe, _HELD, np.zeros((k, k)))
        here, there = self.poses_of(np.array([keyframe, seen_from]))[:, None]
        turn = self._manifold.adjoint(self._manifold.between(here, there))[0]
        return self._border.covariance(keyframe, seen_from, turn)

    def take(self, factors: BetweenFactors, what: Indices) -> list[Look]:
        """
        Take the next factors, from row `rows` on; return what the gate says of those it took.

        what : to do with each, `BELIEVE`, `SKIP` or `GATE`. It returns looks at fewer where the
        next one is beyond it: it takes no more then
        """
        looks: list[Look] = []
        rows = slice(self.rows, self.rows + len(what))
        for i, j, one in zip(factors.i[rows].tolist(), factors.j[rows].tolist(), what.tolist(),
                             strict=True):
            look = self._look(factors, i, j, one)
            if look is None:
                self.closed = True
                break
            self.rows += 1
            self.taken += one != SKIP
            looks.append(look)
        return looks

    def _look(self, factors: BetweenFactors, i: int, j: int, what: int) -> Look | None:
        """Gate the next factor, from keyframe i to j; None: it must wait for the next map."""
        # 1. What the map has, or shall not have.
        if what == SKIP:
            return _SKIPPED
        # 2. Beyond the front: a keyframe that it skipped, another gauge, no time or memory left.
        border = self._border
        known = border.keyframes()
        turns = i == WORLD and self._fixed > 0
        if (max(i, j) > known or (what == BELIEVE and turns) or border.rows() > MOST_ROWS
                or border.points() > _MOST_POINTS):
            return None
        if turns:
            return _LEFT_TO_THE_JUDGE
        z, root = factors.measurement[self.rows], factors.sqrt_information[self.rows]
        # 3. A keyframe is put where the first factor that sees it says.
        if known in (i, j):
            if self._drift and 0 <= min(i, j) == factors.predecessor[known]:
                z = corrected(factors, np.array([self.rows]), self._drift)[0]
            return _FIRST if border.append_keyframe(i, j, z, root) else None
        # 4. The innovation of a loop in the L2 map, and its likelihood.
        nis, log_likelihood, sigmas = border.predict(i, j, z, root)
        if math.isnan(nis):
            return None  # beyond double precision here; the next map may be able to take it
        if what == GATE:
            # 5. Gate it by its NIS and by the odds of a true loop to a false one.
            fits = nis < self._limit
            if log_likelihood == -math.inf or not (fits and self._volume + log_likelihood > 0):
                border.refuse()
                # One that leaves a component unsaid is left to the judge.
                return (_LEFT_TO_THE_JUDGE if log_likelihood == -math.inf else
                        Look(False, fits, math.sqrt(nis)))
        # 6. Append it to both maps.
        return Look(True, False, sigmas) if border.append() else None
