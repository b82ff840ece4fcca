# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A heading that drifts: how far each metre of the odometry turns, by a vote of the loops.

In: a graph in the plane, of whose loops nothing is believed yet. Out: the drift d [rad/m] that
they agree on, and how sure that is. A true loop from keyframe i to j, with s metres of way
between them, says by how much the odometry has turned too little:

    phi = wrap(z_theta - (theta_j - theta_i)) = d s + noise,

the noise normal, of the loop and of q times what the odometry states of its turns; a lie says any
angle. The share of true loops is found with it (expectation and maximisation). Loops of one place
have one vote. Wheels of unequal size, or a gyroscope with an offset, do that.

Source: ours, by the recorded logs that `test_drift.py` names where they are.
"""

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import covariance_of
from l1slam_ros.core.graph.factor_graph import BetweenFactors, FactorGraph, ends_in_time
from l1slam_ros.core.graph.parts import bridged
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.places import places

# [rad/m] What wheels and gyros drift by: its standard deviation, and the most that is looked for.
_USUAL, _MOST = 0.03, 0.18
# From coarse to fine: steps of the drift, each a part of the one before.
_STEP = 0.004
_FINER = 5.0
_LEVELS = 3
# What the odometry states of its turns may be off by, in variance.
_NOISE = np.logspace(-3, 3, 13)
# Rounds of expectation and maximisation of the share of true loops; so many loops vote at most.
_ROUNDS, _VOTERS = 12, 2000


def straightened(graph: FactorGraph, drift: float) -> FactorGraph:
    """Return a graph in the plane, each step of whose odometry turns by `drift` more a metre."""
    if not drift:
        return graph
    other = graph.subset(np.arange(len(graph.between)))
    factors = other.between
    rows = np.flatnonzero(other.between.is_odometry)
    factors.measurement[rows] = corrected(factors, rows, drift)
    return other


def corrected(factors: BetweenFactors, rows: Indices, drift: float) -> Array:
    """Return what some odometry factors in the plane measured, without its drift, (k, 3)."""
    measured = factors.measurement[rows]
    along = np.where(factors.i[rows] < factors.j[rows], 1.0, -1.0)
    step = np.zeros((len(rows), 3))
    step[:, 2] = drift * along * np.hypot(measured[:, 0], measured[:, 1])
    return se2.retract(measured, step)


def vote(graph: FactorGraph) -> tuple[float, float]:
    """
    Return the drift of the heading [rad/m] that loops agree on, and the ln of its odds.

    Positive where it is likelier than none, and surely than any other: to loops of equally long
    ways a full turn more on each is the same.
    """
    rows = np.flatnonzero(~graph.between.is_odometry & ~graph.between.is_absolute)
    if graph.manifold is not se2 or not len(rows):
        return 0.0, -np.inf
    rows = rows[:: max(1, len(rows) // _VOTERS)]
    whole = bridged(graph)
    chain = odometry_poses(whole)
    place = places(whole, chain)[0][rows]
    low, high, Z = (ends[rows] for ends in ends_in_time(graph))
    way, turned = _along(whole)
    metres = way[high] - way[low]
    own = covariance_of(graph.between.sqrt_information[rows])
    phi = se2.wrap(Z[:, 2] - (chain[high, 2] - chain[low, 2]))
    weight = 1.0 / np.unique(place, return_inverse=True, return_counts=True)[2][
        np.unique(place, return_inverse=True)[1]]
    walk = turned[-1] / max(way[-1], 1e-9) ** 2
    best = {}
    for name, usual in (('drift', _USUAL**2), ('none', 0.0)):
        best[name] = max(
            _highest(phi, metres, own[:, 2, 2] + q * (turned[high] - turned[low]), weight,
                     usual + q * walk) for q in _NOISE)
    value, drift, lead = best['drift']
    if abs(drift) * way[-1] < np.sqrt(np.median(own[:, 2, 2])):
        return 0.0, -np.inf  # all of the way, it turns by less than a loop can tell
    return drift, min(value - best['none'][0], lead - np.log(1 / DOUBT - 1))


def _along(graph: FactorGraph) -> tuple[Array, Array]:
    """Return the way to each keyframe [m], and the variance of its turns [rad^2], (n,) each."""
    factors = graph.between
    rows = np.flatnonzero(factors.is_odometry)
    at = np.minimum(factors.i, factors.j)[rows]
    length, variance = np.zeros(graph.n_poses), np.zeros(graph.n_poses)
    length[at + 1] = np.hypot(factors.measurement[rows, 0], factors.measurement[rows, 1])
    variance[at + 1] = covariance_of(factors.sqrt_information[rows])[:, 2, 2]
    return np.cumsum(length), np.cumsum(variance)


def _highest(phi: Array, metres: Array, variance: Array, weight: Array, prior: float
             ) -> tuple[float, float, float]:
    """
    Return the highest ln of likelihood and prior over drifts N(0, prior), and where it is.

    And by how much it is above the next peak.
    """
    centre = 0.0
    step = _STEP
    most = min(_MOST, 4 * np.sqrt(prior) + _STEP)
    lead = np.inf
    for _ in range(_LEVELS):
        drift = centre + np.arange(-most, most + step / 2, step)
        value = _log_likelihood(phi, metres, variance + (metres * step) ** 2 / 12, weight, drift
                                ) - drift**2 / (2 * prior) - np.log(2 * np.pi * prior) / 2
        is_peak = (value[1:-1] > value[:-2]) & (value[1:-1] >= value[2:])
        peaks = np.sort(value[1:-1][is_peak])
        lead = float(peaks[-1] - peaks[-2]) if len(peaks) > 1 and most > 2 * step else lead
        centre = float(drift[np.argmax(value)])
        most = 2 * step
        step = step / _FINER
    return float(value.max()), centre, lead


def _log_likelihood(phi: Array, metres: Array, variance: Array, weight: Array, drift: Array
                    ) -> Array:
    """Return the ln of the likelihood of each drift, the share of true loops at its best."""
    error = se2.wrap(phi - drift[:, None] * metres)
    # All around the circle, what is wider than it is even.
    normal = np.exp(-error**2 / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    normal = np.maximum(normal, np.where(variance > np.pi**2 / 3, 1 / (2 * np.pi), 0.0))
    even = 1 / (2 * np.pi)
    share = np.full((len(drift), 1), 0.5)
    part = weight / weight.sum()
    true = np.empty_like(normal)
    for _ in range(_ROUNDS):
        # normal / (normal + even (1 - share) / share)
        np.add(normal, even * (1 / share - 1), out=true)
        np.divide(normal, true, out=true)
        share = (true @ part)[:, None].clip(1e-3, 1 - 1e-3)
    value: Array = np.log(share * normal + (1 - share) * even) @ weight
    return value
