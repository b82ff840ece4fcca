# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The exact L1 map by one nonlinear primal-dual interior-point run (Mehrotra's method).

In: a graph and poses near the map. Out: poses at a local optimum. Where Algorithm 4 solves many
linear problems one after the other, this relinearises at every step of a single solve. With
e(x) = u - v, u, v >= 0 and the slacks s = 1 - y, t = 1 + y of the dual's box:

    minimise sum(u + v)    so that    u s = mu, v t = mu, J'y = 0,    mu -> 0.

A step solves (J'QJ + kappa C) dx = -J'(y + Q g), Q = 1 / (u/s + v/t), where C = sum y d2e is the
curvature of the residuals: without it the run fails where a map bends easily (Manhattan). Nothing
else holds a step back: damping would keep a long way from bending while mu goes to zero, so that
it ended 9% above the optimum of a square that closes after 3,000 keyframes.

It costs one sparse factorisation a step, some twenty in all: cheap on sparse graphs, hopeless on
dense ones. It is local: from a start far off it can return that start, which its status tells.

The same run solves a linear problem (the two of Algorithm 3): one whose linearisation is exact.

Source: Mehrotra (1992) for the predictor and corrector, which fail where bounds leave the
predictor hardly a step (Cartis, "Some disadvantages of a Mehrotra-type primal-dual corrector
interior point algorithm", 2009); Gondzio, "Multiple centrality corrections in a primal-dual method
for linear programming" (1996), for what keeps bounds further off; the rest is ours, defended by
`test_interior_point.py`.
"""

from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.l1_problem import L1Problem
from l1slam_ros.core.graph.linear_system import LinearSystem
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.nonlinear import Report
from l1slam_ros.core.solvers.optimality import Status, fits_exactly, l1_cost, smoothing

# Fraction of the way to the nearest bound that a step may go.
_FRACTION = 0.9995
# A step that the bounds cut to less is followed by a centring step, which only leaves the bounds.
_SHORT = 0.1
# One that goes further is not corrected once more: on 113 drawn graphs that saved nothing.
_FAR = 0.9
# Slacks are kept above this and never recomputed as 1 -+ y, which would cancel.
_SMALLEST_SLACK = 1e-15
# A step is shortened while the residual departs from its linearisation by more than this part of
# the gap, but not below the last number.
_DEPARTURE, _SHORTEST = 0.5, 1e-4
# Products u s and v t shall end within this part of mu and its inverse.
_ALIKE = 0.1
# Of more rows, what is left to second order is taken for no more than the mean of the products: a
# few places that bounds hold fast, where it is most of all, would rule the step of all others.
# Below, where a step goes further, that costs one more of them on City and sphere2500.
_MANY_ROWS = 100_000
# Of the curvature: how much of it is wanted; once refused, what is tried at once (a try that is
# refused takes as long as any, for it fails at its end) and the next time; and how fast it is
# taken up again.
_CURVATURE = 0.7
_REFUSED = 0.25
_NEXT = 0.5
_RECOVERY = 1.3
# Part of its diagonal that J'QJ gets where rounding leaves it indefinite: ten times what is taken
# for rounding there, and so many times more each time that it is so again.
_ROUNDING, _MORE = 1e-12, 100.0
# What the complementarity products u s and v t shall become, (rows,) each.
_Products = tuple[Array, Array]
# u, v, s, t, Q, e, y of `native.interior_point`, (rows,) each.
_State = tuple[Array, Array, Array, Array, Array, Array, Array]


@dataclass
class _Iterate:
    """
    Poses and their linearisation; the splitting u, v of the residual, slacks s, t, dual y.

    is_torn : whether a step was refused.
    """

    poses: Array
    system: LinearSystem
    u: Array
    v: Array
    s: Array
    t: Array
    y: Array
    is_torn: bool = False

    @property
    def residual(self) -> Array:
        return self.system.residual

    @property
    def bounded(self) -> tuple[Array, Array, Array, Array]:
        """The variables that must stay positive: u, v, s, t."""
        return self.u, self.v, self.s, self.t

    def advance(self, direction: '_Direction', primal: float) -> None:
        """Go along a direction, u and v so far; the slacks stay positive."""
        native.interior_point.advance(
            *self.bounded, self.y, *direction.products, direction.y, primal, direction.dual,
            _SMALLEST_SLACK)


@dataclass(frozen=True)
class Optimum:
    """
    The result of a run: the best poses found, never worse than the start.

    costs : (steps + 1,) the lowest so far; end : the last iterate, linearised at the best, for
    `prove`.
    """

    poses: Array
    costs: list[float]
    status: Status
    end: _Iterate


@dataclass(frozen=True)
class _Direction:
    """
    A step of the poses, of the linearised residual, of y; u and v follow from it.

    products : what u s and v t shall become; primal, dual : how far it can go; gap : u's + v't
    there
    """

    x: Array
    residual: Array
    y: Array
    products: _Products
    primal: float
    dual: float
    gap: float

    @property
    def reach(self) -> float:
        """The shorter of both lengths."""
        return min(self.primal, self.dual)


class Curvature:
    """How much curvature kappa the next factorisation gets."""

    def __init__(self) -> None:
        self._kappa, self._rounding = _CURVATURE, _ROUNDING

    def factorise(self, system: LinearSystem, weights: Array, C: Array | None,
                  cholesky: BlockCholesky) -> bool:
        """Factor J'QJ + kappa C, with less of C while it is not definite; False: it never is."""
        wanted = self._kappa
        self._kappa = _NEXT * self._kappa
        for share in (1.0, _REFUSED, 0.0):
            if cholesky.factorise(system, weights, 0.0, C, share * wanted):
                if share == 1:
                    self._kappa = min(_CURVATURE, _RECOVERY * max(wanted, _CURVATURE / 10))
                self._rounding = _ROUNDING
                return True
        added = self._rounding * system.diagonal(weights)
        self._rounding *= _MORE
        return cholesky.factorise(system, weights, added)


def interior_point(
    problem: L1Problem, poses: Array, cholesky: BlockCholesky, iterations: int, tolerance: float,
    report: Report = lambda iteration, cost: None,
) -> Optimum:
    """
    Minimise the L1 norm of a problem's residual from poses.

    Parameters
    ----------
    cholesky : for the problem's factors
    iterations : most steps
    tolerance : converged when both the complementarity gap u's + v't and |e - u + v|_1 are below
        this part of the cost

    """
    at = _start(problem, poses)
    costs = [l1_cost(at.residual)]
    # A step writes into u, v, s, t, y; poses and system it makes anew.
    best = at.poses, at.system
    curvature = Curvature()
    status = Status.ITERATION_LIMIT
    worst = 1 + tolerance
    for iteration in range(iterations + 1):
        cost = l1_cost(at.residual)
        gap, apart = native.interior_point.missing(*at.bounded, at.residual)
        small = tolerance * cost
        if (gap <= small and apart <= small) or fits_exactly(cost, len(at.y)):
            status = Status.CONVERGED if cost <= worst * costs[-1] else Status.STALLED
        if cost <= costs[-1]:
            best = at.poses, at.system
        if iteration:
            costs.append(min(cost, costs[-1]))
            report(iteration, costs[-1])
        if status is not Status.ITERATION_LIMIT or iteration == iterations:
            break
        if not _step(problem, at, cholesky, curvature):
            status = Status.STALLED
            break
    poses, system = best
    return Optimum(poses, costs, status, replace(at, system=system))


def _start(problem: L1Problem, poses: Array) -> _Iterate:
    """Return the point of the central path of mu = mean |e| for the residual as it is."""
    e = problem.residual(poses)
    system = problem.linearise(poses, e)
    return _Iterate(poses, system, *native.interior_point.begin(e, smoothing(e)))


def _step(problem: L1Problem, at: _Iterate, cholesky: BlockCholesky, curvature: Curvature) -> bool:
    """
    Move `at` by one affine and one combined step; False: there was no direction.

    They have the names that Clarabel and others give them: the affine step aims at mu = 0, and how
    far it comes says how far the combined step aims.
    """
    Q, gap = native.interior_point.weigh(*at.bounded)
    if not curvature.factorise(at.system, Q, problem.curvature(at.poses, at.y), cholesky):
        return False
    combined = _direction(at, cholesky, Q, gap)
    if not np.isfinite(combined.x).all():
        return False
    primal, at.poses, residual = _line_search(problem, at, combined, _DEPARTURE * gap)
    at.system = problem.linearise(at.poses, residual)
    at.advance(combined, primal)
    return True


def _direction(at: _Iterate, cholesky: BlockCholesky, Q: Array, gap: float) -> _Direction:
    """Return the combined step by the last factorisation; gap : u's + v't."""
    state = (*at.bounded, Q, at.residual, at.y)
    mean = gap / (2 * len(at.y))
    affine = _aimed(state, at, cholesky, 0.0)
    mu = mean * (affine.gap / gap) ** 3
    # Mehrotra's corrector.
    most = mean if len(at.y) > _MANY_ROWS else np.inf
    c1, c2, pull = native.interior_point.aim_combined(*state, affine.y, mu, most)
    combined = _solve_kkt(state, at, cholesky, (c1, c2), pull)
    # Else nothing is to be won, or bends hold a step back rather than bounds.
    if combined.reach < _FAR and not at.is_torn:
        # Gondzio's.
        c1, c2, pull = native.interior_point.aim_centrally(
            *state, combined.y, c1, c2, _ALIKE * mu, mu / _ALIKE)
        corrected = _solve_kkt(state, at, cholesky, (c1, c2), pull)
        combined = max(combined, corrected, key=lambda step: step.reach)
    if combined.reach < _SHORT:
        # Some products u s and v t are far smaller than others: first make them equal.
        centring = _aimed(state, at, cholesky, mean)
        combined = max(combined, centring, key=lambda step: step.reach)
    return combined


def _aimed(state: _State, at: _Iterate, cholesky: BlockCholesky,
           product: float) -> _Direction:
    """Return the step by which all products become one number."""
    products = np.full_like(at.y, product)
    pull = native.interior_point.aim(*state, products, products)
    return _solve_kkt(state, at, cholesky, (products, products), pull)


def _solve_kkt(state: _State, at: _Iterate, cholesky: BlockCholesky,
               products: _Products, pull: Array) -> _Direction:
    """Solve for the step whose complementarity products become these to first order."""
    x = cholesky.solve(at.system.transposed_times(pull))
    moved = at.system.times(x)
    y, primal, dual, gap = native.interior_point.complete(*state, *products, moved, _FRACTION)
    return _Direction(x, moved, y, products, primal, dual, gap)


def _line_search(problem: L1Problem, at: _Iterate, direction: _Direction,
                 allowed: float) -> tuple[float, Array, Array]:
    """
    Halve the primal step while the residual departs further from its linearisation than allowed.

    Each pose moves by itself, until such a step is refused for once: to second order that tears a
    long way. From then on poses may move along the way as well, whichever costs less.
    """
    length = direction.primal
    while True:
        best = np.inf
        for step in problem.step, problem.step_along:
            moved = step(at.poses, length * direction.x)
            after = problem.residual(moved)
            cost, apart = native.interior_point.depart(
                after, at.residual, direction.residual, length)
            if not cost > best:
                best = cost
                poses = moved
                residual = after
                departure = apart
            if not at.is_torn and departure <= allowed:
                break
            at.is_torn = True
        if departure <= allowed or length < _SHORTEST:
            return length, poses, residual
        length /= 2
