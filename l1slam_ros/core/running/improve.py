# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The numerical work behind updates: a better map of a snapshot, and a front that continues from it.

In: a `Problem`. Out: an `Improvement`, to be adopted, and its `Front`. This module uses no threads
or locks; to stop the work, a caller passes a check that raises.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.bordered.front import Front
from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import (
    anchor,
    keyframes_of,
    linearise,
    whitened_residual,
)
from l1slam_ros.core.graph.world_frame import placed
from l1slam_ros.core.robust.batch import minimise_robustly
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.running.optimised import Optimised
from l1slam_ros.core.running.problem import Problem, on_ties
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.nonlinear import (
    OptimiserOptions,
    Solution,
    backtrack,
    is_far,
    minimise,
)
from l1slam_ros.core.solvers.optimality import (
    Status,
    fits_exactly,
    l1_cost,
    l2_cost,
    smoothing,
)
from l1slam_ros.core.solvers.reweighting import (
    reweighted_start,
    warm_step,
    weighted_least_squares,
)
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import AUTO, choose, minimise_by

# Where the weights of reweighted steps turn over, in mean |e|: at first, from one to the next, and
# at last.
_SMOOTHING = 0.1
_SHARPER = 0.3
_SHARPEST = 1e-2
# Linearisations of one round, and iterations of one linearisation where there is a front: with
# more, the map comes too late.
_OUTER, _INNER = 2, 120
# Gauss-Newton steps for the least squares map of the gate, each time it is made.
_L2_STEPS = 4

# A function that is called often and raises `Interrupted` if the work is to stop.
Check = Callable[[], None]


@dataclass(frozen=True)
class Improvement:
    """
    The result of one update: poses (n, p), dual (rows,), judgement, and statistics.

    map : of the `Problem`; cost_before, cost : L1 cost of the accepted factors;
    reweighted_steps : factorisations for the long-range part; outer, inner : iterations of
    Algorithm 4; gap : of its last linear problem; seconds : all of it.
    """

    map: int
    poses: Array
    dual: Array
    judgement: Judgement
    cost_before: float
    cost: float
    status: Status
    reweighted_steps: int
    outer_iterations: int
    inner_iterations: int
    gap: float
    seconds: float

    def taken_over(self, before: Optimised, tolerance: float) -> Optimised:
        """
        Return the solution that the back end keeps; tolerance : see `OptimiserOptions`.

        Raises
        ------
        ArithmeticError : it is not finite.

        """
        for name in ('poses', 'dual', 'cost'):
            if not np.isfinite(getattr(self, name)).all():
                raise ArithmeticError(f'the {name} of a new map is not finite; the map stays')
        same = len(self.dual) == len(before.dual)
        quiet = same and self.cost_before - self.cost <= tolerance * self.cost
        return Optimised(self.poses, self.dual, self.cost, self.status,
                         before.quiet_updates + 1 if quiet else 0)

    def of_all(self, problem: Problem) -> 'Improvement':
        """Convert a result for `as_one(problem)` to one for the factors of the problem."""
        graph = problem.graph
        rows = graph.not_struck
        d = graph.manifold.TANGENT_SIZE
        dual = np.zeros((len(graph.between), d))
        dual[rows] = self.dual.reshape(-1, d)[:len(rows)]
        return replace(self, dual=dual.ravel(), judgement=self.judgement.of_all(graph))

    @property
    def falls(self) -> bool:
        """Whether another round is worth it: the cost was still falling when iterations ended."""
        return (self.status not in (Status.CONVERGED, Status.STALLED)
                and is_far(self.cost_before, self.cost))


def improve(problem: Problem, options: OptimiserOptions, budget: float,
            check: Check = lambda: None, exact: bool = False) -> Improvement:
    """
    Lower the L1 cost of the accepted factors of a snapshot, for about `budget` seconds.

    exact : solve to the optimum instead, where a factorisation does that

    A round has two parts. First, iteratively reweighted least squares, warm from the kept dual:
    one factorisation bends the whole chain, where a first-order method moves a few keyframes an
    iteration. One step is always taken; more while the cost is far above what the last map left,
    as after a long loop has closed, and falls. If such a step does not lower the cost, the loop's
    residual is all in one factor, a corner of the L1 norm: the path from least squares to L1 leads
    out of it. Second, Algorithm 4 from the kept dual.
    """
    start = time.monotonic()
    graph = problem.part
    method = problem.method
    deadline = start + budget
    poses, residual, before = _nearest(problem)
    if exact and problem.is_sparse:
        solution, _ = minimise_by(method, graph, poses, options, lambda *_: check())
        return _improvement(solution, problem, problem.judgement, before, 0, start)
    dual = _dual_of(problem, residual)
    cost = l1_cost(residual)
    exactly = fits_exactly(cost, len(dual))
    steps = 0
    far = not exactly and is_far(cost, problem.last_cost)
    mu = _SMOOTHING if far else _SHARPEST
    while method.cholesky and not exactly and (
            not steps or (far and time.monotonic() < deadline)):
        check()
        system = linearise(graph, poses, residual)
        try:
            step = warm_step(system, method.cholesky, dual, mu * smoothing(system.b))
            moved, after = backtrack(graph, poses, residual, step)
            if far and moved is poses:
                step, dual = reweighted_start(system, method.cholesky, check)
                moved, after = backtrack(graph, poses, residual, step)
        except GraphError:  # sharper weights are beyond double precision
            break
        previous = cost
        poses = moved
        residual = after
        cost = l1_cost(after)
        steps = steps + 1
        mu = max(_SHARPER * mu, _SHARPEST)
        far = is_far(previous, cost)
    solution = minimise(graph, poses, options, method.cholesky if steps else None, dual, deadline,
                        lambda *_: check())
    return _improvement(solution, problem, problem.judgement, before, steps, start)


def one_round(options: OptimiserOptions, sparse: bool) -> OptimiserOptions:
    """Return the options for one round of a map; sparse : there is to be a front."""
    if not sparse:
        return replace(options, outer_iterations=min(options.outer_iterations, _OUTER))
    inner = replace(options.inner, iterations=min(options.inner.iterations, _INNER))
    return replace(options, outer_iterations=min(options.outer_iterations, 1), inner=inner)


def _nearest(problem: Problem) -> tuple[Array, Array, float]:
    """Return the best poses to start from, their residual, and the cost of the present map."""
    graph, starts = problem.part, problem.starts
    if graph.between.is_absolute.any():
        # The map may not have been moved to its absolute poses yet.
        starts = [*starts, placed(graph, problem.poses)]
    return _best(graph, starts, l1_cost)


def _best(graph: FactorGraph, starts: list[Array],
          cost_of: Callable[[Array], float]) -> tuple[Array, Array, float]:
    """Return the best of some poses, their residual, and the cost of the first ones."""
    residuals = [whitened_residual(graph, poses) for poses in starts]
    costs = [cost_of(residual) for residual in residuals]
    best = costs.index(min(costs))
    return starts[best], residuals[best], costs[0]


def _dual_of(problem: Problem, e: Array) -> Array:
    """Return the dual to start from, (rows,): the kept one, or one computed from the residual."""
    dual = problem.dual.reshape(-1, problem.graph.manifold.TANGENT_SIZE)
    kept = dual[problem.judgement.accepted]
    asked = (e / np.hypot(e, smoothing(e))).reshape(kept.shape)
    known = kept.any(axis=1, keepdims=True)
    return np.where(known, kept, asked).ravel()


def front_of(problem: Problem, poses: Array, rows: int,
             check: Check = lambda: None) -> Front | None:
    """
    Return the front of a map, poses (n, p), which takes the factors from `rows` on.

    None: the graph is too dense to be factored in the time of an update, or some keyframe is not
    tied to the others.
    """
    judgement = problem.judgement
    method = problem.method
    part = problem.part
    if not problem.is_sparse or method.cholesky is None:
        return None
    loops = ~problem.graph.between.is_odometry
    refused, believed = (np.count_nonzero(loops & (judgement.accepted == accepted))
                         for accepted in (False, True))
    log_odds = max(0.0, float(np.log((refused + 1) / (believed + 1))))
    variance = judgement.found_variance(problem.graph)
    found = part.subset(np.arange(len(variance)), variance)
    starts = [poses, *problem.starts[1:]]
    l2_poses, residual, _ = _best(found, starts, l2_cost)
    cholesky = BlockCholesky(method.cholesky.pattern, keyframes_of(found, anchor(found)))
    try:
        for _ in range(_L2_STEPS):
            check()
            system = linearise(found, l2_poses, residual)
            step = weighted_least_squares(system, cholesky, np.ones_like(system.b))
            # The NIS holds at the minimum of chi2; a chi2 that is higher by one is near enough.
            if step @ system.transposed_times(system.b) <= 1:
                break
            l2_poses, residual = backtrack(found, l2_poses, residual, step, l2_cost)
        check()
        return Front(part, (poses, l2_poses), (method.cholesky, cholesky), judgement.variance,
                     log_odds, rows, judgement.drift)
    except GraphError:
        return None


def optimise(problem: Problem, options: OptimiserOptions,
             check: Check = lambda: None) -> Improvement:
    """
    Solve a snapshot to the optimum; with judged loops, after judging all of them anew.

    Otherwise it is solved from its own poses and from the seed, and the lower result is taken.
    """
    start = time.monotonic()
    graph, judgement = problem.graph, problem.judgement
    if problem.robust:
        found = minimise_robustly(
            graph, lambda part, poses: _solved(part, poses, options, check), check=check,
            known=(judgement, problem.poses))
        solution, judgement = found.solution, found.judgement
    else:
        starts = (problem.poses, seed_poses(graph, choose(AUTO, graph).cholesky, check=check))
        solution = min((_solved(graph, poses, options, check) for poses in starts),
                       key=lambda s: s.cost)
    part = judgement.believed(graph)
    before = l1_cost(whitened_residual(part, problem.poses))
    return _improvement(solution, problem, judgement, before, 0, start)


def _solved(graph: FactorGraph, poses: Array, options: OptimiserOptions,
            check: Check) -> Solution:
    check()
    method = choose(AUTO, graph, options.norm, options.loop_norm)
    return minimise_by(method, graph, poses, options, lambda *_: check())[0]


def _improvement(solution: Solution, problem: Problem, judgement: Judgement, before: float,
                 steps: int, start: float) -> Improvement:
    accepted = judgement.accepted
    cost = solution.cost
    gap = solution.gap
    poses = on_ties(problem, judgement, solution.poses)
    if poses is not solution.poses:
        cost = l1_cost(whitened_residual(judgement.believed(problem.graph), poses))
        gap += cost - solution.cost  # the bound stays
    # Factors that are not accepted have no dual yet.
    dual = np.zeros((len(accepted), problem.graph.manifold.TANGENT_SIZE))
    dual[accepted] = solution.dual.reshape(-1, dual.shape[1])
    return Improvement(problem.map, poses, dual.ravel(), judgement, before, cost, solution.status,
                       steps, solution.outer_iterations, solution.inner_iterations, gap,
                       time.monotonic() - start)
