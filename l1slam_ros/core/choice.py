# SPDX-License-Identifier: Apache-2.0
"""
The L1 solvers by name, and which one a graph gets where nobody chose.

In: a graph and poses. Out: the solution, and the name of the solver that found it.
"""

from l1slam_ros.core.graph import FactorGraph
from l1slam_ros.core.interior_point import minimise_interior_point
from l1slam_ros.core.manifold import Array
from l1slam_ros.core.optimality import Status
from l1slam_ros.core.optimiser import OptimiserOptions, Report, Solution, minimise

AUTO, PRIMAL_DUAL, INTERIOR_POINT = SOLVERS = ('auto', 'primal-dual', 'interior-point')
# Factors per keyframe up to which a factorisation stays cheap: the paper's sparse graphs have 1.6
# to 2.1, its dense worlds 6 to 14, where the factor fills in.
_SPARSE = 3.0


def minimise_by(
    solver: str, graph: FactorGraph, poses: Array, options: OptimiserOptions,
    report: Report = lambda iteration, cost: None
) -> tuple[Solution, str]:
    """
    Minimise the L1 norm of the whitened residuals by one of `SOLVERS`.

    `auto` is the interior point on sparse graphs and Algorithm 4 on dense ones. Where the
    interior point does not converge, Algorithm 4 goes on from its best poses.
    """
    dense = len(graph.between) > _SPARSE * graph.n_poses
    if solver == PRIMAL_DUAL or (solver == AUTO and dense):
        return minimise(graph, poses, options, report=report), PRIMAL_DUAL
    solution = minimise_interior_point(graph, poses, options, report)
    if solver == INTERIOR_POINT or solution.status is Status.CONVERGED:
        return solution, INTERIOR_POINT
    return minimise(graph, solution.poses, options, report=report), PRIMAL_DUAL
