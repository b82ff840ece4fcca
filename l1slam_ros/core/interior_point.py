# SPDX-License-Identifier: Apache-2.0
"""
The L1 map to the last digits: one nonlinear primal-dual interior-point run (Mehrotra's steps).

In: a graph and poses near the map. Out: poses at a local optimum. Where Algorithm 4 solves many
linear problems one after the other, this relinearises at every step of a single solve. With
e(x) = u - v, u, v >= 0 and the slacks s = 1 - y, t = 1 + y of the dual's box:

    minimise sum(u + v)    so that    u s = mu, v t = mu, J'y = 0,    mu -> 0.

A step solves (J'QJ + kappa C + D I) dx = -J'(y + Q g), Q = 1 / (u/s + v/t), where C = sum y d2e is
the curvature of the residuals: without it the run fails where a map bends easily (Manhattan).

It costs one sparse factorisation a step, some twenty in all: cheap on sparse graphs, hopeless on
dense ones. It is local: started far off it can return its start, which it says by its status.

Source: Mehrotra (1992) for the predictor and corrector; the rest is ours, defended by
`test_interior_point.py`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import SuperLU

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.graph import FactorGraph
from l1slam_ros.core.l2 import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.least_squares import diagonal, factorise, smoothing
from l1slam_ros.core.linearise import (
    LinearSystem,
    anchor,
    linearise,
    step_poses,
    whitened_residual,
)
from l1slam_ros.core.manifold import Array
from l1slam_ros.core.optimality import Status, fits_exactly, l1_cost
from l1slam_ros.core.optimiser import OptimiserOptions, Report, Solution

# Converged when both the complementarity gap u's + v't and |e - u + v|_1 are below this part of
# the cost, which leaves it 10^-6 above the optimum, 3 10^-5 in Manhattan's flat valley.
_TOLERANCE = 3e-5
# How far to go towards the nearest bound.
_FRACTION = 0.9995
# Slacks are kept above this and never recomputed as 1 -+ y, which would cancel.
_SMALLEST_SLACK = 1e-15
# A step is shortened while the residual departs from its linearisation by more than this part of
# the gap, but not below the last number.
_DEPARTURE, _SHORTEST = 0.5, 1e-4
# Of the curvature: how much of it is wanted, and how fast that is taken up again once refused.
_CURVATURE, _RECOVERY = 0.5, 1.3
# Of the damping: added where a pivot is not positive; and where a step was short.
_DAMPING_PIVOT, _DAMPING_STEP = 0.1, 0.05
_ROUGH_L2 = LeastSquaresOptions(iterations=30, tolerance=1e-5)


@dataclass
class _Iterate:
    """Poses and their linearisation; the splitting u, v of the residual, slacks s, t, dual y."""

    poses: Array
    system: LinearSystem
    u: Array
    v: Array
    s: Array
    t: Array
    y: Array

    @property
    def residual(self) -> Array:
        return -self.system.b

    @property
    def gap(self) -> float:
        return float(self.u @ self.s + self.v @ self.t)

    def is_solved(self, cost: float) -> bool:
        split = l1_cost(self.residual - self.u + self.v)
        return max(self.gap, split) < _TOLERANCE * cost


@dataclass(frozen=True)
class _Direction:
    """A step: of the poses, of the linearised residual, of the dual, of u and v."""

    x: Array
    residual: Array
    y: Array
    u: Array
    v: Array

    def longest(self, at: _Iterate) -> tuple[float, float]:
        """Return how far primal and dual can go before a bound, 1 at most."""
        primal = min(_to_bound(at.u, self.u), _to_bound(at.v, self.v))
        return primal, min(_to_bound(at.s, -self.y), _to_bound(at.t, self.y))


class _Regularisation:
    """How much curvature kappa and damping D the next factorisation gets."""

    def __init__(self) -> None:
        self._kappa, self._damping = _CURVATURE, 0.0

    def factorise(self, graph: FactorGraph, at: _Iterate, H: csc_array) -> SuperLU:
        """Factor H with curvature; take less of that while a pivot is not positive."""
        C = _curvature(graph, at.poses, at.y)
        kappa, damping = self._kappa, self._damping
        for shares in (0.5, 0.5, 0.0, None):
            factor = factorise(
                (H + kappa * C + diagonal(np.full(H.shape[0], damping))).tocsc())
            if shares is None or (factor.U.diagonal() > 0).all():
                break
            kappa, damping = shares * kappa, max(damping, _DAMPING_PIVOT)
        clean = kappa == self._kappa
        recovered = min(_CURVATURE, _RECOVERY * max(kappa, _CURVATURE / 10))
        self._kappa = recovered if clean else kappa
        return factor

    def learn(self, length: float) -> None:
        """Damp more after a short step, less after a long one."""
        if length < 0.1:
            self._damping = max(4 * self._damping, _DAMPING_STEP)
        elif length > 0.3:
            self._damping /= 4


def minimise_interior_point(
    graph: FactorGraph,
    poses: Array,
    options: OptimiserOptions,
    report: Report = lambda iteration, cost: None,
) -> Solution:
    """
    Minimise the L1 norm of the whitened residuals in `options.outer_iterations` steps at most.

    From poses (n, p), or from the L2 map that they lead to if its L1 cost is lower: from the seed
    it is not (and false loops would bend it), from raw odometry it is. The result is the best
    poses met, never worse than the start.
    """
    residual = whitened_residual(graph, poses)
    history = [l1_cost(residual)]
    if fits_exactly(history[0], len(residual)):
        return _solution(graph, poses, history, Status.CONVERGED, None)
    at = _start(graph, _better_start(graph, poses, history[0]))
    best, best_cost = poses, history[0]
    regularisation, status = _Regularisation(), Status.ITERATION_LIMIT
    for step in range(options.outer_iterations):
        cost = l1_cost(at.residual)
        if cost < best_cost:
            best, best_cost = at.poses, cost
        history.append(best_cost)
        report(step, best_cost)
        if at.is_solved(cost):
            status = Status.CONVERGED if cost <= best_cost else Status.STALLED
            break
        try:
            _step(graph, at, regularisation)
        except GraphError:
            status = Status.STALLED
            break
    return _solution(graph, best, history, status, at)


def _solution(graph: FactorGraph, poses: Array, history: list[float], status: Status,
              at: _Iterate | None) -> Solution:
    dual = np.zeros(len(whitened_residual(graph, poses))) if at is None else at.y
    gap = 0.0 if at is None else at.gap
    return Solution(poses, history[-1], status, len(history) - 1, 0, np.array(history), dual, gap)


def _better_start(graph: FactorGraph, poses: Array, cost: float) -> Array:
    rough = minimise_l2(graph, poses, _ROUGH_L2).poses
    return rough if l1_cost(whitened_residual(graph, rough)) < cost else poses


def _start(graph: FactorGraph, poses: Array) -> _Iterate:
    """Return the point of the central path of mu = mean |e| for the residual as it is."""
    system = linearise(graph, poses)
    e = -system.b
    mu = smoothing(e)
    root = np.hypot(mu, e)
    large = (mu + root + np.abs(e)) / 2
    small = mu * (mu + root) / (2 * large)  # (mu + root - |e|) / 2 would cancel
    u, v = np.where(e >= 0, large, small), np.where(e >= 0, small, large)
    return _Iterate(poses, system, u, v, mu / u, mu / v, e / (mu + root))


def _step(graph: FactorGraph, at: _Iterate, regularisation: _Regularisation) -> None:
    """Move `at` by one predictor and corrector step."""
    A, n = at.system.A, len(at.y)
    Q = 1 / (at.u / at.s + at.v / at.t)
    factor = regularisation.factorise(graph, at, (A.T @ (diagonal(Q) @ A)).tocsc())
    predictor = _direction(at, factor, Q, np.zeros(n), np.zeros(n))
    primal, dual = predictor.longest(at)
    reached = float((at.u + primal * predictor.u) @ (at.s - dual * predictor.y)
                    + (at.v + primal * predictor.v) @ (at.t + dual * predictor.y))
    mu = at.gap / (2 * n) * (reached / at.gap) ** 3
    corrector = _direction(at, factor, Q, mu + predictor.u * predictor.y,
                           mu - predictor.v * predictor.y)
    primal, dual = corrector.longest(at)
    primal, poses = _trusted(graph, at, corrector, primal)
    regularisation.learn(primal)
    at.poses, at.system = poses, linearise(graph, poses)
    at.u, at.v = at.u + primal * corrector.u, at.v + primal * corrector.v
    at.y = at.y + dual * corrector.y
    at.s = np.maximum(at.s - dual * corrector.y, _SMALLEST_SLACK)
    at.t = np.maximum(at.t + dual * corrector.y, _SMALLEST_SLACK)


def _direction(at: _Iterate, factor: SuperLU, Q: Array, c1: Array, c2: Array) -> _Direction:
    """Solve for the step whose complementarity products become c1, c2 to first order."""
    A = at.system.A
    g = at.residual - (at.u - at.v) - (c1 / at.s - at.u) + (c2 / at.t - at.v)
    x = factor.solve(-(A.T @ (at.y + Q * g)))
    residual = A @ x
    y = Q * (residual + g)
    return _Direction(x, residual, y, (c1 + at.u * y) / at.s - at.u,
                      (c2 - at.v * y) / at.t - at.v)


def _trusted(graph: FactorGraph, at: _Iterate, direction: _Direction,
             length: float) -> tuple[float, Array]:
    """Halve the primal step while the residual departs too far from its linearisation."""
    while True:
        poses = step_poses(graph, at.poses, length * direction.x)
        linear = at.residual + length * direction.residual
        departure = l1_cost(whitened_residual(graph, poses) - linear)
        if departure <= _DEPARTURE * at.gap or length < _SHORTEST:
            return length, poses
        length /= 2


def _to_bound(value: Array, step: Array) -> float:
    shrinks = step < 0
    if not shrinks.any():
        return 1.0
    return min(1.0, _FRACTION * float(np.min(-value[shrinks] / step[shrinks])))


def _curvature(graph: FactorGraph, poses: Array, y: Array) -> csc_array:
    """Return C = sum y d2e over the between factors, (columns, columns)."""
    manifold, factors, d = graph.manifold, graph.between, graph.manifold.TANGENT_SIZE
    rows = y[: len(factors) * d].reshape(-1, d, 1)
    dual = (factors.sqrt_information.transpose(0, 2, 1) @ rows)[..., 0]
    H = manifold.residual_curvature(
        factors.measurement, poses[factors.i], poses[factors.j], dual)
    keyframe = np.stack((factors.i, factors.j), axis=1) - anchor(graph)
    column = (keyframe[:, :, None] * d + np.arange(d)).reshape(-1, 2 * d)
    row, column = (np.broadcast_to(c, H.shape) for c in (column[:, :, None], column[:, None, :]))
    keep = (H != 0) & (row >= 0) & (column >= 0)
    n = (graph.n_poses - anchor(graph)) * d
    return coo_array((H[keep], (row[keep], column[keep])), shape=(n, n)).tocsc()
