# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Judge a graph with each loop once, and with estimated noise where none was meant.

In: a function that judges a graph. Out: the same for graphs that list loops twice, or from either
end, or state placeholder noise, such as identity information.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import wraps

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.innovation import BY_CHANCE, student_quantile
from l1slam_ros.core.robust.inspection import FEWEST
from l1slam_ros.core.robust.judgement import Judgement, weighed
from l1slam_ros.core.robust.odometry.drift import straightened
from l1slam_ros.core.robust.places import first_told
from l1slam_ros.core.robust.rounds.growth import Growth

# Ratio of estimated to stated variance of odometry, below which the latter is a placeholder,
# replaced by the estimate over this ratio. By the estimate itself, loops with larger than normal
# errors would be lost.
_OVERSTATED = 0.1
# [rad^2/m^2] Initial ratio of variances of rotation and translation where a file states one
# number: a tenth to a hundredth is usual.
_TURN = 1 / 30

# Errors of a factorisation, or of numbers beyond double precision.
FAILURES = (GraphError, np.linalg.LinAlgError)

# Called with the round and the number of accepted loops.
OnRound = Callable[[int, int], None]
# A judgement, and the map (n, p) it accepts.
Believed = tuple[Judgement, Array]
Judge = Callable[[FactorGraph, OnRound, Callable[[], None], Believed | None], Believed]


def as_measured(judge: Judge) -> Callable[..., Believed]:
    """Return a judge of graphs with repeated loops or placeholder noise."""
    @wraps(judge)
    def judged(graph: FactorGraph, report: OnRound = lambda round_, accepted: None,
               check: Callable[[], None] = lambda: None,
               known: Believed | None = None) -> Believed:
        factors = graph.between
        told = ~factors.is_odometry & ~factors.is_absolute & ~factors.trusted
        rows, which = np.unique(first_told(graph, np.flatnonzero(told)), return_inverse=True)
        if len(rows) == len(which):
            return _as_meant(judge, graph, report, check, known)
        before = known and (known[0].of_factors(rows), known[1])
        judgement, poses = _as_meant(judge, graph.subset(rows), report, check, before)
        return judgement.of_factors(which), poses

    return judged


def _as_meant(judge: Judge, graph: FactorGraph, report: OnRound, check: Callable[[], None],
              known: Believed | None) -> Believed:
    """
    Return the judgement of a graph, by estimated noise where the stated is far too large.

    By the stated noise too many outliers would fit. With the identity, radians weigh as metres:
    the variance of each is estimated, and weights the map.
    """
    meant = np.ones((2, graph.manifold.TANGENT_SIZE))
    has_absolute = graph.between.is_absolute.any()
    if not has_absolute:
        roots, rotation = identity_roots(graph), graph.manifold.ROTATION
        stated = np.isfinite(roots).all(axis=1)
        meant[stated, rotation] = _TURN * roots[stated, rotation]**2
    first = weighed(graph, meant)
    judgement, poses = judge(first, report, check, known)
    if has_absolute or first is graph and (
            judgement.variance[0] > _OVERSTATED or judgement.accepted.all()
            or _stays(graph, judgement)):
        return judgement, poses
    try:
        meant *= (judgement.variance[0] / _OVERSTATED if first is graph
                  else _by_number(first, judgement, poses))
    except FAILURES as error:
        return judgement.broken_off(graph, error), poses
    judgement, poses = judge(weighed(graph, meant), report, check, None)
    # Odometry keeps its stated variance, in the mean, so that later odometry weighs as much.
    times = np.exp(np.log(meant).mean(axis=1))
    return replace(judgement, variance=judgement.variance * times, meant=meant / times[0]), poses


def _stays(graph: FactorGraph, judgement: Judgement) -> bool:
    """
    Return whether accepted loops stay so by the estimated noise, but for one in a hundred.

    False also where undecidable: sigmas are in units of at most some hundred times this noise.
    """
    factors = graph.between
    gate = student_quantile(1 - BY_CHANCE, factors.freedom, graph.manifold.TANGENT_SIZE)
    fits = factors.is_odometry | (judgement.sigmas**2 < judgement.variance[0] * gate)
    return not judgement.doubts and bool((fits != judgement.accepted).mean() <= DOUBT)


def identity_roots(graph: FactorGraph) -> Array:
    """
    Return the roots of identity information, diagonals of odometry and of loops, (2, k).

    NaN where a kind states something else, or is absent. An identity read as information of
    quaternions is 1/4 for angles: their vector part is half of the angle.
    """
    factors, manifold = graph.between, graph.manifold
    found = np.full((2, manifold.TANGENT_SIZE), np.nan)
    for own, kind in zip(found, (factors.is_odometry, ~factors.is_odometry), strict=True):
        for angles in (1.0,) if manifold is se2 else (1.0, 0.5):
            roots = np.ones(manifold.TANGENT_SIZE)
            roots[manifold.ROTATION] = angles
            if kind.any() and np.allclose(factors.sqrt_information[kind], np.diag(roots)):
                own[:] = roots
    return found


def _by_number(graph: FactorGraph, judgement: Judgement, poses: Array) -> Array:
    """Return the estimated variance of odometry and loops, by translation and rotation, (2, k)."""
    growth = Growth(straightened(graph, judgement.drift))
    growth.resume(poses, judgement.accepted, judgement.variance)
    rows = np.flatnonzero(growth.accepted)
    at = np.flatnonzero(~growth.cut[rows])
    found, stated = np.full((2, 2, graph.manifold.TANGENT_SIZE), float(FEWEST))
    left = growth.posterior.residual[at]**2, np.diagonal(growth.posterior.moment[at], 0, 1, 2)
    for sums, squares in zip((found, stated), left, strict=True):
        np.add.at(sums, growth.given.is_loop[rows[at]].astype(np.int64), squares)
        for part in (graph.manifold.TRANSLATION, graph.manifold.ROTATION):
            sums[:, part] = sums[:, part].mean(axis=1, keepdims=True)
    ratio: Array = growth.noise.variance[:, None] * found / stated
    return ratio
