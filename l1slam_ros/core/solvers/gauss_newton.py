# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Gauss-Newton for L2 and Huber, on the same linearisation as the L1 solvers.

In: a graph and poses. Out: poses of lower cost. Both solve sparse normal equations. A step that
brings less than half of what it promised is shortened to the lowest point of a parabola, or its
rotations alone are taken and the translations that suit them; Marquardt's damping is added only
when neither lowers the cost.
"""

from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import (
    LinearSystem,
    anchor,
    linearise,
    step_part,
    step_poses,
    whitened_residual,
)
from l1slam_ros.core.solvers.block_cholesky import (
    GROWN,
    VAST,
    BlockCholesky,
    Pattern,
    cholesky_of,
)
from l1slam_ros.core.solvers.nonlinear import Report, Solution
from l1slam_ros.core.solvers.optimality import (
    Huber,
    SmoothNorm,
    Status,
    fits_exactly,
    l1_cost,
)
from l1slam_ros.core.solvers.reweighting import weighted_least_squares

# Damping: the first, the least, the most, and as good as none. Slow bends of a chain feel even the
# least of it.
_FIRST_DAMPING = 1e-8
_LEAST_DAMPING = 3e-10
_MOST_DAMPING = 1e6
_HARDLY = 1e-6
# A map to within its noise: Gauss-Newton begins where chi2 is at most so many times what the noise
# makes of it, and takes so many steps at most.
FITS, _NOISE_STEPS = 3, 60
# Relative to chi2. The error of what a step promised is of first order in the way that is left,
# the rest of chi2 is of second order.
_SURPRISE = 0.1
# Part of what its linear problem promised that a step has to bring, else others are looked at; and
# of a last one, which is to say that little is left.
_BRINGS, _LAST = 0.5, 0.25
# Factorisations of one set of factors where they come and go.
_FEW = 4
# The least part of a step: where less is best, it goes the wrong way, and damping turns it.
_SHORTEST = 0.25


@dataclass(frozen=True)
class LeastSquaresOptions:
    """
    When Gauss-Newton stops.

    iterations : most linearisations; tolerance : converged when the cost fell by no more than this
    part of itself; huber_delta : length of a factor's whitened residual where Huber turns linear
    [sigmas]; surprise : converged, too, after an undamped step that lowered the cost by what its
    linear problem promised, to within this part of the cost: about as much is left.
    """

    iterations: int = 100
    tolerance: float = 1e-9
    huber_delta: float = 1.345
    surprise: float = 0.0


# As much as a start of an exact L1 map needs.
ROUGH_L2 = LeastSquaresOptions(iterations=30, tolerance=1e-3)


def minimise_l2(
    graph: FactorGraph,
    poses: Array,
    options: LeastSquaresOptions,
    cholesky: BlockCholesky,
    report: Report = lambda iteration, cost: None,
) -> Solution:
    """Minimise chi2, the sum of squared whitened residuals; arguments as `nonlinear.minimise`."""
    return gauss_newton(graph, poses, Huber(), options, cholesky, report)


def gauss_newton(
    graph: FactorGraph,
    poses: Array,
    norm: SmoothNorm,
    options: LeastSquaresOptions,
    cholesky: BlockCholesky,
    report: Report = lambda iteration, cost: None,
) -> Solution:
    """Minimise a norm, reweighted at each step; arguments as `nonlinear.minimise`."""
    return _descend(graph, _at(graph, poses, norm), norm, options, cholesky, report)[0]


@dataclass(frozen=True)
class _At:
    """Poses (n, p), the whitened residual (rows,) there, and its cost."""

    poses: Array
    residual: Array
    cost: float


def _at(graph: FactorGraph, poses: Array, norm: SmoothNorm) -> _At:
    residual = whitened_residual(graph, poses)
    return _At(poses, residual, norm.cost(residual))


def _descend(
    graph: FactorGraph,
    here: _At,
    norm: SmoothNorm,
    options: LeastSquaresOptions,
    cholesky: BlockCholesky,
    report: Report,
    surprise: float = 0.0,
) -> tuple[Solution, Array, LinearSystem | None]:
    """
    Return what `gauss_newton` does, the residual (rows,) and the system solved last, None: damped.

    surprise : stop after an undamped step whose decrease of the cost differs from that of its
    linear problem by no more than this
    """
    history = [here.cost]
    status = Status.ITERATION_LIMIT
    damping = 0.0
    solved = None
    while len(history) <= options.iterations:
        if fits_exactly(l1_cost(here.residual), len(here.residual)):
            status = Status.CONVERGED
            break
        little = options.tolerance * here.cost
        full = damping <= _HARDLY
        free = not damping
        there, predicted, solved = _stepped(graph, here, norm, cholesky, damping, little)
        decrease = here.cost - there.cost
        if decrease >= 0:
            here = there
            damping = damping / 10 if damping > _LEAST_DAMPING else 0.0
        else:
            damping = max(10 * damping, _FIRST_DAMPING)
        history.append(here.cost)
        report(len(history) - 1, here.cost)
        # By a step as good as undamped; at the optimum rounding may let the cost rise a little.
        if (full and abs(decrease) <= little and predicted <= max(little, decrease / _LAST)) or (
                free and abs(decrease - predicted) < max(
                    surprise, options.surprise * here.cost)):
            status = Status.CONVERGED
            break
        if damping > _MOST_DAMPING:
            status = Status.STALLED
            break
    return Solution(here.poses, here.cost, status, len(history) - 1, 0, np.array(history),
                    np.zeros(len(here.residual))), here.residual, solved


def _stepped(graph: FactorGraph, here: _At, norm: SmoothNorm, cholesky: BlockCholesky,
             damping: float, little: float) -> tuple[_At, float, LinearSystem | None]:
    """
    Return where a step leads, what it promised, and the system that was solved last, undamped.

    little : a promise of no more is not looked at any closer
    """
    system = linearise(graph, here.poses, here.residual)
    weights = norm.weights(here.residual)
    step = weighted_least_squares(system, cholesky, weights, damping)
    predicted = float((step * system.transposed_times(weights * system.b)).sum())
    there = _at(graph, step_poses(graph, here.poses, step), norm)
    translated = False
    is_short = here.cost - there.cost < _BRINGS * predicted
    if predicted > little and np.isfinite(there.cost) and is_short:
        there, translated = _nearer(graph, here, there, step, predicted, norm, cholesky)
    return there, predicted, None if damping or translated else system


def _nearer(graph: FactorGraph, here: _At, there: _At, step: Array, predicted: float,
            norm: SmoothNorm, cholesky: BlockCholesky) -> tuple[_At, bool]:
    """
    Return a better place than where a step led, or that, and whether another system was factored.

    The parabola through both costs that begins as promised is lowest after a part of the step. A
    long chain that is to bend goes along the tangent, and all its factors tear: given its
    rotations, its translations are a linear problem.
    """
    part = predicted / (2 * predicted - (here.cost - there.cost))
    best = there
    if part > _SHORTEST:
        shorter = _at(graph, step_poses(graph, here.poses, part * step), norm)
        best = shorter if shorter.cost < there.cost else there
    if here.cost - best.cost >= _BRINGS * predicted:
        return best, False
    entries, k = graph.manifold.TRANSLATION, graph.manifold.TANGENT_SIZE
    weights = norm.weights(there.residual).reshape(-1, k)[:, entries].ravel()
    system = linearise(graph, there.poses, there.residual).part(entries)
    step = weighted_least_squares(system, cholesky, weights)
    bent = _at(graph, step_part(graph, there.poses, step, entries), norm)
    return (bent if bent.cost < best.cost else best), True


@dataclass(frozen=True)
class ChangingOrder:
    """
    In which order a graph is eliminated whose factors come and go, for a few steps of each.

    rows : (k,) the numbers of the factors; pattern : of these; anew : how many there were when
    their order was last found without one before it
    """

    rows: Indices
    pattern: Pattern
    anew: int

    @classmethod
    def of(cls, graph: FactorGraph, rows: Indices,
           before: 'ChangingOrder | None') -> 'ChangingOrder':
        """Return the order of a graph; where finding one takes long, most of it stays."""
        if before and np.array_equal(rows, before.rows):
            return before
        k = graph.manifold.TANGENT_SIZE
        if before and len(rows) <= GROWN * before.anew and before.pattern.work * k**3 > VAST:
            return cls(rows, cholesky_of(graph, before.pattern, _FEW).pattern, before.anew)
        return cls(rows, cholesky_of(graph, None, _FEW).pattern, len(rows))


def l2_map(graph: FactorGraph, poses: Array, cholesky: BlockCholesky,
           report: Report = lambda iteration, cost: None) -> Array:
    """Return the L2 map of a graph to within its noise, (n, p); see `l2_optimum`."""
    return l2_optimum(graph, poses, cholesky, report)[0]


def l2_optimum(graph: FactorGraph, poses: Array, cholesky: BlockCholesky,
               report: Report) -> tuple[Array, Array, LinearSystem | None]:
    """
    Return the L2 map of a graph to within its noise: chi2 one above the optimum or less.

    From poses (n, p) that may be far off: where they do not fit to within the noise, first
    rotations alone, then translations, each of which is linear; then Gauss-Newton. And its
    whitened residual, (rows,), and the system of its last step, b what is left, which `cholesky`
    has factored; None: it was damped, or there was none.
    """
    free = spare(graph)
    start = _at(graph, poses, Huber())
    if start.cost > FITS * free:
        linear = _at(graph, _two_linear_steps(graph, poses, cholesky), Huber())
        start = linear if linear.cost < start.cost else start
    options = LeastSquaresOptions(_NOISE_STEPS, 1 / free)
    solution, residual, solved = _descend(graph, start, Huber(), options, cholesky, report,
                                          _SURPRISE)
    return solution.poses, residual, replace(solved, b=-residual) if solved else None


def spare(graph: FactorGraph) -> int:
    """Return how many measurements are spare; in units of its noise, chi2 is about as large."""
    k = graph.manifold.TANGENT_SIZE
    return max(int(graph.between.freedom.sum()) - k * (graph.n_poses - anchor(graph)), k)


def _two_linear_steps(graph: FactorGraph, poses: Array, cholesky: BlockCholesky) -> Array:
    for part in (graph.manifold.ROTATION, graph.manifold.TRANSLATION):
        poses = linear_step(graph, poses, cholesky, part)
    return poses


def linear_step(graph: FactorGraph, poses: Array, cholesky: BlockCholesky, part: slice) -> Array:
    """Return poses (n, p) after one least squares step of their rotations or translations."""
    system = linearise(graph, poses).part(part)
    x = weighted_least_squares(system, cholesky, np.ones_like(system.b))
    return step_part(graph, poses, x, part)
