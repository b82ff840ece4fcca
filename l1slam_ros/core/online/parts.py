# SPDX-License-Identifier: Apache-2.0
"""
A problem as the judge and the solvers want it: of one piece, without what a person struck out.

In: the problem of a back end. Out: the same where parts of the map are tied to each other as they
stand, so weakly that whatever else joins them decides; and what was made of it, for the factors
of the back end's graph alone.
"""

from dataclasses import replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import sigmas
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.online.snapshot import Problem
from l1slam_ros.core.online.update import Improvement

# [rad] Of the heading of a part: that it is not known. Its place is, to the extent of the map.
_HEADING = 1.0


def as_one(problem: Problem) -> Problem:
    """Return the problem whose graph is of one piece."""
    rows = problem.graph.not_struck
    g, d = len(problem.gaps), problem.graph.manifold.TANGENT_SIZE
    if not g and len(rows) == len(problem.graph.between):
        return problem
    judgement = problem.judgement
    return replace(
        problem, graph=_tied(problem.graph.subset(rows), problem.poses, problem.gaps),
        dual=np.append(problem.dual.reshape(-1, d)[rows].ravel(), np.zeros(g * d)),
        judgement=replace(
            judgement, accepted=np.append(judgement.accepted[rows], np.ones(g, bool)),
            suspect=np.append(judgement.suspect[rows], np.zeros(g, bool)),
            sigmas=np.append(judgement.sigmas[rows], np.zeros(g)),
            noise=np.append(judgement.noise[rows], np.ones(g))))


def of_all(improvement: Improvement, problem: Problem) -> Improvement:
    """Return what was made of `as_one(problem)`, for the factors of the problem."""
    rows, d = problem.graph.not_struck, problem.graph.manifold.TANGENT_SIZE
    dual = np.zeros((len(problem.graph.between), d))
    dual[rows] = improvement.dual.reshape(-1, d)[:len(rows)]
    return replace(improvement, dual=dual.ravel(),
                   judgement=improvement.judgement.of_all(problem.graph))


def _tied(graph: FactorGraph, poses: Array, keyframes: Indices) -> FactorGraph:
    """Return the graph with keyframes k tied to k - 1, of other parts, as poses (n, p) say."""
    manifold, d = graph.manifold, graph.manifold.TANGENT_SIZE
    extent = float(np.ptp(manifold.positions(poses), axis=0).max()) if len(poses) else 0.0
    sigma = sigmas(manifold, 1.0 + extent, _HEADING)
    graph.follow(keyframes, keyframes - 1)
    graph.append_between(
        keyframes - 1, keyframes, manifold.between(poses[keyframes - 1], poses[keyframes]),
        np.broadcast_to(np.diag(1 / sigma), (len(keyframes), d, d)))
    return graph
