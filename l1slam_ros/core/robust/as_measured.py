# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A graph as it is told -> as it was measured: each loop once, with the noise that was meant.

In: what judges a graph. Out: the same for a graph that gives loops twice, or from either end, or
states noise that nobody meant, as where each information is the identity.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import wraps

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.robust.places import first_told

# Noise of odometry in units of what it states, in variance: with less nobody meant that.
_OVERSTATED = 0.003

# From the round and the loops accepted so far.
OnRound = Callable[[int, int], None]
# A judgement, and the map (n, p) of what it accepts.
Believed = tuple[Judgement, Array]
Judge = Callable[[FactorGraph, OnRound, Callable[[], None], Believed | None], Believed]


def as_measured(judge: Judge) -> Callable[..., Believed]:
    """Return what judges a graph as it was measured; see `batch.robust_solve`."""
    @wraps(judge)
    def judged(graph: FactorGraph, report: OnRound = lambda round_, accepted: None,
               check: Callable[[], None] = lambda: None,
               known: Believed | None = None) -> Believed:
        rows, which = np.unique(first_told(graph), return_inverse=True)
        if len(rows) == len(which):
            return _as_meant(judge, graph, report, check, known)
        before = known and (known[0].of_factors(rows), known[1])
        judgement, poses = _as_meant(judge, graph.subset(rows), report, check, before)
        return judgement.of_factors(which), poses

    return judged


def _as_meant(judge: Judge, graph: FactorGraph, report: OnRound, check: Callable[[], None],
              known: Believed | None) -> Believed:
    """
    Return the judgement of a graph, by the noise that was found where it states far too much.

    By what is stated there, far too many loops that are off fit by chance.
    """
    judgement, poses = judge(graph, report, check, known)
    times = float(judgement.variance[0])
    factors = graph.between
    if times > _OVERSTATED or judgement.accepted.all() or factors.is_absolute.any():
        return judgement, poses
    meant = graph.subset(np.arange(len(factors)), np.full(len(factors), times))
    judgement, poses = judge(meant, report, check, None)
    return replace(judgement, variance=judgement.variance * times), poses
