# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The likelihood of drifts of the heading, from all loops at once.

In: a graph without accepted loops; in space, its projection onto the plane in which the robot
stands. Out: the likely drifts d [rad/m]. An inlier from keyframe i to j, s metres of way apart,
measures by how much the odometry has turned too little:

    phi = wrap(z_theta - (theta_j - theta_i)) = d s + noise,

the noise normal, from the loop and from q times the stated variance of the odometry's turns; the
angle of an outlier is uniform. The share of inliers is estimated with d (expectation and
maximisation). Loops of one place count once for each stretch of it.

Angles repeat after a full turn, and a robot that goes round in laps turns at an even rate: false
loops between poses of equal heading agree on a drift of a turn a lap. So angles only propose
drifts; positions decide, with the covariance of angle and position that the noise of all steps
between causes. Laps may close with one more turn each even so, and loops of two laps share most of
their errors, which is not modelled here: `drift` decides.

Source: ours, defended by `test_drift.py`.
"""

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import covariance_of
from l1slam_ros.core.graph.factor_graph import FactorGraph, ends_in_time
from l1slam_ros.core.graph.parts import bridged
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.robust.gating import TINY
from l1slam_ros.core.robust.pairwise_consistency import ASKED
from l1slam_ros.core.robust.places import places

# The heading in the tangents of both manifolds: about the vertical.
HEADING = -1
# [rad/m] The standard deviation of the drift of wheels and gyroscopes, and the largest one tried.
USUAL, _MOST = 0.03, 0.18
# [rad/m] The grid of drifts; the number of peaks that are refined, by halves, until the longest
# loop turns by no more than `_FINE` [rad] from one to the next.
_STEP = 0.0008
_PEAKS = 40
_FINE = 0.02
# Fractions of the largest log likelihood (0: all loops are outliers) from which on no drift is
# likely enough, and another drift is tried; loops of a lap share errors, which overstates it. The
# number of drifts tried at most.
_NONE = 0.75
_ANOTHER = 0.5
_TRIED = 8
# Factors q on the stated variance of turns.
_NOISE = np.logspace(-3, 3, 13)
# Rounds of expectation and maximisation of the share of true loops.
_ROUNDS = 12


def likely_drifts(graph: FactorGraph) -> Array:
    """
    Return the drifts of the heading [rad/m] that loops agree on, (p,), the likeliest first.

    None where loops are nearly as likely without a drift. Several where laps also close with a
    full turn more on each.
    """
    rows = np.flatnonzero(~graph.between.is_odometry & ~graph.between.is_absolute)
    if not len(rows):
        return np.zeros(0)
    rows = rows[:: max(1, len(rows) // ASKED)]
    likelihood = _DriftLikelihood(bridged(graph), rows)
    drifts = likelihood.peaks()
    if not len(drifts):  # too noisy for a peak
        return drifts
    values = np.array([likelihood.value(drift, USUAL**2) for drift in drifts])
    most = values.max()
    if likelihood.value(0.0, 0.0) >= _NONE * most:
        return np.zeros(0)
    order = np.argsort(-values, kind='stable')
    near: Array = drifts[order[values[order] >= _ANOTHER * most]][:_TRIED]
    return near


def _in_plane(graph: FactorGraph, poses: Array) -> Array:
    """Return poses, (k, p), projected onto the plane in which the robot stands, (k, 3)."""
    return se2.from_pose3(graph.manifold.to_pose3(poses))


def _weights(place: Indices, ends: Array) -> Array:
    """
    Return the weight of each loop, (k,): a place counts once for each of its stretches.

    place, ends : see `places`
    """
    order = np.argsort(place, kind='stable')
    _, first, number, count = np.unique(place[order], return_index=True, return_inverse=True,
                                        return_counts=True)
    long = np.maximum.reduceat(ends[order], first) - np.minimum.reduceat(ends[order], first)
    weight = np.empty(len(place))
    weight[order] = np.minimum(1 / count + long.max(axis=1) / (2 * count), 1.0)[number]
    return weight


class _DriftLikelihood:
    """
    The likelihood of drifts of the odometry, by k loops of a graph without gaps.

    chain : (n, 3) poses along the odometry; way : (n,) metres to each; noise : (n, 2) the stated
    variance of position and heading of the step to each; low, high : (k,) the ends of each loop;
    measured : (k, 3) its measurement; own : (k, 3, 3) its covariance; weight : (k,) of each;
    metres, turns, lack : (k,) the way between its ends, the variance of turns along it, and phi;
    walk : the variance of the drift that white noise alone makes.
    """

    def __init__(self, graph: FactorGraph, rows: Indices):
        whole = odometry_poses(graph)
        chain = self.chain = _in_plane(graph, whole)
        low, high, measured = ends_in_time(graph)
        low, high, measured = low[rows], high[rows], _in_plane(graph, measured[rows])
        factors = graph.between
        steps = np.flatnonzero(factors.is_odometry & ~graph.is_landmark[factors.j])
        part = np.array([0, 1, HEADING])
        covariance = covariance_of(factors.sqrt_information)[:, part[:, None], part]
        way, noise = np.zeros(graph.n_poses), np.zeros((graph.n_poses, 2))
        at = np.maximum(factors.i, factors.j)[steps]
        way[at] = np.hypot(*factors.measurement[steps, :2].T)
        noise[at] = np.stack((np.trace(covariance[steps, :2, :2], axis1=1, axis2=2) / 2,
                              covariance[steps, 2, 2]), axis=1)
        way, turns = np.cumsum(way), np.cumsum(noise[:, 1])
        place, ends = places(graph, whole)
        self.weight = _weights(place[rows], ends[rows])
        self.way, self.noise = way, noise
        self.walk = turns[-1] / max(way[-1], TINY) ** 2
        self.low, self.high = low, high
        self.measured, self.own = measured, covariance[rows]
        self.metres, self.turns = way[high] - way[low], turns[high] - turns[low]
        self.lack = measured[:, 2] - (chain[high, 2] - chain[low, 2])

    def peaks(self) -> Array:
        """Return the peaks of the likelihood by headings, (p,), the likeliest first."""
        drift = np.arange(-_MOST, _MOST + _STEP / 2, _STEP)
        values = self._by_headings(drift, _STEP, _NOISE)
        value, noise = np.max(values, axis=0), _NOISE[np.argmax(values, axis=0)]
        is_peak = (value[1:-1] > value[:-2]) & (value[1:-1] >= value[2:])
        at = 1 + np.flatnonzero(is_peak)
        at = at[np.argsort(-value[at], kind='stable')[:_PEAKS]]
        return np.array([self._refined(drift[peak], noise[peak]) for peak in at])

    def _refined(self, drift: float, q: float) -> float:
        """Return the peak near a drift, as finely as the longest loop resolves."""
        step = _STEP
        while step * self.metres.max() > _FINE:
            step /= 2
            near = drift + step * np.linspace(-2, 2, 5)
            drift = float(near[np.argmax(self._by_headings(near, step, np.array([q]))[0])])
        return drift

    def _by_headings(self, drift: Array, step: float, noise: Array) -> Array:
        """
        Return the log likelihood of drifts on a grid, by headings alone, (q, d).

        drift : (d,); step : of the grid; noise : (q,) factors on the stated variance of turns
        """
        # Single precision resolves the peaks in half the time.
        square = (se2.wrap(self.lack - drift[:, None] * self.metres) ** 2 / 2).astype(np.float32)
        values = []
        for q in noise.tolist():
            variance = self.own[:, 2, 2] + q * self.turns + (self.metres * step) ** 2 / 12
            even = np.where(variance > np.pi**2 / 3, 1.0, 0.0)
            ratio = np.exp(square * (-1 / variance).astype(np.float32))
            # The density of an outlier's turn is 1 / (2 pi).
            ratio *= np.sqrt(2 * np.pi / variance).astype(np.float32)
            # A normal density wider than the circle is uniform on it.
            np.maximum(ratio, even.astype(np.float32), out=ratio)
            values.append(_log_likelihood(ratio, self.weight) + log_prior(
                drift, USUAL**2 + q * self.walk))
        return np.array(values)

    def value(self, drift: float, usual: float) -> float:
        """
        Return the log likelihood of a drift by whole loops, plus ln of its prior.

        usual : the variance of the prior, to which that of white noise is added
        """
        low, high = self.low, self.high
        heading = self.chain[:, 2] + drift * self.way
        # As complex numbers: each step is turned by the drift up to it.
        step = np.diff(self.chain[:, 0] + 1j * self.chain[:, 1]) * np.exp(
            1j * drift * self.way[:-1])
        at = np.append(0, np.cumsum(step))
        off = at[low] + np.exp(1j * heading[low]) * (
            self.measured[:, 0] + 1j * self.measured[:, 1]) - at[high]
        turn = se2.wrap(self.measured[:, 2] - (heading[high] - heading[low]))
        error = np.stack((off.real, off.imag, turn), axis=1)
        spread = self._spread(np.stack((at.real, at.imag), axis=1))
        cosine, sine = np.cos(heading[high]), np.sin(heading[high])
        turned = np.zeros((len(low), 3, 3))
        turned[:, 0, 0] = turned[:, 1, 1] = cosine
        turned[:, 1, 0] = sine
        turned[:, 0, 1] = -sine
        turned[:, 2, 2] = 1.0
        own = turned @ self.own @ turned.transpose(0, 2, 1)
        # Outliers are uniform over the extent of the way.
        log_room = np.log(2 * np.pi**2 * np.var(at))
        log_ratio = np.empty((len(_NOISE), len(low)))
        for row, q in zip(log_ratio, _NOISE, strict=True):
            square, log_det = native.prediction.normalise(q * spread + own, error)
            row[:] = log_room - (square + log_det + 3 * np.log(2 * np.pi)) / 2
        values = _log_likelihood(np.exp(log_ratio), self.weight) + log_prior(
            drift, usual + _NOISE * self.walk)
        return float(values.max())

    def _spread(self, at: Array) -> Array:
        """Return the covariances of loops by the noise of steps, (k, 3, 3); positions (n, 2)."""
        position, turn = self.noise.T
        # A turn moves the end of a loop sideways, in proportion to its distance.
        side = np.column_stack((-at[:, 1], at[:, 0]))
        first = turn[:, None] * side
        sums = np.cumsum(np.column_stack((position, turn, first, first[:, :1] * side,
                                          first[:, 1] * side[:, 1])), axis=0)
        sums = sums[self.high] - sums[self.low]
        end = side[self.high]
        # The sums of the variances of turns, and of their products with the lever arms.
        zero, one = sums[:, 1], sums[:, 2:4]
        spread = np.empty((len(end), 3, 3))
        spread[:, :2, 2] = spread[:, 2, :2] = zero[:, None] * end - one
        spread[:, 2, 2] = zero
        both = np.einsum('ka,kb->kab', end, one)
        spread[:, :2, :2] = (
            zero[:, None, None] * np.einsum('ka,kb->kab', end, end) - both
            - both.transpose(0, 2, 1) + sums[:, [[4, 5], [5, 6]]]
            + sums[:, 0, None, None] * np.eye(2))
        return spread


def log_prior(drift: Array | float, variance: Array | float) -> Array | float:
    """Return ln of the prior density of drifts, normal about 0."""
    return -(drift**2 / variance + np.log(2 * np.pi * variance)) / 2


def _log_likelihood(ratio: Array, weight: Array) -> Array:
    """
    Return the log likelihood of each drift, (d,), with the best share of inliers.

    ratio : (d, k) likelihood of each loop as an inlier over that as an outlier
    """
    share = np.full((len(ratio), 1), 0.5, ratio.dtype)
    part = (weight / weight.sum()).astype(ratio.dtype)
    true = np.empty_like(ratio)
    for _ in range(_ROUNDS):
        # ratio / (ratio + (1 - share) / share)
        np.add(ratio, 1 / share - 1, out=true)
        np.divide(ratio, true, out=true)
        share = (true @ part)[:, None].clip(1e-3, 1 - 1e-3)
    value: Array = np.log(share * ratio + (1 - share)) @ weight
    return value
