# SPDX-License-Identifier: Apache-2.0
"""
Which L1 solver a graph gets where nobody chose one.

In: a graph and poses. Out: the solution, and the name of the solver that found it.
"""

from l1slam_ros.core.graph import FactorGraph
from l1slam_ros.core.interior_point import minimise_interior_point
from l1slam_ros.core.manifold import Array
from l1slam_ros.core.optimality import Status
from l1slam_ros.core.optimiser import OptimiserOptions, Report, Solution, minimise

PRIMAL_DUAL, INTERIOR_POINT = 'primal-dual', 'interior-point'
# Factors per keyframe up to which a factorisation stays cheap: the paper's sparse graphs have 1.6
# to 2.1, its dense worlds 6 to 14, where the factor fills in.
_SPARSE = 3.0


def minimise_automatically(
    graph: FactorGraph, poses: Array, options: OptimiserOptions,
    report: Report = lambda iteration, cost: None
) -> tuple[Solution, str]:
    """
    Minimise the L1 norm by the interior point on sparse graphs, by Algorithm 4 on dense ones.

    Where the interior point does not converge, Algorithm 4 goes on from its best poses.
    """
    if len(graph.between) > _SPARSE * graph.n_poses:
        return minimise(graph, poses, options, report=report), PRIMAL_DUAL
    solution = minimise_interior_point(graph, poses, report)
    if solution.status is Status.CONVERGED:
        return solution, INTERIOR_POINT
    return minimise(graph, solution.poses, options, report=report), PRIMAL_DUAL
