# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How often maps that looked like this one were right: a forecast with a record.

In: what is known at the end of a judgement. Out: a share of 1. It is a logistic regression of few
terms on what became of graphs with lies: `benchmarks/robust/verdict.py` makes the graphs, fits the
weights on some of them and counts on the others what was right.
"""

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.robust.innovation import spread_of
from l1slam_ros.core.robust.odometry.drift import drift_information, drift_left
from l1slam_ros.core.robust.rounds.growth import Growth
from l1slam_ros.core.solvers.block_cholesky import cholesky_of

# Of a map of which all is well; then for one without an accepted loop, each power of e by which it
# is less sure of itself than a right one is exact, odometry that drifts, refused loops that
# nothing speaks against, and a slip that is neither believed nor ruled out.
_WEIGHTS = np.array([-4.32, 5.17, 1.41, 2.55, 3.86, 3.45])
# Below, by how unsure it is alone, a map is doubtful; of 89 runs half makes 3 better, which were
# right and doubted.
CONFIDENT = 0.9
# A right map is off by so much at most: [m], or this part of its diagonal, as `verdict.py` counts
# it; double takes a doubt from 1 and 2 right maps of 89.
_OFF, _OFF_PART = 0.25, 0.005
# A map that is surer of itself than by this factor is no more likely to be right; half and double
# change no doubt.
_SUREST = 0.3


def forecast(terms: Array) -> float:
    """Return how often maps of such terms, see `terms_of`, or of the first of them, were right."""
    return float(1 / (1 + np.exp(_WEIGHTS[:len(terms)] @ terms)))


def terms_of(accepts_any: bool, unsure: float, *reasons: bool) -> Array:
    """
    Return what the weights are of, (6,).

    accepts_any : whether any loop is accepted; unsure : see `unsureness`; reasons : whether
    odometry drifts, refused loops agree on another map, a slip is suspected
    """
    return np.array([1.0, not accepts_any, np.log(max(unsure, _SUREST)),
                     *reasons])


def right_within(positions: Array) -> float:
    """Return by how much a right map, of positions (n, k), is off at most [m]."""
    return max(_OFF, _OFF_PART * float(np.linalg.norm(np.ptp(positions, axis=0))))


def expected_error(terms: Array, positions: Array) -> float:
    """Return the error [m] that a map of such terms and positions (n, k) expects of itself."""
    return float(np.exp(terms[2])) * right_within(positions)


def unsureness(growth: Growth) -> float:
    """
    Return how large the error is that a map expects of itself, of its largest part.

    That of its positions, aligned, over what a right map is off by at most. By the noise that was
    found: what a file states may be ten times as much.
    """
    manifold = growth.given.graph.manifold
    fixed = growth.posterior.fixed
    own = growth.part[fixed:] == np.bincount(growth.part).argmax()
    poses = growth.poses[fixed:][own]
    samples = _spread(growth)[own]
    if len(poses) < 2:
        return 0.0
    positions = manifold.positions(poses)
    square = [absolute_trajectory_error(
        manifold.positions(manifold.retract(poses, samples[:, :, number])), positions) ** 2
        for number in range(samples.shape[2])]
    return float(np.sqrt(np.mean(square))) / right_within(positions)


def _spread(growth: Growth) -> Array:
    """Return samples of the error that noise as it was found makes, (free keyframes, k, q)."""
    given = growth.given
    variance, used = growth.noise.variance, growth.noise.assumed
    if np.allclose(variance, used):
        return growth.posterior.samples[:-1]
    rows = np.flatnonzero(growth.accepted)
    graph = growth.subgraph(rows)
    noise = (variance / used)[given.is_loop[rows].astype(np.int64)]
    noise[given.factors.is_absolute[rows]] = 1.0
    return spread_of(graph, growth.poses, cholesky_of(graph), noise)


def left_drift(growth: Growth) -> tuple[float, float]:
    """
    Return by how much each metre of the odometry turns too little [rad/m], and in sigmas.

    It is what the residuals say that are left in a map: noise was learnt to be as large as drift
    made it, but of noise the turns do not add up. 0 in space, where none is looked for.
    """
    if growth.given.graph.manifold is not se2:
        return 0.0, 0.0
    found, variance = drift_left(growth), drift_information(growth)
    return (found / variance, found / np.sqrt(variance)) if variance > 0 else (0.0, 0.0)


def drift_taken_for_noise(growth: Growth) -> float:
    """
    Return `left_drift` [rad/m] where noise hardly made it and it bends an unsure map; else 0.

    Unsure is a map that is less sure of itself than a right one is exact.
    """
    drift, sigmas = left_drift(growth)
    is_noise = sigmas**2 < growth.given.gate(np.array([1]))[0]
    return 0.0 if is_noise or unsureness(growth) < 1 else drift
