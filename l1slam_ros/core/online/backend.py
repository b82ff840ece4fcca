# SPDX-License-Identifier: Apache-2.0
"""
The incremental back end: samples and loops in, optimised poses out, from many threads.

It owns the growing graph, the poses and the dual. An update takes what has come into a map that
was factored before (`front`), in a time that does not grow with the map. Two workers go on behind
it, each in a thread of its own, from one snapshot to the next:

    map     lowers the L1 cost of what is believed, and factors it for the next front
    judge   looks at all loops anew, and moves nothing

One lock is held to append, to take a snapshot, to look at one factor and to adopt, never while
solving, reading or writing a file. A second one lets one thread at a time update.

What is being worked out for a map that is replaced meanwhile, or that `settle` is to solve in the
place of the workers, is told to stop, and never adopted.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.errors import Interrupted, OptionError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.incremental.front import Front
from l1slam_ros.core.online.background import Background, Worker
from l1slam_ros.core.online.graph_builder import GraphBuilder, GraphBuilderOptions
from l1slam_ros.core.online.loop_states import LoopStates
from l1slam_ros.core.online.snapshot import Optimised, Snapshot
from l1slam_ros.core.online.update import Improvement, front_of, improve, optimise
from l1slam_ros.core.options import Options, option
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.robust.running import judge
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import Status

# What poses live on, by the dimension of the world.
_MANIFOLDS: dict[int, Manifold] = {2: se2}

# Asked on the way, often: whether to stop.
Stopped = Callable[[], bool]
# [s] So long an update may take what has come, and a map is improved, whatever the budget.
_LEAST_TIME, _LEAST_ROUND = 0.02, 0.1
# Linearisations of one round: more and it is late.
_OUTER = 2
# A map is factored anew from so many rows on that came since: those of ten keyframes.
_MANY_ROWS = 90
# [s] While loops come that none of which fits, they are judged so often.
_JUDGE_EVERY = 2.0
# [s] In the background nothing has come for a while when it has not for so long.
_PAUSE = 0.2
# So often a new front takes what came meanwhile, before it is one.
_PASSES = 3
# [s] How often who waits looks whether to stop.
_LOOK = 0.05


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


class Backend:
    """
    Keeps a map while it grows.

    Parameters
    ----------
    options : see `BackendOptions`
    dimension : of the world: 2
    background : update in a thread of its own whenever there is something new, until `close` or
        the end of the `with` block

    Attributes
    ----------
    manifold : what the poses live on
    maps : how many maps there were: one more with each that was adopted or took another's place

    Raises
    ------
    OptionError : the dimension is not supported.

    """

    def __init__(self, options: BackendOptions = BackendOptions(),  # noqa: B008
                 dimension: int = 2, background: bool = False):
        if dimension not in _MANIFOLDS:
            raise OptionError(f'dimension {dimension!r} is not supported yet, expected 2')
        self.manifold = _MANIFOLDS[dimension]
        self._options = options
        self._lock, self._updating = threading.Lock(), threading.Lock()
        self._ended = threading.Event()
        self._workers = self._mapper, self._judge = (
            Worker('map', self._on_end), Worker('judge', self._on_end))
        self._make_way = False
        self.maps = self._map = self._changes = self._samples = 0
        # The version at which an update found nothing to do.
        self._at_rest: object = None
        self._counted: tuple[object, dict[str, int]] = (None, {})
        self._background: Background | None = None
        self.reset()
        self.maps = 0
        if background:
            self._background = Background(
                lambda idle, stopped: self._update(0.0, stopped, idle), _PAUSE)

    def __enter__(self) -> 'Backend':
        """Return the back end; the end of the block closes it."""
        return self

    def __exit__(self, *_: object) -> None:
        """See `close`."""
        self.close()

    def close(self) -> None:
        """End what is at work behind; raise what went wrong there, if anything did."""
        try:
            if self._background is not None:
                self._background.close()
        finally:
            with self._alone():
                pass
        self._check_workers()

    def reset(self) -> None:
        """Forget everything."""
        self._replace(GraphBuilder(self.manifold, self._options), self.manifold.identity(0))

    def restore(self, graph: FactorGraph, poses: Array, stamps: Indices) -> None:
        """Replace the map by one of an earlier run; see `GraphBuilder.restore`."""
        builder = GraphBuilder(self.manifold, self._options)
        builder.restore(graph, stamps, poses)
        self._replace(builder, poses)

    def _replace(self, builder: GraphBuilder, poses: Array) -> None:
        """Begin a map with the graph of a builder; what is made for the one before is left."""
        with self._lock:
            self.maps += 1
            self._map += 1
            self._changes += 1
            # Options may have changed since it was made.
            builder.options = self._options
            self._builder = builder
            self._begin(poses)
        self._wake()

    def _begin(self, poses: Array) -> None:
        """Forget what was made of the graph; poses : (n, p) where its keyframes are."""
        self._optimised = Optimised.nothing(poses)
        self._front: Front | None = None
        self._last: Improvement | None = None
        self._looks = GrowingArray((3,))
        # Loops that were judged; whether one that the front left may be true; when to judge again.
        self._judged_loops, self._fits = 0, False
        self._judge_at = self._judge_took = self._optimum_took = 0.0
        # What there was when an update looked last.
        self._grown = self._map, 0, 0
        self._newest: tuple[int, Array]
        self._map_to_odom: tuple[Array, Array] | None
        self._note_newest()

    @property
    def version(self) -> tuple[int, int, int]:
        """Other than an earlier one where there may be something new to do or to tell."""
        with self._lock:
            return self._version()

    def _version(self) -> tuple[int, int, int]:
        builder = self._builder
        # While loops wait, any sample may be the one that they wait for, or one too many.
        return (self._changes, builder.graph.n_poses, self._samples if builder.n_waiting else 0)

    @property
    def poses(self) -> Array:
        """All keyframes in the map frame, (n, p): the optimised ones, then odometry from there."""
        return self.snapshot().poses

    def loop_states(self) -> LoopStates:
        """Return what has become of each loop, those of the graph first, in its order."""
        return self.snapshot().loop_states()

    def snapshot(self) -> Snapshot:
        """Return the back end as it is now, the due loops in its graph, to be read at leisure."""
        with self._lock:
            return self._snapshot()

    def _snapshot(self) -> Snapshot:
        builder = self._builder
        builder.add_due_loops()
        return Snapshot(
            self._map, self._version(), builder.graph.copy(), builder.stamps, builder.odometry,
            self._map_to_odom_now(), builder.loop_rows, builder.loop_stamps, self._optimised,
            self._options.robust.enabled, self._looks.view(), self._all_judged(),
            self._front.views if self._front else ())

    def counts(self) -> tuple[dict[str, int], dict[str, int]]:
        """Return the sizes of the graph, and how many loops were refused for which cause."""
        with self._lock:
            version, refused = self._version(), dict(self._builder.refused)
        if self._counted[0] != version:
            self._counted = version, self.snapshot().sizes()
        return self._counted[1], refused

    def news(self) -> list[str]:
        """Return what is new in the notes on messages; see `GraphBuilder.notes`."""
        with self._lock:
            return self._builder.notes.news()

    def set_options(self, options: BackendOptions) -> None:
        """
        Work by other options from now on; what is in the graph stays.

        Where loops are to be doubted that were not before, or the other way round, all are judged
        anew.
        """
        with self._lock:
            self._changes += 1
            if options.robust != self._options.robust:
                poses = self._snapshot().poses
                self._begin(poses)
            self._options = self._builder.options = options
        self._wake()

    def add_odometry(self, sample: OdometrySample) -> Array | None:
        """
        Add one sample; return the odometry frame seen from the map for it, (1, p).

        None: it is held, not used yet; see `GraphBuilder.add_odometry`.
        """
        _require_finite(sample.pose3)
        with self._lock:
            self._samples += 1
            graph = self._builder.graph
            self._builder.add_odometry(sample)
            if self._builder.graph is not graph:
                self._forget_stray()
            map_to_odom = None if self._builder.held else self._map_to_odom_now()
        self._wake()
        return map_to_odom

    def begin_anew(self) -> None:
        """Forget the only sample so far; see `GraphBuilder.begin_anew`."""
        with self._lock:
            self._builder.begin_anew()
            self._forget_stray()

    def _forget_stray(self) -> None:
        """Forget the pose of a first sample that was none: an update may have looked at it."""
        if self._builder.graph.n_poses < 2:
            self._map += 1
            self._begin(self.manifold.identity(0))
        self._map_to_odom = None
        self._changes += 1

    def add_loop(self, loop: LoopClosure) -> None:
        """Add one loop closure; see `GraphBuilder.add_loop`."""
        _require_finite(loop.pose3)
        with self._lock:
            self._changes += 1
            self._builder.add_loop(loop)
        self._wake()

    def update(self, budget: float = 0.1, stopped: Stopped = lambda: False) -> Improvement | None:
        """
        Take what has come into the map, and let it be improved; None: there was nothing to do.

        What has come, up to some twenty milliseconds of work, is in the map when this returns. It
        waits up to `budget` seconds for what goes on behind, and leaves the rest there.

        Raises
        ------
        Interrupted : told to stop, or to make way for `settle`, or the map was replaced.

        """
        return self._update(budget, stopped)

    def _update(self, budget: float, stopped: Stopped, idle: bool | None = None
                ) -> Improvement | None:
        """See `update`; idle : nothing has come for a while, None: find out."""
        start = time.monotonic()
        with self._updating:
            map_, last = self._map, self._last
            self._check_workers()
            if self._at_rest == self.version:
                return None
            self._take(start + max(budget, _LEAST_TIME))
            with self._lock:
                grown = self._growth()
                came, self._grown = grown != self._grown, grown
            idle = not came if idle is None else idle
            while self._begin_due(idle, budget, self._stop(map_, stopped)):
                self._ended.wait(max(min(_LOOK, start + budget - time.monotonic()), 0.0))
                self._ended.clear()
                self._check_workers()
                self._stop(map_, stopped)()
                if time.monotonic() >= start + budget:
                    return self._account(time.monotonic() - start)
            if came or self._last is not last:
                return self._account(time.monotonic() - start)
            if idle:
                self._at_rest = self.version
        return None

    def _check_workers(self) -> None:
        for worker in self._workers:
            worker.check()

    def _growth(self) -> tuple[int, int, int]:
        graph = self._builder.graph
        return self._map, graph.n_poses, len(graph.between)

    def _stop(self, map_: int, stopped: Stopped) -> Callable[[], None]:
        """Return what raises `Interrupted` where work for a map is not wanted any more."""
        def check() -> None:
            if self._make_way or stopped() or map_ != self._map:
                raise Interrupted

        return check

    def _take(self, deadline: float) -> None:
        """Let the front take what has come, until a time [s]."""
        with self._lock:
            self._builder.add_due_loops()
        while time.monotonic() < deadline:
            with self._lock:
                if not self._take_one():
                    break
                self._changes += 1
        with self._lock:
            self._note_newest()

    def _take_one(self) -> bool:
        """Let the front take one factor; return whether it did."""
        front, factors = self._front, self._builder.graph.between
        if front is None or front.closed or front.rows >= len(factors):
            return False
        row, judged = front.rows, self._optimised.judgement.accepted
        accept: bool | None = None
        if row < len(judged):
            accept = bool(judged[row])
        elif row < len(judged) + len(self._looks):
            accept = bool(self._looks.view()[row - len(judged), 0])
        elif factors.trusted[row] or not self._options.robust.enabled:
            accept = True
        look = front.add(factors, accept)
        if look is None:
            return False
        if row == len(judged) + len(self._looks):
            self._looks.extend(np.array([(look.accepted, look.suspect, look.sigmas)], float))
            self._fits |= look.suspect
        return True

    def _begin_due(self, idle: bool, budget: float, check: Callable[[], None]) -> bool:
        """Let the workers begin what is due; return whether any is at work."""
        with self._lock:
            optimised, front, graph = self._optimised, self._front, self._builder.graph
            grown = (len(optimised.poses) < graph.n_poses
                     or len(optimised.used) < len(graph.between))
            full = front is None or front.closed or front.border >= _MANY_ROWS
            if (grown and (full or idle) or optimised.rejudged or optimised.falls
                    or (idle and not optimised.at_rest)) and graph.n_poses:
                self._mapper.start(lambda: self._map_anew(idle, budget, check))
            soon = self._fits or front is None
            wait = self._judge_took if soon else max(_JUDGE_EVERY, 2 * self._judge_took)
            in_time = idle or budget > self._judge_took
            if not self._all_judged() and (in_time or time.monotonic() > self._judge_at + wait):
                self._judge.start(lambda: self._judge_anew(check))
            return self._mapper.busy or self._judge.busy

    def _map_anew(self, idle: bool, budget: float, check: Callable[[], None]) -> None:
        """Lower the cost of the map, when idle to the end, and factor it."""
        start = time.thread_time()
        with self._lock:
            now, solver = self._snapshot(), self._options.solver
        problem = now.problem()
        check()
        round_ = max(budget, _LEAST_ROUND)
        if problem.is_sparse and (idle or self._optimum_took < round_):
            improvement = improve(problem, solver, np.inf, check)
            self._optimum_took = time.thread_time() - start
        else:
            outer = min(solver.outer_iterations, _OUTER)
            improvement = improve(problem, replace(solver, outer_iterations=outer), 4 * round_,
                                  check)
        check()
        front = front_of(problem, improvement.poses, check)
        for _ in range(_PASSES):
            with self._lock:
                factors, judged = self._builder.graph.between, self._optimised.judgement.accepted
                accepted = np.concatenate((judged, self._looks.view()[:, 0] > 0))
            while front is not None and front.rows < len(accepted):
                check()
                if not front.add(factors, bool(accepted[front.rows])):
                    break
        check()
        self.adopt(improvement, front)

    def _judge_anew(self, check: Callable[[], None]) -> None:
        """Look at all loops anew; no keyframe is moved."""
        start = time.monotonic()
        with self._lock:
            now, loops, self._fits = self._snapshot(), len(self._builder.loop_rows), False
        problem = now.problem()
        judgement, poses = judge(problem.graph, problem.poses, problem.judgement, np.inf, check)
        check()
        with self._lock:
            if problem.map == self._map and self._options.robust.enabled:
                self._take_judgement(judgement, poses, loops)
                self._changes += 1
            self._judge_at = time.monotonic()
            self._judge_took = self._judge_at - start

    def _take_judgement(self, judgement: Judgement, poses: Array, loops: int) -> None:
        """Take over what is believed of the first factors, among them so many loops."""
        before, looks = len(self._optimised.judgement.accepted), self._looks.view()
        self._looks = GrowingArray((3,))
        self._looks.extend(looks[len(judgement.accepted) - before:])
        self._optimised = replace(self._optimised, judgement=judgement, judged=poses)
        self._judged_loops = loops

    def _all_judged(self) -> bool:
        """Return whether no loop waits to be judged."""
        return not self._options.robust.enabled or (
            self._optimised.judgement.settled
            and self._judged_loops == len(self._builder.loop_rows))

    def settle(self, stopped: Stopped = lambda: False) -> Improvement | None:
        """
        Judge all loops and solve to the end; None: there are no factors yet.

        What is under way makes way.

        Raises
        ------
        Interrupted : told to stop, or the map was replaced.

        """
        with self._alone():
            with self._lock:
                now, solver = self._snapshot(), self._options.solver
                self._grown, loops = self._growth(), len(self._builder.loop_rows)
            problem = now.problem()
            if not len(problem.graph.between):
                return None
            check = self._stop(problem.map, stopped)
            improvement = optimise(problem, solver, check)
            check()
            judgement = improvement.judgement
            front = front_of(replace(problem, judgement=judgement), improvement.poses, check)
            with self._lock:
                if problem.map != self._map:
                    raise Interrupted
                self._take_judgement(judgement, improvement.poses, loops)
                self._adopt(improvement, front)
        self._wake()
        return improvement

    def adopt(self, improvement: Improvement, front: Front | None = None) -> None:
        """
        Take over a map that was made of a snapshot; keyframes since then follow along.

        What was made when loops were judged otherwise is left.

        front : made of it, None: it cannot be factored

        Raises
        ------
        Interrupted : it was made for a map that is there no more.
        ArithmeticError : it is not finite; nothing is taken over.

        """
        with self._lock:
            if improvement.map != self._map:
                raise Interrupted
            self._adopt(improvement, front)

    def _adopt(self, improvement: Improvement, front: Front | None) -> None:
        if improvement.robust == self._options.robust.enabled:
            self._optimised = improvement.taken_over(
                self._optimised, self._options.solver.outer_tolerance)
            self._front, self._last = front, improvement
            # What the front begins with, no other has looked at.
            known, judgement = len(self._looks), improvement.judgement
            first = len(self._optimised.judgement.accepted) + known
            self._looks.extend(np.column_stack(
                (judgement.accepted, judgement.suspect, judgement.sigmas))[first:])
            self._note_newest()
            self._changes += 1
        self.maps += 1

    def _account(self, seconds: float) -> Improvement:
        """Return what the last map says of itself, after an update that took so long."""
        with self._lock:
            now, last = self._optimised, self._last
            judgement = replace(now.judgement, settled=self._all_judged())
            if last is None:
                return Improvement(
                    self._map, now.poses, now.dual, judgement, self._options.robust.enabled, 0.0,
                    0.0, Status.OUT_OF_TIME, 0, 0, 0, np.inf, seconds)
            return replace(last, judgement=judgement, seconds=seconds)

    def marginal_covariance(self, keyframe: int) -> Array | None:
        """
        Return the covariance of a keyframe's step, (k, k), relative to what is held fixed.

        Exact for the least squares map of what is believed, with the noise as it was found. None:
        the keyframe is not in a factored map yet.
        """
        with self._lock:
            front = self._front
            if front is None or not 0 <= keyframe < front.keyframes:
                return None
            return front.covariance(keyframe)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Let nothing be at work."""
        self._make_way = True
        with self._updating:
            for worker in self._workers:
                worker.join()
            self._make_way = False
            yield

    def alone(self, work: Callable[[], bool]) -> bool:
        """Do some work while nothing is being solved, nor begins to be; return what it returns."""
        with self._alone():
            return work()

    def _note_newest(self) -> None:
        """Remember the last keyframe of the map, which keyframes to come follow."""
        front, poses = self._front, self._optimised.poses
        self._newest = ((front.keyframes - 1, front.newest) if front
                        else (len(poses) - 1, poses[-1:]))
        self._map_to_odom = None

    def _on_end(self) -> None:
        """Hear that a worker is done."""
        self._ended.set()
        self._wake()

    def _map_to_odom_now(self) -> Array:
        """Return the odometry frame seen from the map: what the last optimised keyframe says."""
        manifold, offset = self.manifold, self._builder.offset
        last, pose = self._newest
        if last < 0:
            return manifold.identity(1)
        # Asked for with every sample: worked out when an update or a new offset changes it.
        if self._map_to_odom is None or self._map_to_odom[0] is not offset:
            odometry = self._builder.odometry[last : last + 1]
            to_kept = manifold.compose(pose, manifold.inverse(odometry))
            self._map_to_odom = offset, manifold.compose(to_kept, offset)
        return self._map_to_odom[1]

    def _wake(self) -> None:
        """Tell the background that there may be something to do."""
        if self._background is not None:
            self._background.wake()


def _require_finite(pose3: Array) -> None:
    # It would spoil all that comes after it.
    if not np.isfinite(pose3).all():
        raise ArithmeticError(f'pose {pose3} is not finite')
