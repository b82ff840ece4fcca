# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Which absolute factors to believe first, while nothing ties the map to the world.

In: a graph with odometry. Out: some absolute factors, neighbours in time, that agree with each
other through the odometry between them; and by how much its noise is misstated. Far from each
other, odometry says nothing of how true fixes lie; near, it says it well.

A window is a few fixes in a row. Its first ones say where the map is: one whose pose is whole, or
as many positions as there are dimensions. What the others should measure follows, by odometry;
how well that is known, samples of the noise say.
"""

import numpy as np

from l1slam_ros.core.geometry.alignment import align
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask, covariance_of
from l1slam_ros.core.graph.factor_graph import FactorGraph, ends_in_time, lowest_of_components
from l1slam_ros.core.graph.spanning_tree import odometry_poses

# So many windows at most are looked at, of so many fixes; and so many for the noise alone.
_WINDOWS = 2000
_SIZE = 8
_FOR_NOISE = 100
# By so many samples, the same each time.
_SAMPLES, _SEED = 24, 2014
# Variances that the odometry may have, in units of what it states.
_VARIANCES = 3.0 ** np.arange(-6, 4)
# A variance that is none, so that matrices have a root.
_TINY = 1e-12
# A window is believed where it agrees by chance with this probability at most; a fix of it, too.
_CHANCE = 0.01


def first_fixes(graph: FactorGraph, latest: int | None = None,
                variance: float | None = None) -> tuple[Indices, float]:
    """
    Return the absolute factors that may be believed first, and the variance of the odometry.

    They are those of the windows that agree, as far as they overlap: the most that can be had.
    Where no window agrees beyond chance, those that say where the map is, and no more.

    Parameters
    ----------
    latest : so many of the last fixes are looked at; None: all
    variance : of the odometry, in units of what is stated; None: to be found

    Raises
    ------
    GraphError : the odometry has a gap.

    """
    factors = graph.between
    leading = graph.manifold.TRANSLATION.stop
    rows = np.flatnonzero(factors.is_absolute)
    rows = rows[np.argsort(factors.j[rows], kind='stable')][-(latest or len(rows)):]
    size = min(_SIZE, len(rows))
    if size <= leading:
        return rows, variance or 1.0
    samples = _Samples(graph, rows)
    strides = np.arange(1, max((size - 1) // (leading - 1), 2))
    near = list(strides[:, None] * np.arange(leading))
    if variance is None:
        variance = _likeliest_variance(samples, _windows(len(rows), size, _FOR_NOISE), near)
    leads = [*near, *(size - 1 - lead for lead in near)]
    windows = _windows(len(rows), size, _WINDOWS)
    ratio = np.concatenate([samples.log_ratio(windows, variance, lead) for lead in leads])
    windows = np.tile(windows, (len(leads), 1))
    agreed = np.where(ratio > 0, ratio, 0.0)
    agreed[np.isinf(agreed)] = 0.0
    sure = agreed.sum(axis=1) > np.log(len(windows) / _CHANCE)
    if not sure.any():
        best = int(np.argmax(agreed.sum(axis=1)))
        return rows[windows[best, np.isposinf(ratio[best])]], variance
    good = ratio[sure] > -np.log(_CHANCE)
    return rows[_largest_group(len(rows), windows[sure], good)], variance


def _likeliest_variance(samples: '_Samples', windows: Indices, leads: list[Indices]) -> float:
    """Return the variance by which fixes follow best from each other, half of them true."""
    def likely(variance: float) -> float:
        ratios = [samples.log_ratio(windows, variance, lead) for lead in leads]
        return sum(float(np.logaddexp(0.0, ratio[ratio < np.inf]).sum()) for ratio in ratios)

    return float(max(_VARIANCES.tolist(), key=likely))


def _windows(count: int, size: int, most: int) -> Indices:
    """Return windows (w, size) of so many things in a row, evenly, all or not more than `most`."""
    starts = np.linspace(0, count - size, min(most, count - size + 1)).astype(int)
    return starts[:, None] + np.arange(size)


def _largest_group(count: int, windows: Indices, good: Mask) -> Indices:
    """Return the largest group of `count` things that good windows connect, (k,)."""
    first = windows[np.arange(len(windows)), np.argmax(good, axis=1)]
    lowest = lowest_of_components(np.repeat(first, good.sum(axis=1)), windows[good], count)
    return np.flatnonzero(lowest == np.argmax(np.bincount(lowest)))


class _Samples:
    """
    What windows (w, k) of absolute factors may measure of each other; rows : in order of time.

    Samples stand in front, (q, w, k, ...), the first one is without noise.
    """

    def __init__(self, graph: FactorGraph, rows: Indices):
        manifold, factors = graph.manifold, graph.between
        rng = np.random.default_rng(_SEED)
        d = manifold.TANGENT_SIZE
        poses = odometry_poses(graph)
        keyframe = factors.j[rows]
        self._manifold = manifold
        self._fixes = graph.subset(rows).between
        self._way = manifold.between(poses[keyframe[:-1]], poses[keyframe[1:]])
        self._drift = _samples(_drift(graph, poses, keyframe), rng)
        self._noise = _samples(covariance_of(self._fixes.sqrt_information), rng)
        # A false fix may be anywhere where the others are, and turned anyhow.
        width = np.full(d, np.pi**2 / 3)
        width[manifold.TRANSLATION] = 2 * manifold.positions(self._fixes.measurement).var(axis=0)
        speaks, root = self._fixes.speaks, self._fixes.sqrt_information
        diagonal = np.where(speaks, np.diagonal(root, axis1=1, axis2=2), 1.0)
        claims = speaks * np.log(np.maximum(width, _TINY)) / 2 + np.log(diagonal)
        self._claim: Array = claims.sum(axis=1)

    def log_ratio(self, windows: Indices, variance: float, lead: Indices) -> Array:
        """
        Return how much likelier each fix is if true than if anywhere, (w, k) logarithms.

        Infinite of those that say where the map is, `lead`; variance : of the odometry.
        """
        manifold, fixes = self._manifold, self._fixes
        w, k = windows.shape
        q = _SAMPLES + 1
        d = manifold.TANGENT_SIZE
        p = manifold.POSE_SIZE
        ways = self._retracted(self._way, np.sqrt(variance) * self._drift).reshape(q, -1, p)
        local = [np.tile(manifold.identity(1), (q * w, 1))]
        for at in range(k - 1):
            local.append(manifold.compose(local[-1], ways[:, windows[:, at]].reshape(-1, p)))
        first = [self._retracted(fixes.measurement[windows[:, at]], self._noise[:, windows[:, at]])
                 for at in lead]
        here, there = (manifold.positions(np.stack(poses, axis=1))
                       for poses in ([local[at] for at in lead], first))
        whole = np.tile(fixes.speaks[windows[:, lead[0]]].all(axis=1), q)[:, None]
        T = np.where(whole, manifold.compose(first[0], manifold.inverse(local[lead[0]])),
                     manifold.from_rotation(*align(here, there)))
        ratio = np.full((w, k), np.inf)
        for at in np.setdiff1d(np.arange(k), lead).tolist():
            row = windows[:, at]
            seen = manifold.compose(T, local[at])
            e = manifold.local(np.tile(fixes.measurement[row], (q, 1)), seen).reshape(q, w, d)
            r = np.einsum('wij,qwj->wqi', fixes.sqrt_information[row], e)
            r[:, 1:] -= r[:, :1]
            C = np.eye(d) + r[:, 1:].transpose(0, 2, 1) @ r[:, 1:] / _SAMPLES
            square = (r[:, 0] * np.linalg.solve(C, r[:, 0, :, None])[..., 0]).sum(axis=1)
            ratio[:, at] = self._claim[row] - (np.linalg.slogdet(C)[1] + square) / 2
        return ratio

    def _retracted(self, poses: Array, steps: Array) -> Array:
        """Return poses (m, p) retracted by steps (q, m, d), (q m, p)."""
        q, m, d = steps.shape
        return self._manifold.retract(np.tile(poses, (q, 1)), steps.reshape(q * m, d))


def _drift(graph: FactorGraph, poses: Array, keyframe: Indices) -> Array:
    """Return the covariance of the odometry between keyframes (k,), ascending, (k - 1, d, d)."""
    manifold, factors = graph.manifold, graph.between
    low, high, _ = ends_in_time(graph)
    gap = np.searchsorted(keyframe, low, side='right') - 1
    rows = np.flatnonzero(factors.is_odometry & (gap >= 0) & (gap < len(keyframe) - 1))
    gap = gap[rows]
    # The errors on the way, seen from the end.
    Ad = manifold.adjoint(manifold.between(poses[keyframe[gap + 1]], poses[high[rows]]))
    covariance = np.zeros((len(keyframe) - 1, *Ad.shape[1:]))
    np.add.at(covariance, gap, Ad @ covariance_of(factors.sqrt_information[rows])
              @ Ad.transpose(0, 2, 1))
    return covariance


def _samples(covariance: Array, rng: 'np.random.Generator') -> Array:
    """Return noise of covariances (m, d, d), (samples + 1, m, d), none first."""
    m, d, _ = covariance.shape
    root = np.linalg.cholesky(covariance + _TINY * np.eye(d))
    noise = np.einsum('mij,qmj->qmi', root, rng.standard_normal((_SAMPLES + 1, m, d)))
    noise[0] = 0.0
    return np.asarray(noise)
