# SPDX-License-Identifier: Apache-2.0
"""
What an update computes: a better map, of a snapshot of the back end.

In: a `Problem`. Out: an `Improvement`, to be adopted. Nothing here knows of threads or locks; who
may have to stop the work hands in a check.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import linearise, whitened_residual
from l1slam_ros.core.graph.world_frame import placed
from l1slam_ros.core.online.snapshot import Optimised, Problem
from l1slam_ros.core.robust.batch import judge
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.robust.robust_map import minimise_robustly
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.nonlinear import (
    OptimiserOptions,
    Solution,
    backtrack,
    is_far,
    minimise,
)
from l1slam_ros.core.solvers.optimality import Status, l1_cost, smoothing
from l1slam_ros.core.solvers.reweighting import reweighted_step
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import AUTO, choose, minimise_by

# Called on the way, often; raises where the work shall stop.
Check = Callable[[], None]


@dataclass(frozen=True)
class Improvement:
    """
    What one update did: new poses (n, p), dual (rows,) and judgement, and the account of it.

    map, robust : of the `Problem`; cost_before, cost : L1 cost of the accepted factors;
    reweighted_steps : factorisations for the long-range part; outer, inner : iterations of
    Algorithm 4; gap : of its last linear problem; seconds : all of it.
    """

    map: int
    poses: Array
    dual: Array
    judgement: Judgement
    robust: bool
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
        Return what the back end has after it; tolerance : see `OptimiserOptions`.

        Raises
        ------
        ArithmeticError : it is not finite.

        """
        for name in ('poses', 'dual', 'cost'):
            if not np.isfinite(getattr(self, name)).all():
                raise ArithmeticError(f'the {name} of a new map is not finite; the map stays')
        quiet = (self.judgement.settled and len(self.dual) == len(before.dual)
                 and self.cost_before - self.cost <= tolerance * self.cost)
        return Optimised(self.poses, self.dual, self.judgement, self.cost, self.status,
                         before.quiet_updates + 1 if quiet else 0)


def improve(problem: Problem, options: OptimiserOptions, budget: float,
            check: Check = lambda: None) -> Improvement:
    """
    Judge the loops that have come and lower the L1 cost of a snapshot, for about `budget` seconds.

    While the cost is far above what the last update left (a loop has closed), reweighted least
    squares steps carry the long-range part: one factorisation bends the whole chain, where a
    first-order method moves it a few keyframes per iteration. Then, always, Algorithm 4 from the
    kept dual.
    """
    start = time.monotonic()
    deadline = start + budget
    judgement, starts = problem.judgement, [problem.poses]
    if not judgement.settled:
        judgement, judged = judge(problem.graph, problem.poses, judgement, deadline, check)
        # After a loop has closed, the L2 map of the judgement is nearer.
        starts.append(judged)
    check()
    graph = problem.graph.subset(judgement.accepted)
    if graph.between.is_absolute.any():
        # Or the map has not come to the world yet.
        starts.append(placed(graph, problem.poses))
    size = graph.manifold.TANGENT_SIZE
    dual = problem.dual.reshape(-1, size)[judgement.accepted].ravel()
    costs = [l1_cost(whitened_residual(graph, poses)) for poses in starts]
    before, cost = costs[0], min(costs)
    poses = starts[costs.index(cost)]
    steps, far = 0, is_far(cost, problem.last_cost)
    cholesky = cholesky_of(graph) if far else None
    while cholesky and far and (not steps or time.monotonic() < deadline):
        check()
        system = linearise(graph, poses)
        step, dual = reweighted_step(system, cholesky, system.b, smoothing(system.b))
        previous = cost
        poses, cost = backtrack(graph, poses, step, cost)
        steps += 1
        far = is_far(previous, cost)
    solution = minimise(graph, poses, options, cholesky, dual, deadline, lambda *_: check())
    return _improvement(solution, problem, judgement, before, steps, start)


def optimise(problem: Problem, options: OptimiserOptions,
             check: Check = lambda: None) -> Improvement:
    """
    Solve a snapshot to the end; where loops are doubted, after judging all of them anew.

    Else from its own poses and from the seed, whichever ends lower.
    """
    start = time.monotonic()
    graph, judgement = problem.graph, problem.judgement
    if problem.robust:
        found = minimise_robustly(
            graph, lambda part, poses: _solved(part, poses, options, check), check=check)
        solution, judgement = found.solution, found.judgement
    else:
        starts = (problem.poses, seed_poses(graph, choose(AUTO, graph).cholesky, check=check))
        solution = min((_solved(graph, poses, options, check) for poses in starts),
                       key=lambda s: s.cost)
    part = graph.subset(judgement.accepted)
    before = l1_cost(whitened_residual(part, problem.poses))
    return _improvement(solution, problem, judgement, before, 0, start)


def _solved(graph: FactorGraph, poses: Array, options: OptimiserOptions,
            check: Check) -> Solution:
    check()
    return minimise_by(choose(AUTO, graph), graph, poses, options, lambda *_: check())[0]


def _improvement(solution: Solution, problem: Problem, judgement: Judgement, before: float,
                 steps: int, start: float) -> Improvement:
    accepted = judgement.accepted
    # The rows of what is not believed have no dual yet.
    dual = np.zeros((len(accepted), problem.graph.manifold.TANGENT_SIZE))
    dual[accepted] = solution.dual.reshape(-1, dual.shape[1])
    return Improvement(problem.map, solution.poses, dual.ravel(), judgement, problem.robust,
                       before, solution.cost, solution.status, steps, solution.outer_iterations,
                       solution.inner_iterations, solution.gap, time.monotonic() - start)
