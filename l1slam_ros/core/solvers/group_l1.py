# SPDX-License-Identifier: Apache-2.0
"""
The group L1 map to the last digits: the sum of the lengths of the factors' whitened residuals.

In: a graph and poses. Out: poses at a local optimum, a dual and what it proves. A length has no
derivative at zero, where many end, so |e| becomes R = sqrt(|e|^2 + mu^2), and mu goes to zero. The
dual y of each factor, |y| <= 1, is a variable of its own: what is solved is R y = e, J'y = 0. A
step linearises that,

    (J'W J + kappa C + D I) dx = -J'(e / R),    W = (I - (y e' + e y') / 2 R) / R,
    y + dy = e / R + W J dx,

which is Newton's method on a system that stays nearly linear, however small mu is: with y = e / R
put in, steps would shrink with mu. C, kappa and D as in `interior_point`.

Source: Chan, Golub and Mulet, "A nonlinear primal-dual method for total variation-based image
restoration" (1999), sections 3 and 4; curvature and damping are ours, defended by
`test_group_l1.py`.
"""

from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.l1_problem import GraphProblem
from l1slam_ros.core.graph.linear_system import LinearSystem, whitened_residual
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.interior_point import Regularisation, feasible_dual
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, Report, Solution
from l1slam_ros.core.solvers.optimality import Lengths, Status, fits_exactly, smoothing

# Converged when smoothing and the next step would change the cost by less than this part.
_TOLERANCE = 1e-6
# What mu becomes of itself: after a long step, after a short one, and at first of the mean length.
_FALLS, _FALLS_SLOWLY, _FIRST = 0.2, 0.7, 0.5
# How far to go towards the bound of the dual, and how often a step is halved.
_FRACTION, _HALVINGS = 0.99, 12
# The proof: a gap above this part of the cost proves nothing.
_PROVEN = 1e-2


@dataclass
class _Iterate:
    """Poses, their linearisation, the residual (m, k), its smoothed lengths (m,), the dual."""

    poses: Array
    system: LinearSystem
    mu: float
    y: Array

    @property
    def residual(self) -> Array:
        return -self.system.b.reshape(self.y.shape)

    @property
    def length(self) -> Array:
        """R of each factor, (m, 1)."""
        return _smoothed(self.residual, self.mu)


def minimise_group_l1(
    graph: FactorGraph,
    poses: Array,
    options: OptimiserOptions,
    cholesky: BlockCholesky,
    report: Report = lambda iteration, cost: None,
) -> Solution:
    """
    Minimise group L1 in `options.outer_iterations` steps at most, from the L2 map they lead to.

    That is where all who start in the same valley start; it counts as one step.
    """
    norm = Lengths(graph.manifold.TANGENT_SIZE)
    residual = whitened_residual(graph, poses)
    start, rows = norm.cost(residual), len(residual)
    history = [start]
    if options.outer_iterations < 1:
        return Solution(poses, start, Status.ITERATION_LIMIT, 0, 0, np.array(history),
                        np.zeros(rows))
    poses = minimise_l2(graph, poses, LeastSquaresOptions(), cholesky).poses
    problem = GraphProblem(graph)
    at, regularisation = _begin(problem, poses, norm.size), Regularisation()
    history.append(norm.cost(at.system.b))
    best, status = at, Status.ITERATION_LIMIT
    for iteration in range(1, options.outer_iterations):
        if fits_exactly(history[-1], rows):
            status = Status.CONVERGED
            break
        decrease, moved = _step(problem, at, cholesky, regularisation)
        if moved is None:
            status = Status.STALLED
            break
        at = moved
        cost = norm.cost(at.system.b)
        best = at if cost <= history[-1] else best
        history.append(min(cost, history[-1]))
        report(iteration, history[-1])
        if max(decrease, at.mu * len(at.y)) <= _TOLERANCE * cost:
            status = Status.CONVERGED
            break
    slack = np.repeat(1 - np.linalg.norm(best.y, axis=1), norm.size)
    y, gap = feasible_dual(best.system, best.y.ravel(), slack, norm, cholesky)
    if status is Status.CONVERGED and gap > _PROVEN * history[-1] and not fits_exactly(
            history[-1], rows):
        status = Status.STALLED
    return Solution(best.poses, history[-1], status, len(history) - 1, 0, np.array(history), y,
                    gap)


def _begin(problem: GraphProblem, poses: Array, size: int) -> _Iterate:
    residual = problem.residual(poses)
    e = residual.reshape(-1, size)
    mu = _FIRST * smoothing(np.linalg.norm(e, axis=1))
    return _Iterate(poses, problem.linearise(poses, residual), mu, e / _smoothed(e, mu))


def _smoothed(e: Array, mu: float) -> Array:
    length: Array = np.sqrt((e * e).sum(axis=1, keepdims=True) + mu * mu)
    return length


def _step(problem: GraphProblem, at: _Iterate, cholesky: BlockCholesky,
          regularisation: Regularisation) -> tuple[float, _Iterate | None]:
    """Return by how much a step was to lower the cost, and what it led to, None: nowhere."""
    e, R = at.residual, at.length
    d, k = e / R, e.shape[1]
    crossed = at.y[:, :, None] * d[:, None, :]
    W = (np.eye(k) - (crossed + crossed.transpose(0, 2, 1)) / 2) / R[:, :, None]
    roots = np.linalg.cholesky(W).transpose(0, 2, 1).astype(np.float64, copy=False)
    rooted = at.system.weighted(roots)
    curvature = problem.curvature(at.poses, at.y.ravel())
    if not regularisation.factorise(rooted, np.ones(e.size), curvature, cholesky):
        return 0.0, None
    gradient = at.system.transposed_times(d.ravel())
    x = cholesky.solve(-gradient)
    if not np.isfinite(x).all():
        return 0.0, None
    decrease, smooth = -float((gradient * x).sum()), float(R.sum())
    for halvings in range(_HALVINGS):
        length = 0.5**halvings
        poses = problem.step(at.poses, length * x)
        residual = problem.residual(poses)
        if float(_smoothed(residual.reshape(e.shape), at.mu).sum()) <= smooth:
            break
    else:
        regularisation.learn(0.0)
        return decrease, replace(at, mu=at.mu * _FALLS_SLOWLY)
    regularisation.learn(length)
    Jx = at.system.times(x).reshape(e.shape)
    dy = d + (W @ Jx[:, :, None])[..., 0] - at.y
    y = at.y + _longest(at.y, dy) * dy
    mu = at.mu * (_FALLS if length > 0.3 else _FALLS_SLOWLY)
    return decrease, _Iterate(poses, problem.linearise(poses, residual), mu, y)


def _longest(y: Array, dy: Array) -> float:
    """Return how far to go along dy, at most 1, so that no dual gets longer than 1."""
    a, b = (dy * dy).sum(axis=1), (y * dy).sum(axis=1)
    c = np.maximum(1 - (y * y).sum(axis=1), 0.0)
    # The larger root of |y + t dy| = 1, without cancellation where dy is small.
    root = np.sqrt(b * b + a * c)
    reach = np.where(b > 0, c / np.maximum(b + root, 1e-300),
                     (root - b) / np.maximum(a, 1e-300))
    return min(1.0, _FRACTION * float(reach.min(initial=np.inf)))
