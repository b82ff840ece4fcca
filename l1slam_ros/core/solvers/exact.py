# SPDX-License-Identifier: Apache-2.0
"""
The exact L1 map of a graph: rough L2 first where that helps, then one interior-point run.

In: a graph and poses. Out: poses at a local optimum, and a bound on what is left.
"""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.l1_problem import GraphProblem
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.interior_point import interior_point, prove
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, Report, Solution
from l1slam_ros.core.solvers.optimality import Status, l1_cost

# It leaves the cost some 10^-6 above the optimum, in flat valleys and small worlds up to 6 10^-6.
_TOLERANCE = 2e-5
_ROUGH_L2 = LeastSquaresOptions(iterations=30, tolerance=1e-3)


def minimise_interior_point(
    graph: FactorGraph,
    poses: Array,
    options: OptimiserOptions,
    cholesky: BlockCholesky,
    report: Report = lambda iteration, cost: None,
) -> Solution:
    """
    Minimise the L1 norm of the whitened residuals in `options.outer_iterations` steps at most.

    From the L2 map that poses (n, p) lead to, which lies in the middle of the valley; should that
    end above the poses' own cost (false loops bend it), from the poses themselves. The result is
    the best poses met, never worse than the start. The L2 map counts as one step.
    """
    residual = whitened_residual(graph, poses)
    start = l1_cost(residual)
    steps = options.outer_iterations - 1
    if steps < 0:
        return Solution(poses, start, Status.ITERATION_LIMIT, 0, 0, np.array([start]),
                        np.zeros(len(residual)))
    problem = GraphProblem(graph)
    rough = minimise_l2(graph, poses, _ROUGH_L2, cholesky).poses
    optimum = interior_point(problem, rough, cholesky, steps, _TOLERANCE, report)
    if optimum.costs[-1] > start:
        optimum = interior_point(problem, poses, cholesky, steps, _TOLERANCE, report)
    dual, gap, status = prove(optimum, cholesky)
    history = np.minimum.accumulate([start, *optimum.costs])
    return Solution(optimum.poses, optimum.costs[-1], status, len(history) - 1, 0, history, dual,
                    gap)
