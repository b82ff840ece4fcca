# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Newton's method for group L1 and for mixed norms, to the exact optimum.

In: a graph, poses and a norm. Out: poses at a local optimum, a dual and the gap that it proves.

A length has no derivative at zero, where many residuals end, so |e| is replaced by
R = sqrt(|e|^2 + mu^2), and mu goes to zero. The dual y of each factor, |y| <= 1, is a separate
variable, and R y = e, J'y = 0 is solved. A step linearises that,

    (J'W J + kappa C) dx = -J'(e / R),    W = (I - (y e' + e y') / 2 R) / R,
    y + dy = e / R + W J dx,

which is Newton's method on a system that stays nearly linear, however small mu is: with y = e / R
put in, steps would shrink with mu. C and kappa as in `interior_point`. In the place of e / R and W
a norm without corners has its derivative and its weights (`optimality.SmoothNorm`).

Source: Chan, Golub and Mulet, "A nonlinear primal-dual method for total variation-based image
restoration" (1999), sections 3 and 4; the curvature is ours, defended by
`test_norms.py`.
"""

from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.l1_problem import GraphProblem
from l1slam_ros.core.graph.linear_system import LinearSystem, whitened_residual
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.exact import feasible_dual, proven
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.interior_point import Curvature
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, Report, Solution
from l1slam_ros.core.solvers.optimality import SmoothNorm, Status, fits_exactly, smoothing

# Converged when smoothing and the next step would change the cost by less than this fraction.
_TOLERANCE = 1e-6
# What mu becomes of itself after a full step of poses and dual, and where there was none; and at
# first of the mean length.
_FALLS = 0.1
_FALLS_SLOWLY = 0.7
_FIRST = 0.5
# How far to go towards the bound of the dual, and how often a step is halved.
_FRACTION, _HALVINGS = 0.99, 12


@dataclass
class _Iterate:
    """Poses, their linearisation, how much corners are rounded, the dual (m, k)."""

    poses: Array
    system: LinearSystem
    mu: float
    y: Array

    @property
    def residual(self) -> Array:
        return -self.system.b.reshape(self.y.shape)


def minimise_norm(
    graph: FactorGraph,
    poses: Array,
    norm: SmoothNorm,
    options: OptimiserOptions,
    cholesky: BlockCholesky,
    report: Report = lambda iteration, cost: None,
) -> Solution:
    """
    Minimise a norm in `options.outer_iterations` steps at most, from the L2 map they lead to.

    All starts in the same valley lead to that map; it counts as one step.
    """
    residual = whitened_residual(graph, poses)
    start, rows = norm.cost(residual), len(residual)
    history = [start]
    if options.outer_iterations < 1:
        return Solution(poses, start, Status.ITERATION_LIMIT, 0, 0, np.array(history),
                        np.zeros(rows))
    poses = minimise_l2(graph, poses, LeastSquaresOptions(), cholesky).poses
    problem = GraphProblem(graph)
    at, curvature = _begin(problem, poses, norm), Curvature()
    history.append(norm.cost(-at.system.b))
    best, status = at, Status.ITERATION_LIMIT
    for iteration in range(1, options.outer_iterations):
        if fits_exactly(history[-1], rows):
            status = Status.CONVERGED
            break
        open_, moved = _step(problem, at, norm, cholesky, curvature)
        if moved is None:
            status = Status.STALLED
            break
        at = moved
        cost = norm.cost(-at.system.b)
        best = at if cost <= history[-1] else best
        history.append(min(cost, history[-1]))
        report(iteration, history[-1])
        if open_ <= _TOLERANCE * cost:
            status = Status.CONVERGED
            break
    y, gap = feasible_dual(best.system, best.y.ravel(), norm.slack(best.y), norm, cholesky)
    status = proven(status, gap, history[-1], rows)
    return Solution(best.poses, history[-1], status, len(history) - 1, 0, np.array(history), y,
                    gap)


def _begin(problem: GraphProblem, poses: Array, norm: SmoothNorm) -> _Iterate:
    residual = problem.residual(poses)
    e = residual.reshape(-1, problem.graph.manifold.TANGENT_SIZE)
    mu = _FIRST * smoothing(np.linalg.norm(e, axis=1))
    y = norm.smoothed(e, np.zeros_like(e), mu).gradient
    return _Iterate(poses, problem.linearise(poses, residual), mu, y)


def _step(problem: GraphProblem, at: _Iterate, norm: SmoothNorm, cholesky: BlockCholesky,
          curvature: Curvature) -> tuple[float, _Iterate | None]:
    """Return what a step and what is rounded add to the cost, and what it led to or None."""
    e = at.residual
    smooth, d, W = norm.smoothed(e, at.y, at.mu)
    roots = np.linalg.cholesky(W).transpose(0, 2, 1).astype(np.float64, copy=False)
    rooted = at.system.weighted(roots)
    C = problem.curvature(at.poses, at.y.ravel())
    if not curvature.factorise(rooted, np.ones(e.size), C, cholesky):
        return 0.0, None
    gradient = at.system.transposed_times(d.ravel())
    x = cholesky.solve(-gradient)
    if not np.isfinite(x).all():
        return 0.0, None
    open_ = max(-float((gradient * x).sum()), smooth - norm.cost(e.ravel()))
    for halvings in range(_HALVINGS):
        length = 0.5**halvings
        poses = problem.step(at.poses, length * x)
        residual = problem.residual(poses)
        if norm.smoothed(residual.reshape(e.shape), at.y, at.mu).cost <= smooth:
            break
    else:
        return open_, replace(at, mu=at.mu * _FALLS_SLOWLY)
    Jx = at.system.times(x).reshape(e.shape)
    dy = d + (W @ Jx[:, :, None])[..., 0] - at.y
    dual = min(1.0, _FRACTION * norm.reach(at.y, dy))
    mu = at.mu * (1 - (1 - _FALLS) * min(length, dual))
    return open_, _Iterate(poses, problem.linearise(poses, residual), mu, at.y + dual * dy)
