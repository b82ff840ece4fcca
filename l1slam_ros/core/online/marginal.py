# SPDX-License-Identifier: Apache-2.0
"""How well the map knows where the robot is."""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.linear_system import linearise
from l1slam_ros.core.online.parts import as_one
from l1slam_ros.core.online.snapshot import Snapshot
from l1slam_ros.core.solvers.block_cholesky import cholesky_of


def newest_covariance(now: Snapshot) -> Array | None:
    """
    Return the covariance of the newest keyframe in its own axes, (d, d).

    It is the marginal of the accepted factors, as noisy as they say: the last block of
    (A'A)^-1, by one solve for each of its columns. It is relative to the first keyframe, or to
    the world where an absolute pose is believed. None: the map does not say.
    """
    problem = as_one(now.problem())
    graph = problem.graph.subset(problem.judgement.accepted)
    system, k = linearise(graph, problem.poses), graph.manifold.TANGENT_SIZE
    if not system.size:
        return np.zeros((k, k))
    cholesky = cholesky_of(graph)
    if not cholesky.factorise(system, np.ones_like(system.b)):
        return None
    newest = np.zeros((system.size, k, k))
    newest[-1] = np.eye(k)
    covariance: Array = cholesky.solve_many(newest)[-1]
    return covariance
