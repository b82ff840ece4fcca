# SPDX-License-Identifier: Apache-2.0
"""
The exact L1 map of a graph: rough L2 first where that helps, then one interior-point run.

In: a graph and poses. Out: poses at a local optimum, and a bound on what is left.
"""

from dataclasses import replace

import numpy as np

from l1slam_ros.core.cholesky import BlockCholesky
from l1slam_ros.core.graph import FactorGraph
from l1slam_ros.core.interior_point import GraphProblem, interior_point
from l1slam_ros.core.l2 import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.linearise import whitened_residual
from l1slam_ros.core.manifold import Array
from l1slam_ros.core.optimality import Status, l1_cost
from l1slam_ros.core.optimiser import OptimiserOptions, Report, Solution

# It leaves the cost 10^-6 above the optimum, 3 10^-6 in Manhattan's flat valley.
_TOLERANCE = 3e-5
_ROUGH_L2 = LeastSquaresOptions(iterations=30, tolerance=1e-3)
# The L2 map is the better start, in the middle of the valley, unless false loops bend it. Its L1
# cost is a quarter above the optimum at most on clean data (measured: 17 to 25%).
_STRAIGHT = 4 / 3


def minimise_interior_point(
    graph: FactorGraph,
    poses: Array,
    options: OptimiserOptions,
    cholesky: BlockCholesky,
    report: Report = lambda iteration, cost: None,
) -> Solution:
    """
    Minimise the L1 norm of the whitened residuals in `options.outer_iterations` steps at most.

    From the L2 map that poses (n, p) lead to, or where its L1 cost is far above theirs (false loops
    bend it) from the poses themselves. The result is the best poses met, never worse than the
    start.
    """
    cost = l1_cost(whitened_residual(graph, poses))
    iterations = min(_ROUGH_L2.iterations, options.outer_iterations)
    rough = minimise_l2(graph, poses, replace(_ROUGH_L2, iterations=iterations), cholesky).poses
    straight = l1_cost(whitened_residual(graph, rough)) < _STRAIGHT * cost
    optimum = interior_point(GraphProblem(graph), rough if straight else poses, cholesky,
                             options.outer_iterations, _TOLERANCE, report)
    history = np.minimum.accumulate([cost, *optimum.costs[1:]])
    best, status = optimum.poses, optimum.status
    if optimum.costs[-1] > cost:
        best, status = poses, Status.STALLED
    return Solution(best, history[-1], status, len(history) - 1, 0, history, optimum.y,
                    optimum.gap)
