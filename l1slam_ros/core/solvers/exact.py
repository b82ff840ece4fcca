# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The exact L1 map of a graph: a rough L2 map first if that helps, then one interior-point run.

In: a graph and poses. Out: poses at a local optimum, and a dual that proves by how much the cost
can still fall.
"""

from dataclasses import replace

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.l1_problem import GraphProblem
from l1slam_ros.core.graph.linear_system import LinearSystem, whitened_residual
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.gauss_newton import ROUGH_L2, minimise_l2
from l1slam_ros.core.solvers.interior_point import Optimum, interior_point
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, Report, Solution
from l1slam_ros.core.solvers.optimality import L1, Norm, Status, fits_exactly, l1_cost
from l1slam_ros.core.solvers.seed import is_near

# It leaves the cost some 10^-6 above the optimum, in flat valleys and small worlds up to 6 10^-6.
_TOLERANCE = 2e-5
# Towards the L2 map from where all of a large graph fits to within the noise: what is left after
# one step is nothing beside the noise. Without it some place of a large graph bends more than the
# first steps of the run allow: nine worlds of 25,000 to 100,000 keyframes took 254 factorisations,
# the worst 49; with it 223 and 31, its own included.
_ONE_STEP = replace(ROUGH_L2, iterations=1)
# In the plane no step is spent on finding out that one left nothing. With 1e-3 for it Intel and
# City save a factorisation, too, but of 40 straight ways with few loops 32 are solved for 36; with
# this, 38. In space a start that is off by 4e-8 led the garage to 34 factorisations for 23.
_ROUGH_IN_PLANE = replace(ROUGH_L2, surprise=1e-6)
# Converged must also mean that no step of the last linear problem would lower the cost by more
# than this part: with many false loops it can come to rest where one would.
_PROVEN = 1e-2
# Of the dual at the end: most projections to make it feasible (each costs a solution, none a
# factorisation), and the part of the cost that is a gap small enough.
_PROJECTIONS = 10
_CLOSE = 1e-4
# A row at its bound still gives way a little, or there might be no feasible dual nearby. With a
# tenth of it the proof misses by percents on the torus in space; in the plane it costs nothing.
_LEAST_WEIGHT = 1e-2


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
    start_options = _ROUGH_IN_PLANE if graph.manifold is se2 else ROUGH_L2
    rough = minimise_l2(graph, poses, _ONE_STEP if is_near(graph, poses) else start_options,
                        cholesky).poses
    optimum = interior_point(problem, rough, cholesky, steps, _TOLERANCE, report)
    if optimum.costs[-1] > start:
        optimum = interior_point(problem, poses, cholesky, steps, _TOLERANCE, report)
    dual, gap, status = prove(optimum, cholesky)
    history = np.minimum.accumulate([start, *optimum.costs])
    return Solution(optimum.poses, optimum.costs[-1], status, len(history) - 1, 0, history, dual,
                    gap)


def prove(optimum: Optimum, cholesky: BlockCholesky) -> tuple[Array, float, Status]:
    """
    Return a dual y (rows,) with A'y = 0, |y| <= 1, what it proves, and the status in its light.

    No step of the linear problem at the poses can lower their cost by more than the gap,
    |b|_1 + b'y. A run that came to rest where one might lower it has not converged.
    """
    end = optimum.end
    y, gap = feasible_dual(end.system, end.y, np.minimum(end.s, end.t), L1, cholesky)
    return y, gap, proven(optimum.status, gap, optimum.costs[-1], len(y))


def proven(status: Status, gap: float, cost: float, rows: int) -> Status:
    """Return the status of a run: not converged if its dual proves too large a gap."""
    if fits_exactly(cost, rows) or gap <= _CLOSE * cost:
        return Status.CONVERGED
    return Status.STALLED if gap > _PROVEN * cost and status is Status.CONVERGED else status


def feasible_dual(system: LinearSystem, y: Array, slack: Array, norm: Norm,
                  cholesky: BlockCholesky) -> tuple[Array, float]:
    """
    Return a dual near y with A'y = 0, |y| <= 1, and by how much the cost exceeds its value.

    By turns projected on the one, along the slack (rows,) that it has left, and to the other; at
    the end shrunk by what is missing.

    norm : L1 or group L1
    """
    residual = -system.b
    slack = np.maximum(slack, _LEAST_WEIGHT)
    cost = norm.cost(residual)
    if not cholesky.factorise(system, slack):
        return np.zeros_like(y), cost
    for _ in range(_PROJECTIONS):
        y = norm.resolvent(y, 0.0)
        y = y - slack * system.times(cholesky.solve(system.transposed_times(y)))
        longest = float((np.abs(y) / np.maximum(np.abs(norm.resolvent(y, 0.0)), 1e-300)).max(
            initial=1.0))
        feasible = y / longest
        gap = max(norm.gap(residual, feasible), 0.0)
        if gap <= _CLOSE * cost:
            break
    return feasible, gap
