# SPDX-License-Identifier: Apache-2.0
"""
The incremental back end: samples and loops in, optimised poses out.

`Backend` owns the growing graph, the poses and the dual. An update is three calls, so that a
caller with threads need hold its lock for two short moments only, `snapshot` and `adopt`:

    problem = backend.snapshot().problem()
    improvement = improve(problem, options, budget)     # the work; touches nothing of the backend
    backend.adopt(improvement)                          # poses and dual for the next warm start
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import linearise, whitened_residual
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.online.graph_builder import GraphBuilder, GraphBuilderOptions
from l1slam_ros.core.online.loop_states import LoopStates
from l1slam_ros.core.online.snapshot import Problem, Snapshot
from l1slam_ros.core.options import Options, option
from l1slam_ros.core.robust.batch import Doubt
from l1slam_ros.core.robust.judgement import Belief, judge
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

# A large map gets but one linearisation into an update, and never meets a test that takes two of
# them. It is at rest when so many updates in a row lowered the cost by less than is looked for.
_QUIET_UPDATES = 5


@dataclass(frozen=True)
class RobustOptions(Options):
    """Whether loops are doubted."""

    enabled: bool = option(
        True, 'believe a loop only once others, or the odometry, vouch for it; without, every '
        'loop is used at once')


@dataclass(frozen=True)
class BackendOptions(GraphBuilderOptions):
    """Everything the back end can be told."""

    solver: OptimiserOptions = OptimiserOptions()
    robust: RobustOptions = RobustOptions()


@dataclass(frozen=True)
class Improvement:
    """
    What one update did: new poses (n, p), dual (rows,) and belief, and the account of it.

    cost_before, cost : L1 cost of the accepted factors; reweighted_steps : factorisations for
    the long-range part; outer, inner : iterations of Algorithm 4; gap : of its last linear
    problem; seconds : all of it; doubt : why the map is not to be relied on, if so.
    """

    poses: Array
    dual: Array
    belief: Belief
    robust: bool
    cost_before: float
    cost: float
    status: Status
    reweighted_steps: int
    outer_iterations: int
    inner_iterations: int
    gap: float
    seconds: float
    doubt: Doubt | None = None


class Backend:
    """
    Keeps a map while it grows.

    Parameters
    ----------
    manifold : what the poses live on
    options : see `BackendOptions`

    """

    def __init__(self, manifold: Manifold, options: BackendOptions):
        self._manifold = manifold
        self._options = options
        self.builder = GraphBuilder(manifold, options)
        self._poses = manifold.identity(0)
        self._dual: Array = np.zeros(0)
        self._belief = Belief.nothing()
        self._last_cost = 0.0
        self._status = Status.OUT_OF_TIME
        self._changes = self._samples = self._quiet_updates = 0
        self._map_to_odom: tuple[Array, Array] | None = None

    @property
    def version(self) -> tuple[int, int, int]:
        """Other than an earlier one where there may be something new to do or to tell."""
        builder = self.builder
        # While loops wait, any sample may be the one that they wait for, or one too many.
        return (self._changes, builder.graph.n_poses, self._samples if builder.n_waiting else 0)

    @property
    def poses(self) -> Array:
        """All keyframes in the map frame, (n, p): the optimised ones, then odometry from there."""
        return self._now().poses

    @property
    def map_to_odom(self) -> Array:
        """The odometry frame seen from the map, (1, p): what the last optimised keyframe says."""
        last, manifold, offset = len(self._poses) - 1, self._manifold, self.builder.offset
        if last < 0:
            return manifold.identity(1)
        # Asked for with every sample: worked out when an update or a new offset changes it.
        if self._map_to_odom is None or self._map_to_odom[0] is not offset:
            odometry = self.builder.odometry[last : last + 1]
            to_kept = manifold.compose(self._poses[last:], manifold.inverse(odometry))
            self._map_to_odom = offset, manifold.compose(to_kept, offset)
        return self._map_to_odom[1]

    def set_options(self, options: BackendOptions) -> None:
        """
        Work by other options from now on; what is in the graph stays.

        Where loops are to be doubted that were not before, or the other way round, all are judged
        anew.
        """
        self._changes += 1
        if options.robust != self._options.robust:
            self._belief, self._status = Belief.nothing(), Status.OUT_OF_TIME
        self._options = options
        self.builder.options = options

    def restore(self, graph: FactorGraph, poses: Array, stamps: Indices) -> None:
        """Begin with the map of an earlier run: see `GraphBuilder.restore`; call it first."""
        self.builder.restore(graph, stamps, poses)
        self._poses, self._map_to_odom = poses, None
        self._changes += 1

    def add_odometry(self, sample: OdometrySample) -> bool:
        """Add one sample; see `GraphBuilder.add_odometry`."""
        _require_finite(sample.pose3)
        self._samples += 1
        graph = self.builder.graph
        made = self.builder.add_odometry(sample)
        if self.builder.graph is not graph:
            self._forget_stray()
        return made

    def begin_anew(self) -> None:
        """Forget the only sample so far; see `GraphBuilder.begin_anew`."""
        self.builder.begin_anew()
        self._forget_stray()

    def _forget_stray(self) -> None:
        """Forget the pose of a first sample that was none: an update may have looked at it."""
        if self.builder.graph.n_poses < 2:
            self._poses = self._poses[:0]
        self._map_to_odom = None
        self._changes += 1

    def add_loop(self, loop: LoopClosure) -> None:
        """Add one loop closure; see `GraphBuilder.add_loop`."""
        _require_finite(loop.pose3)
        self._changes += 1
        self.builder.add_loop(loop)

    def snapshot(self) -> Snapshot:
        """Return the back end as it is, the due loops in its graph, to be read at leisure."""
        self.builder.add_due_loops()
        return self._now()

    def problem(self) -> Problem:
        """Return what an update begins with."""
        return self.snapshot().problem()

    def _now(self) -> Snapshot:
        builder = self.builder
        at_rest = (self._status in (Status.CONVERGED, Status.STALLED)
                   or self._quiet_updates >= _QUIET_UPDATES)
        return Snapshot(
            self.version, builder.graph.copy(), builder.stamps, builder.odometry, self.map_to_odom,
            builder.loop_rows, builder.loop_stamps, self._poses, self._dual, self._belief,
            self._options.robust.enabled, self._last_cost, at_rest)

    def adopt(self, improvement: Improvement) -> None:
        """
        Take over what `improve` made of a snapshot; keyframes since then follow along.

        What was made when loops were judged otherwise is left.

        Raises
        ------
        ArithmeticError : it is not finite; nothing is taken over.

        """
        if improvement.robust != self._options.robust.enabled:
            return
        for name in ('poses', 'dual', 'cost'):
            if not np.isfinite(getattr(improvement, name)).all():
                raise ArithmeticError(f'the {name} of a new map is not finite; the map stays')
        self._changes += 1
        fell = improvement.cost_before - improvement.cost
        quiet = (improvement.belief.settled and len(improvement.dual) == len(self._dual)
                 and fell <= self._options.solver.outer_tolerance * improvement.cost)
        self._quiet_updates = self._quiet_updates + 1 if quiet else 0
        self._map_to_odom = None
        self._poses = improvement.poses
        self._dual = improvement.dual
        self._belief = improvement.belief
        self._last_cost = improvement.cost
        self._status = improvement.status

    def loop_states(self) -> LoopStates:
        """Return what has become of each loop, those of the graph first, in its order."""
        return self._now().loop_states()

    def update(self, budget: float) -> Improvement | None:
        """Improve the map for about `budget` seconds; None: there was nothing to do."""
        problem = self.problem()
        if problem.settled or not problem.graph.n_poses:
            return None
        improvement = improve(problem, self._options.solver, budget)
        self.adopt(improvement)
        return improvement


# Called on the way, often; raises where the work shall stop.
Check = Callable[[], None]


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
    belief, starts = problem.belief, [problem.poses]
    if not belief.settled:
        belief, judged = judge(problem.graph, problem.poses, belief, deadline, check)
        # After a loop has closed, the L2 map of the judgement is nearer.
        starts.append(judged)
    check()
    graph = problem.graph.subset(belief.accepted)
    size = graph.manifold.TANGENT_SIZE
    dual = problem.dual.reshape(-1, size)[belief.accepted].ravel()
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
    return _improvement(solution, problem, belief, before, steps, start)


def optimise(problem: Problem, options: OptimiserOptions,
             check: Check = lambda: None) -> Improvement:
    """
    Solve a snapshot to the end; where loops are doubted, after judging all of them anew.

    Else from its own poses and from the seed, whichever ends lower.
    """
    start = time.monotonic()
    graph, belief, doubt = problem.graph, problem.belief, None
    if problem.robust:
        found = minimise_robustly(
            graph, lambda part, poses: _solved(part, poses, options, check), check=check)
        solution, doubt, belief = found.solution, found.doubt, Belief(
            found.accepted, found.suspect, found.sigmas, found.variance)
    else:
        starts = (problem.poses, seed_poses(graph, choose(AUTO, graph).cholesky, check=check))
        solution = min((_solved(graph, poses, options, check) for poses in starts),
                       key=lambda s: s.cost)
    part = graph.subset(belief.accepted)
    before = l1_cost(whitened_residual(part, problem.poses))
    return replace(_improvement(solution, problem, belief, before, 0, start), doubt=doubt)


def _require_finite(pose3: Array) -> None:
    # It would spoil all that comes after it.
    if not np.isfinite(pose3).all():
        raise ArithmeticError(f'pose {pose3} is not finite')


def _solved(graph: FactorGraph, poses: Array, options: OptimiserOptions,
            check: Check) -> Solution:
    check()
    return minimise_by(choose(AUTO, graph), graph, poses, options, lambda *_: check())[0]


def _improvement(solution: Solution, problem: Problem, belief: Belief, before: float, steps: int,
                 start: float) -> Improvement:
    size = problem.graph.manifold.TANGENT_SIZE
    # The rows of what is not believed have no dual yet.
    dual = np.zeros((len(belief.accepted), size))
    dual[belief.accepted] = solution.dual.reshape(-1, dual.shape[1])
    return Improvement(solution.poses, dual.ravel(), belief, problem.robust, before,
                       solution.cost, solution.status, steps, solution.outer_iterations,
                       solution.inner_iterations, solution.gap, time.monotonic() - start)
