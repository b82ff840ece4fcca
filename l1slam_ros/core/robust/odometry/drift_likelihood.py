# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The drifts of the heading that loops may agree on.

In: a graph in the plane, of whose loops nothing is believed yet. Out: the drifts d [rad/m]. A true
loop from keyframe i to j, with s metres of way between them, says by how much the odometry has
turned too little:

    phi = wrap(z_theta - (theta_j - theta_i)) = d s + noise,

the noise normal, of the loop and of q times what the odometry states of its turns; a lie says any
angle. The share of true loops is found with it (expectation and maximisation). Loops of one place
count once for each stretch of it.

Angles are the same after a full turn, and a robot that goes round in laps turns as much all the
time: lies that say two poses look the same way agree on a drift by which it never turned. So
angles only propose drifts. Which ones may be, positions decide, with the covariance that the noise
of all steps between makes of angle and position. Laps may close with a turn more on each even so,
and loops of two laps share most of their errors, which is not counted here: `drift` decides.

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

# [rad/m] What wheels and gyros drift by: its standard deviation, and the most that is looked for.
USUAL, _MOST = 0.03, 0.18
# [rad/m] Drifts are looked for so far apart; near so many of the likeliest, twice as near
# each time, until the longest loop tells them apart by no more than so much [rad].
_STEP = 0.0008
_PEAKS = 40
_FINE = 0.02
# Nearly as likely as the likeliest is none with this part of its odds to all loops being lies, and
# worth a look another drift: loops of a lap share much of their errors, so that odds are less than
# they seem. So many are looked at most.
_NONE = 0.75
_ANOTHER = 0.5
_TRIED = 8
# What the odometry states of its turns may be off by, in variance.
_NOISE = np.logspace(-3, 3, 13)
# Rounds of expectation and maximisation of the share of true loops.
_ROUNDS = 12


def likely_drifts(graph: FactorGraph) -> Array:
    """
    Return the drifts of the heading [rad/m] that loops agree on, (p,), the likeliest first.

    Laps that close also close if each has a full turn more: several may be worth a look. There
    are none where loops are nearly as likely without a drift.
    """
    rows = np.flatnonzero(~graph.between.is_odometry & ~graph.between.is_absolute)
    if graph.manifold is not se2 or not len(rows):
        return np.zeros(0)
    rows = rows[:: max(1, len(rows) // ASKED)]
    likelihood = _DriftLikelihood(bridged(graph), rows)
    drifts = likelihood.peaks()
    if not len(drifts):  # of noise so large that none is likelier than the next
        return drifts
    values = np.array([likelihood.value(drift, USUAL**2) for drift in drifts])
    most = values.max()
    if likelihood.value(0.0, 0.0) >= _NONE * most:
        return np.zeros(0)
    order = np.argsort(-values, kind='stable')
    near: Array = drifts[order[values[order] >= _ANOTHER * most]][:_TRIED]
    return near


def _weights(place: Indices, ends: Array) -> Array:
    """
    Return the weight of each loop, (k,): a place counts once for each stretch that is near.

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
    How likely drifts of the odometry are, by k loops of a graph without gaps.

    chain : (n, 3) poses along the odometry; way : (n,) metres to each; noise : (n, 2) variance of
    the position and of the heading of the step to each, as stated; low, high : (k,) the ends of
    each loop; measured : (k, 3) by it; own : (k, 3, 3) its covariance; weight : (k,) of each;
    metres, turns, lack : (k,) the way between its ends, the variance of turns on it, and what
    these lack; walk : the variance of a drift that is but noise.
    """

    def __init__(self, graph: FactorGraph, rows: Indices):
        chain = self.chain = odometry_poses(graph)
        low, high, measured = ends_in_time(graph)
        low, high, measured = low[rows], high[rows], measured[rows]
        factors = graph.between
        steps = np.flatnonzero(factors.is_odometry & ~graph.is_landmark[factors.j])
        covariance = covariance_of(factors.sqrt_information)
        way, noise = np.zeros(graph.n_poses), np.zeros((graph.n_poses, 2))
        at = np.maximum(factors.i, factors.j)[steps]
        way[at] = np.hypot(*factors.measurement[steps, :2].T)
        noise[at] = np.stack((np.trace(covariance[steps, :2, :2], axis1=1, axis2=2) / 2,
                              covariance[steps, 2, 2]), axis=1)
        way, turns = np.cumsum(way), np.cumsum(noise[:, 1])
        place, ends = places(graph, chain)
        self.weight = _weights(place[rows], ends[rows])
        self.way, self.noise = way, noise
        self.walk = turns[-1] / max(way[-1], TINY) ** 2
        self.low, self.high = low, high
        self.measured, self.own = measured, covariance[rows]
        self.metres, self.turns = way[high] - way[low], turns[high] - turns[low]
        self.lack = measured[:, 2] - (chain[high, 2] - chain[low, 2])

    def peaks(self) -> Array:
        """Return the drifts, (p,), near which most of the headings agree, likeliest first."""
        drift = np.arange(-_MOST, _MOST + _STEP / 2, _STEP)
        values = self._by_headings(drift, _STEP, _NOISE)
        value, noise = np.max(values, axis=0), _NOISE[np.argmax(values, axis=0)]
        is_peak = (value[1:-1] > value[:-2]) & (value[1:-1] >= value[2:])
        at = 1 + np.flatnonzero(is_peak)
        at = at[np.argsort(-value[at], kind='stable')[:_PEAKS]]
        return np.array([self._refined(drift[peak], noise[peak]) for peak in at])

    def _refined(self, drift: float, q: float) -> float:
        """Return where the peak near a drift is, as finely as the longest loop tells."""
        step = _STEP
        while step * self.metres.max() > _FINE:
            step /= 2
            near = drift + step * np.linspace(-2, 2, 5)
            drift = float(near[np.argmax(self._by_headings(near, step, np.array([q]))[0])])
        return drift

    def _by_headings(self, drift: Array, step: float, noise: Array) -> Array:
        """
        Return the ln of the likelihood of drifts, known to a step, by headings alone, (q, d).

        drift : (d,); noise : (q,) what the odometry states of its turns is off by, in variance
        """
        # Single precision tells peaks apart, and takes half the time.
        square = (se2.wrap(self.lack - drift[:, None] * self.metres) ** 2 / 2).astype(np.float32)
        values = []
        for q in noise.tolist():
            variance = self.own[:, 2, 2] + q * self.turns + (self.metres * step) ** 2 / 12
            even = np.where(variance > np.pi**2 / 3, 1.0, 0.0)
            ratio = np.exp(square * (-1 / variance).astype(np.float32))
            # A lie's turn has the density 1 / (2 pi).
            ratio *= np.sqrt(2 * np.pi / variance).astype(np.float32)
            # All around the circle, what is wider than it is even.
            np.maximum(ratio, even.astype(np.float32), out=ratio)
            values.append(_log_likelihood(ratio, self.weight) + log_prior(
                drift, USUAL**2 + q * self.walk))
        return np.array(values)

    def value(self, drift: float, usual: float) -> float:
        """
        Return the ln of the likelihood of a drift, by what loops measure, and of its prior.

        usual : its variance, but for what noise makes
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
        # Lies claim anything, as far as the way leads.
        log_room = np.log(2 * np.pi**2 * np.var(at))
        log_ratio = np.empty((len(_NOISE), len(low)))
        for row, q in zip(log_ratio, _NOISE, strict=True):
            square, log_det = native.prediction.normalise(q * spread + own, error)
            row[:] = log_room - (square + log_det + 3 * np.log(2 * np.pi)) / 2
        values = _log_likelihood(np.exp(log_ratio), self.weight) + log_prior(
            drift, usual + _NOISE * self.walk)
        return float(values.max())

    def _spread(self, at: Array) -> Array:
        """Return the covariances (k, 3, 3) that the steps make, positions being (n, 2)."""
        position, turn = self.noise.T
        # Each turn moves the end of a loop by its distance to it, sideways.
        side = np.column_stack((-at[:, 1], at[:, 0]))
        first = turn[:, None] * side
        sums = np.cumsum(np.column_stack((position, turn, first, first[:, :1] * side,
                                          first[:, 1] * side[:, 1])), axis=0)
        sums = sums[self.high] - sums[self.low]
        end = side[self.high]
        # The sums of the turns' variances, and of these times what each is to the side.
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
    """Return the ln of the density of drifts, normal about none."""
    return -(drift**2 / variance + np.log(2 * np.pi * variance)) / 2


def _log_likelihood(ratio: Array, weight: Array) -> Array:
    """
    Return the ln of the likelihood of each drift, (d,), the share of true loops at its best.

    ratio : (d, k) how much likelier each loop is true than false
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
