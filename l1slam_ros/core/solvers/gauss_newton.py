# SPDX-License-Identifier: Apache-2.0
"""
What L1 is compared with: Gauss-Newton for L2, and Huber, on the same linearisation.

In: a graph and poses. Out: poses of lower cost. Both solve sparse normal equations and add
Marquardt's damping only when a plain Gauss-Newton step fails.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import linearise, step_poses, whitened_residual
from l1slam_ros.core.options import Options, option
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.nonlinear import Report, Solution
from l1slam_ros.core.solvers.optimality import Huber, Norm, Status, fits_exactly, l1_cost
from l1slam_ros.core.solvers.reweighting import weighted_least_squares

_FIRST_DAMPING = 1e-6
_MOST_DAMPING = 1e6


@dataclass(frozen=True)
class LeastSquaresOptions(Options):
    """How long Gauss-Newton runs and when it is content."""

    iterations: int = option(100, 'most linearisations', '', 0, 10**6)
    tolerance: float = option(
        1e-9, 'converged when the cost fell by no more than this part of itself', '1', 0, 1)
    huber_delta: float = option(
        1.345, "length of a factor's whitened residual where Huber turns linear", 'sigmas',
        1e-9, 1e9)


def minimise_l2(
    graph: FactorGraph,
    poses: Array,
    options: LeastSquaresOptions,
    cholesky: BlockCholesky,
    report: Report = lambda iteration, cost: None,
) -> Solution:
    """Minimise chi2, the sum of squared whitened residuals; arguments as `optimiser.minimise`."""
    return gauss_newton(graph, poses, Huber(), options, cholesky, report)


def minimise_huber(
    graph: FactorGraph,
    poses: Array,
    options: LeastSquaresOptions,
    cholesky: BlockCholesky,
    report: Report = lambda iteration, cost: None,
) -> Solution:
    """Minimise Huber's norm of each factor, odometry included; arguments as above."""
    norm = Huber(graph.manifold.TANGENT_SIZE, options.huber_delta)
    return gauss_newton(graph, poses, norm, options, cholesky, report)


def gauss_newton(
    graph: FactorGraph,
    poses: Array,
    norm: Norm,
    options: LeastSquaresOptions,
    cholesky: BlockCholesky,
    report: Report = lambda iteration, cost: None,
) -> Solution:
    """Minimise a norm, reweighted at each step; arguments as `optimiser.minimise`."""
    residual = whitened_residual(graph, poses)
    history = [norm.cost(residual)]
    status, damping = Status.ITERATION_LIMIT, 0.0
    while len(history) <= options.iterations:
        if fits_exactly(l1_cost(residual), len(residual)):
            status = Status.CONVERGED
            break
        system = linearise(graph, poses, residual)
        step = weighted_least_squares(system, cholesky, norm.weights(residual), damping)
        candidate = step_poses(graph, poses, step)
        moved = whitened_residual(graph, candidate)
        cost = norm.cost(moved)
        decrease, full = history[-1] - cost, damping <= _FIRST_DAMPING
        if decrease >= 0:
            poses, residual = candidate, moved
            damping = damping / 10 if damping > _FIRST_DAMPING else 0.0
        else:
            damping, cost = max(10 * damping, _FIRST_DAMPING), history[-1]
        history.append(cost)
        report(len(history) - 1, cost)
        # By a step as good as undamped; at the optimum rounding may let the cost rise a little.
        if full and abs(decrease) <= options.tolerance * cost:
            status = Status.CONVERGED
            break
        if damping > _MOST_DAMPING:
            status = Status.STALLED
            break
    return Solution(poses, history[-1], status, len(history) - 1, 0, np.array(history),
                    np.zeros(len(residual)))
