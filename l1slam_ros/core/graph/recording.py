# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A graph as the samples and loops of the robot that would have measured it.

In: a graph whose factors lead from earlier keyframes to later ones, see `factor_graph.turned`, and
whose odometry says all of every step. Out: each keyframe's odometry, and the loops that end there.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import covariance_of
from l1slam_ros.core.graph.factor_graph import WORLD, FactorGraph
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample


def steps_of(graph: FactorGraph) -> Indices:
    """Return which factor leads to each keyframe that has odometry, in their order, (s,)."""
    step_to = graph.between.step_to
    return step_to[step_to >= 0]


def loops_of(graph: FactorGraph) -> Indices:
    """
    Return the other factors in the order of the keyframes where they end, (l,).

    Of one end what is struck out is first: a strike means all loops of the same keyframes, and who
    vouches for one of them has the last word.
    """
    factors = graph.between
    rows = np.flatnonzero(~graph.between.is_odometry)
    return rows[np.lexsort((~factors.struck[rows], factors.j[rows]))]


def recorded(graph: FactorGraph,
             stamps: list[int]) -> Iterator[tuple[OdometrySample, list[LoopClosure]]]:
    """
    Yield each keyframe's odometry and the loops that end there; stamps : (n,) of keyframes [ns].

    A loop that is struck out is told, and then that it is false. Covariances are those of the
    factors; what is left unsaid has an infinite variance.
    """
    factors = graph.between
    to_pose3 = graph.manifold.to_pose3
    steps = factors.step_to
    loops = loops_of(graph)
    poses = to_pose3(_chain(graph))
    measured = to_pose3(factors.measurement)
    covariances = _covariances(graph)
    ends = np.searchsorted(factors.j[loops], np.arange(graph.n_poses + 1))
    still = np.zeros((6, 6))
    for k, stamp in enumerate(stamps):
        covariance = covariances[steps[k]] if steps[k] >= 0 else still
        sample = OdometrySample(stamp, poses[k], covariance, still)
        rows = loops[ends[k]:ends[k + 1]]
        said = [LoopClosure(None if factors.i[row] == WORLD else stamps[factors.i[row]], stamp,
                            measured[row], covariances[row], bool(factors.trusted[row]))
                for row in rows]
        count = np.count_nonzero(factors.struck[rows])
        yield sample, [*said[:count], *(replace(loop, struck=True) for loop in said[:count]),
                       *said[count:]]


def _chain(graph: FactorGraph) -> Array:
    """
    Return the poses (n, p) that the odometry alone gives, from the identity.

    One after the other: so each is exact to rounding *relative to the one before*.
    """
    poses = graph.manifold.identity(graph.n_poses)
    parent = graph.parent
    steps = graph.between.step_to
    for k in np.flatnonzero(steps >= 0).tolist():
        step = graph.between.measurement[steps[k]]
        poses[k] = graph.manifold.compose(poses[parent[k]], step)
    return poses


def _covariances(graph: FactorGraph) -> Array:
    """Return the covariance of each factor as messages have it, (m, 6, 6)."""
    manifold, factors = graph.manifold, graph.between
    rows = manifold.COVARIANCE_ROWS
    diagonal = np.arange(manifold.TANGENT_SIZE)
    of_manifold = covariance_of(factors.sqrt_information)
    of_manifold[:, diagonal, diagonal] += np.where(factors.speaks, 0.0, np.inf)
    covariances = np.zeros((len(factors), 6, 6))
    covariances[np.ix_(range(len(factors)), rows, rows)] = of_manifold
    return covariances
