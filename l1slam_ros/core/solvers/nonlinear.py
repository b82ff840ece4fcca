# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Algorithm 4, the outer loop: linearise as for L2, solve by primal-dual, retract, accept or shrink.

In: a graph, poses and the dual of an earlier solve, if any. Out: poses of lower L1 cost. The
dual is kept from one linearisation to the next: restarted from zero, the loop stalls above the
optimum, which is where the paper's own figures lie.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import (
    LinearSystem,
    linearise,
    step_poses,
    whitened_residual,
)
from l1slam_ros.core.names import NORMS, SAME
from l1slam_ros.core.options import Options, option
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.optimality import Status, fits_exactly, l1_cost
from l1slam_ros.core.solvers.primal_dual import PrimalDualOptions
from l1slam_ros.core.solvers.restarted_pdhg import minimise_l1_halpern
from l1slam_ros.core.solvers.reweighting import reweighted_start

# A linearisation whose cost fell by more than this part left a different problem behind: its dual
# no longer fits. Keeping it there ends 15% above the optimum from City's stored start.
_FAR = 0.01
# After a step that lowers the cost but little, the next one gets that many times the iterations;
# so many such steps in a row are the end.
_MORE_EFFORT, _SMALL_STEPS = 4, 2
# A step is halved this often before the direction is given up: to 1/32 of it.
_HALVINGS = 5


@dataclass(frozen=True)
class OptimiserOptions(Options):
    """When Algorithm 4 stops, and the options of its inner solver."""

    norm: str = option(
        NORMS[0], 'norm that `l1slam` and `~/optimize` minimise; the updates in between always '
        'minimise l1', '', choices=NORMS)
    loop_norm: str = option(
        SAME, 'norm of the residuals of loops and absolute poses; same: the norm of the odometry',
        '', choices=(SAME, *NORMS))
    outer_iterations: int = option(
        60, 'largest number of linearisations of one solve', '', 0, 10**6)
    outer_tolerance: float = option(
        1e-6, 'a solve has converged when the cost fell by less than this fraction of itself '
        'twice in a row', '1', 0, 1)
    inner: PrimalDualOptions = PrimalDualOptions()


@dataclass(frozen=True)
class Solution:
    """
    The result of a solver.

    poses : (n, p); cost : of the norm it minimises; history : (outer_iterations + 1,) costs,
    the start first; dual : (rows,) and gap : of the last linear problem, see `duality_gap`; L2 and
    Huber have neither (zeros, infinite).
    """

    poses: Array
    cost: float
    status: Status
    outer_iterations: int
    inner_iterations: int
    history: Array
    dual: Array
    gap: float = np.inf


Report = Callable[[int, float], None]


def minimise(
    graph: FactorGraph,
    poses: Array,
    options: OptimiserOptions,
    cholesky: BlockCholesky | None = None,
    dual: Array | None = None,
    deadline: float = np.inf,
    report: Report = lambda iteration, cost: None,
) -> Solution:
    """
    Minimise the L1 norm of the whitened residuals over the poses.

    Parameters
    ----------
    graph, poses : the factors and the (n, p) poses to start from
    options : see `OptimiserOptions`
    cholesky : of the graph; while there is no dual, and while the poses are still far from the
        optimum, a linear problem is started from reweighted least squares by it; without it, from
        what the last one left
    dual : (rows,) of an earlier solve
    deadline : `time.monotonic()` [s] after which no new linearisation begins
    report : called with the outer iteration and its cost

    """
    residual = whitened_residual(graph, poses)
    history = [l1_cost(residual)]
    status, inner, small_steps, gap = Status.ITERATION_LIMIT, 0, 0, np.inf
    weight: float | None = None
    for outer in range(options.outer_iterations):
        if fits_exactly(history[-1], len(residual)):
            status, gap = Status.CONVERGED, 0.0
            break
        system = linearise(graph, poses, residual)
        anew = dual is None or (outer > 0 and is_far(*history[-2:]))
        x, dual = _start(system, dual, cholesky if anew else None)
        effort = options.inner.iterations * _MORE_EFFORT**small_steps
        solution = minimise_l1_halpern(system, x, dual, replace(options.inner, iterations=effort),
                                       weight, deadline)
        dual, gap, weight = solution.y, solution.gap, solution.weight
        poses, residual = backtrack(graph, poses, residual, solution.x)
        inner, cost = inner + solution.iterations, l1_cost(residual)
        history.append(cost)
        report(outer + 1, cost)
        # A failed step is not the end: with the better dual, and more iterations, the next one may
        # succeed.
        small = history[-2] - cost <= options.outer_tolerance * cost
        small_steps = small_steps + 1 if small else 0
        if small_steps == _SMALL_STEPS:
            falls = history[-_SMALL_STEPS - 1] > cost or solution.status is Status.CONVERGED
            status = Status.CONVERGED if falls else Status.STALLED
            break
        if time.monotonic() > deadline:
            status = Status.OUT_OF_TIME
            break
    dual = np.zeros(len(residual)) if dual is None else dual
    return Solution(poses, history[-1], status, len(history) - 1, inner, np.array(history), dual,
                    gap)


def _start(
    system: LinearSystem, dual: Array | None, cholesky: BlockCholesky | None
) -> tuple[Array, Array]:
    """Return the start of a linear problem, (columns,) and (rows,), by `cholesky` if given."""
    if cholesky:
        return reweighted_start(system, cholesky)
    x = np.zeros(system.size * system.block_size)
    return x, np.zeros(len(system.b)) if dual is None else dual


def is_far(before: float, after: float) -> bool:
    """Tell whether the cost fell so much that the next linear problem differs from the last."""
    return before - after > _FAR * after


def backtrack(
    graph: FactorGraph, poses: Array, residual: Array, step: Array,
    cost_of: Callable[[Array], float] = l1_cost,
) -> tuple[Array, Array]:
    """
    Return poses and residual after the longest of step, step/2, ... that lowers the cost.

    If none does, poses and residual are returned unchanged. cost_of : the cost of a residual
    """
    cost = cost_of(residual)
    for halvings in range(_HALVINGS + 1):
        candidate = step_poses(graph, poses, step / 2**halvings)
        found = whitened_residual(graph, candidate)
        if cost_of(found) < cost:
            return candidate, found
    return poses, residual
