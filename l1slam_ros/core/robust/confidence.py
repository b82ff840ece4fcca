# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Confidence of a map: alternative maps, their odds, and whether they make it wrong.

In: the end of an audit. Out: the alternatives with log odds, and how likely the map is wrong if
one is right.

A map is right if its error is at most 1.5 times that of the map of true factors alone, and .1 m
(RMSE, aligned). If an alternative is right, the truth is its map plus an error drawn from its
posterior; samples give the probability, `harm`, that the map is wrong then. With independent
alternatives a,

    P(right) = product of 1 - P(a) harm(a)
"""

from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.alignment import align
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.robust.gating import probability
from l1slam_ros.core.robust.innovation import factorised, spread_of
from l1slam_ros.core.robust.rounds.growth import Growth
from l1slam_ros.core.solvers.block_cholesky import cholesky_of

# Limit of the error of a right map: a multiple of that of the true factors' map, plus [m].
TIMES, METRES = 1.5, 0.1
# Below, a map is doubtful.
CONFIDENT = 0.9
# Alternatives less likely are ignored.
UNLIKELY = 1e-3
# Maps are compared at about this number of keyframes.
_COMPARED = 200


@dataclass(frozen=True)
class Drawn:
    """
    A map at some of its keyframes, with posterior samples of its error.

    poses : (l, p); samples : (l, k, q); part : (l,) component of each
    """

    manifold: Manifold
    poses: Array
    samples: Array
    part: Indices

    @staticmethod
    def of(manifold: Manifold, poses: Array, samples: Array, part: Indices) -> 'Drawn':
        """Return the record of a map (n, p), from samples of its free keyframes, part (n,)."""
        fixed = np.zeros((len(poses) - len(samples), *samples.shape[1:]))
        some = compared(len(poses))
        return Drawn(manifold, poses[some], np.concatenate((fixed, samples))[some], part[some])

    @property
    def expected(self) -> float:
        """Expected error by the posterior [m]."""
        return float(np.sqrt((self._errors(self, self._largest)**2).mean()))

    def harm(self, other: 'Drawn | None') -> float:
        """Return how likely the map is wrong if another is right, None: any."""
        if other is None:
            return 1.0
        own = self._largest
        limit = TIMES * other._errors(other, own) + METRES
        return float((other._errors(self, own) > limit).mean())

    @property
    def _largest(self) -> Mask:
        return np.asarray(self.part == np.bincount(self.part).argmax())

    def _errors(self, found: 'Drawn', own: Mask) -> Array:
        """Return samples of the error of a map if this one is right, (q,) RMSE [m]."""
        positions, samples = self.manifold.positions, np.moveaxis(self.samples[own], 2, 0)
        poses = np.tile(self.poses[own], (len(samples), 1))
        truth = positions(self.manifold.retract(poses, samples.reshape(len(poses), -1)))
        truth = truth.reshape(len(samples), -1, truth.shape[1])
        map_ = np.broadcast_to(positions(found.poses[own]), truth.shape)
        R, t = align(map_, truth)
        off = map_ @ R.swapaxes(1, 2) + t[:, None] - truth
        return np.sqrt((off**2).sum(axis=2).mean(axis=1))


@dataclass(frozen=True)
class Alternative:
    """
    A map that may be right instead of the one found.

    Attributes
    ----------
    kind : see `judgement`
    loops : (k,) concerned
    odds : ln P(this map) / P(the map found)
    map : this map, None: any
    step : odometry factor concerned, -1: none
    detail : of the doubt

    """

    kind: str
    loops: Indices
    odds: float
    map: Drawn | None = None
    step: int = -1
    detail: str = ''

    @property
    def chance(self) -> float:
        """Probability of the alternative."""
        return float(probability(np.array(self.odds)))


def compared(n: int) -> slice:
    """Return which of n keyframes to compare."""
    return slice(None, None, max(1, n // _COMPARED))


def drawn(growth: Growth) -> Drawn:
    """Return the map of a state, with its error by the estimated noise."""
    given = growth.given
    variance, used = growth.noise.each, growth.noise.assumed
    samples = growth.posterior.samples[:-1]
    if not np.allclose(variance, used):
        rows = np.flatnonzero(growth.accepted)
        graph = growth.subgraph(rows)
        noise = (variance / used)[given.is_loop[rows].astype(np.int64)]
        noise[given.factors.is_absolute[rows]] = 1.0
        samples = spread_of(graph, growth.poses, cholesky_of(graph), noise)
    return Drawn.of(given.graph.manifold, growth.poses, samples, growth.part)


class Shifts:
    """First-order maps without an accepted place, or with one more factor."""

    def __init__(self, growth: Growth, map_: Drawn):
        self._growth, self._map = growth, map_
        graph = growth.subgraph(np.flatnonzero(growth.accepted))
        self._cholesky = cholesky_of(graph)
        self._system = factorised(graph, growth.poses, self._cholesky)

    def without(self, at: Indices, B: Array, M: Array) -> Drawn:
        """
        Return the map where accepted factors have one error d, with information M by all else.

        at : (l,) the factors, among accepted; B : (l, k, k) derivatives of their residuals by d
        """
        posterior = self._growth.posterior
        gain = []
        for column in np.moveaxis(B, 2, 0):
            right = np.zeros((len(self._system.blocks), len(column[0])))
            right[at] = column
            gain.append(self._some(self._cholesky.solve(
                self._system.transposed_times(right.ravel()))))
        r = np.concatenate((posterior.residual[at, :, None], posterior.left_over(at)), axis=2)
        return self._moved(gain, np.linalg.solve(M, np.einsum('lij,liq->jq', B, r)))

    def with_one(self, row: int) -> Drawn:
        """Return the map with one more factor: x = H^-1 A' (A H^-1 A' + I)^-1 b."""
        growth = self._growth
        system = replace(growth.innovations(np.array([row])).system, size=self._system.size)
        k = system.block_size
        whole = [self._cholesky.solve(system.transposed_times(e)) for e in np.eye(k)]
        S = np.stack([system.times(x) for x in whole], axis=1) + np.eye(k)
        moved = native.prediction.moved(system.keyframe, system.blocks,
                                        growth.posterior.samples)[0]
        noise = np.where(np.arange(moved.size).reshape(moved.shape) % 2, 1.0, -1.0)
        b = np.concatenate((system.b[:, None], noise - moved), axis=1)
        return self._moved([self._some(x) for x in whole], np.linalg.solve(S, b))

    def _some(self, step: Array) -> Array:
        poses, fixed = self._growth.poses, self._growth.posterior.fixed
        whole = np.zeros((len(poses), self._system.block_size))
        whole[fixed:] = step.reshape(len(poses) - fixed, -1)
        return whole[compared(len(poses))]

    def _moved(self, gain: list[Array], d: Array) -> Drawn:
        """Return the map and samples moved by gain d, d (k, 1 + q)."""
        step = np.stack(gain, axis=2) @ d
        manifold = self._map.manifold
        return replace(self._map, poses=manifold.retract(self._map.poses, step[:, :, 0]),
                       samples=self._map.samples + step[:, :, 1:])
