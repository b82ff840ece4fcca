# SPDX-License-Identifier: Apache-2.0
"""
Keeping a map up to date while it grows: the front in an update, map and judge behind it.

An update takes what has come into a map that was factored before (`front`), in a time that does
not grow with the map. Two workers go on behind it, in threads, from one snapshot to the next:

    map     lowers the L1 cost of what is accepted, and factors it for the next front
    judge   looks at all loops again, at rest anew and at the norm, and moves nothing

One lock is held to append, to take a snapshot and to adopt, for moments, so that messages never
wait. Who uses or replaces the front, or what was made so far, holds the front's before it; never
while solving, reading or writing a file. A third one lets one thread at a time update. Work for a
map that is replaced, or that `settle` is to solve, is told to stop, and its result never adopted.
"""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from l1slam_ros.core.bordered.front import Front, Look
from l1slam_ros.core.errors import Interrupted
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.online.parts import as_one, of_all
from l1slam_ros.core.online.snapshot import Optimised, Snapshot
from l1slam_ros.core.online.update import Improvement, front_of, improve, one_round, optimise
from l1slam_ros.core.online.upkeep.live_map import LiveMap
from l1slam_ros.core.online.upkeep.threads import LOOK, Calm, Worker, until
from l1slam_ros.core.robust.batch import doubts_of_norm, judge, robust_solve
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions

# Asked on the way, often: whether to stop.
Stopped = Callable[[], bool]
# [s] So long an update may take what has come, and a map is improved, whatever the budget.
_LEAST_TIME, _LEAST_ROUND = 0.02, 0.1
# Of the clock a round may take some times as long.
_PATIENCE = 4
# So often a new front takes what came meanwhile, before it is one; so many factors at once.
_PASSES, _AT_ONCE = 3, 16


class Upkeep:
    """
    The part of a back end that keeps its map.

    Parameters
    ----------
    solver, robust : the options of these names

    Attributes
    ----------
    maps : how many maps there were: one more whenever factors were taken into it, and with each
        that was adopted or took another's place
    calm : what goes on behind waits for its end

    """

    def __init__(self, solver: OptimiserOptions, robust: bool):
        self._solver, self._robust = solver, robust
        # In the order in which they are taken.
        self._updating, self._front, self._lock = (threading.Lock() for _ in range(3))
        self._ended, self.calm = threading.Event(), Calm()
        self._workers = self._mapper, self._judge = (
            Worker('map', self._on_end), Worker('judge', self._on_end))
        self._make_way = False
        self.maps = self._number = self._changes = self._samples = 0
        self._builder: GraphBuilder
        self._live: LiveMap
        # The version at which an update found nothing to do, and what there was at the last one.
        self._at_rest: object = None
        self._grown: object = None
        self._map_to_odom: tuple[Array, Array] | None = None
        # Map -> odom before the first map and after the last that nobody asked for yet.
        self._moved: tuple[Array, Array] | None = None

    def _begin(self, builder: GraphBuilder, optimised: Optimised) -> None:
        """Begin a map with the graph of a builder; the lock is held."""
        self._builder, self._number = builder, self._number + 1
        self._live = LiveMap(self._number, builder, optimised, self._robust)
        self._map_to_odom, self._grown = None, self._live.size()
        self._changes += 1

    @property
    def version(self) -> tuple[int, int, int]:
        """Other than an earlier one where there may be something new to do or to tell."""
        with self._lock:
            return self._version()

    def _version(self) -> tuple[int, int, int]:
        # While loops wait, any sample may be the one that they wait for, or one too many.
        waits = len(self._builder.loops.waiting) > 0
        return (self._changes, self._builder.graph.n_poses, self._samples if waits else 0)

    def snapshot(self) -> Snapshot:
        """Return the back end as it is now, the due loops in its graph, to be read at leisure."""
        with self._standing() as now:
            return now

    @contextmanager
    def _standing(self) -> Iterator[Snapshot]:
        """Let nothing change; give a snapshot, see `snapshot`."""
        with self._front:
            # First what takes long: until then messages come in, and may begin another map.
            views = front.views if (front := self._live.front) else ()
            with self._lock:
                self._builder.add_due_loops()
                live, track, loops = self._live, self._builder.track, self._builder.loops
                yield Snapshot(
                    live.number, self._version(), self._builder.graph.copy(), track.gaps,
                    track.keyframe_stamps, track.keyframe_poses, self._map_to_odom_now(),
                    loops.rows, loops.stamps, live.optimised, live.robust, live.looks.view(),
                    live.all_judged and not live.pending, live.judged, live.pending, live.stale,
                    views if live.front is front else (), front.pattern if front else None)

    def _map_to_odom_now(self) -> Array:
        """Return the odometry frame seen from the map: what its last keyframe says."""
        offset, manifold = self._builder.offset, self._builder.graph.manifold
        last, pose = self._live.newest
        if last < 0:
            return manifold.identity(1)
        # Asked for with every sample: worked out when an update or a new offset changes it.
        if self._map_to_odom is None or self._map_to_odom[0] is not offset:
            odometry = self._builder.track.poses_of(np.array([last]))
            to_kept = manifold.compose(pose, manifold.inverse(odometry))
            self._map_to_odom = offset, manifold.compose(to_kept, offset)
        return self._map_to_odom[1]

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
            self._check_workers()
            if self._at_rest == self.version:
                return None
            live, last = self._live, self._live.last
            self._take(start + max(budget, _LEAST_TIME))
            with self._lock:
                grown = live.size()
                came, self._grown = grown != self._grown, grown
            idle = not came if idle is None else idle
            check = self._check_of(live, stopped)
            while self._begin_due(idle, budget, self.calm.kept(check)):
                self._ended.wait(max(min(LOOK, start + budget - time.monotonic()), 0.0))
                self._ended.clear()
                self._check_workers()
                check()
                if time.monotonic() >= start + budget:
                    return live.account(time.monotonic() - start)
            if came or live.last is not last or not idle:
                return live.account(time.monotonic() - start)
            self._at_rest = self.version
        return None

    def _check_of(self, live: LiveMap, stopped: Stopped) -> Callable[[], None]:
        """Return what raises `Interrupted` where work for a map is not wanted any more."""
        return until(lambda: self._make_way or stopped() or live is not self._live)

    def _check_workers(self) -> None:
        for worker in self._workers:
            worker.check()

    def _take(self, deadline: float) -> None:
        """Let the front take what has come, until a time [s]."""
        with self._front, self._lock:
            self._builder.add_due_loops()
            self._live.hear()
            before, taken = self._map_to_odom_now(), False
        while time.monotonic() < deadline:
            with self._front:
                with self._lock:
                    factors = self._builder.graph.between
                if not self._live.take_some(factors):
                    break
                taken = True
            time.sleep(0)  # who waits for the lock would else wait for the deadline
        if taken:
            with self._front:
                self._live.note_newest()
                with self._lock:
                    self._note_map(before)

    def _begin_due(self, idle: bool, budget: float, check: Callable[[], None]) -> bool:
        """Let the workers begin what is due; return whether any is at work."""
        with self._lock:
            if self._live.is_map_due(idle):
                self._mapper.start(lambda: self._map_anew(idle, budget, check))
            if self._live.is_judge_due(idle, budget):
                # At rest first what is the sooner over, and all there is to find out mostly.
                anew = self._live.is_anew_due(idle)
                self._judge.start(lambda: self._judge_all(anew, idle, check))
            elif self._live.is_norm_due(idle):
                self._judge.start(lambda: self._ask_norm(check))
            return self._mapper.busy or self._judge.busy

    def _map_anew(self, idle: bool, budget: float, check: Callable[[], None]) -> None:
        """Lower the cost of the map, when idle to the end, and factor it."""
        with self._standing() as now:
            live, solver = self._live, self._solver
            exact = live.is_exact_due(idle)
        whole, pending, looked = now.problem(), now.pending, now.looked
        del now  # holds the factors of a front that may be replaced meanwhile
        problem = as_one(whole)
        if not pending:
            # What is made of less than is believed by then, would be late.
            check = until(lambda: live.pending is not None, check)
        if exact:
            check = until(lambda: live.is_late, check)
        else:
            solver = one_round(solver, problem.is_sparse)
        improvement = improve(problem, solver, _PATIENCE * max(budget, _LEAST_ROUND), check, exact)
        check()
        judgement, looks = whole.judgement, list[Look]()
        front = front_of(problem, improvement.poses, looked, check)
        for _ in range(_PASSES):
            with self._front, self._lock:
                factors, accept = live.to_accept(judgement.accepted, pending)
            while front is not None and not front.closed and front.rows < len(accept):
                check()
                looks += front.take(factors, accept[front.rows:front.rows + _AT_ONCE])
        check()
        self.adopt(of_all(improvement, whole), front, pending, looks)

    def _judge_all(self, anew: bool, idle: bool, check: Callable[[], None]) -> None:
        """Look at all loops again; anew: from the graph alone; idle: that until more comes."""
        with self._standing() as now:
            live, loops = self._live, self._live.begin_judgement()
            grown = live.size()
        whole = now.problem()
        del now  # as above
        problem = as_one(whole)
        alone = until(lambda: live.size() != grown, check) if idle else check
        judgement, poses = robust_solve(problem.graph, check=alone) if anew else judge(
            problem.graph, problem.poses, problem.judgement, np.inf, check)
        check()
        with self._front, self._lock:
            live.take_judgement(judgement.of_all(whole.graph), poses, loops, anew)
            self._changes += 1

    def _ask_norm(self, check: Callable[[], None]) -> None:
        """Doubt the map where it hangs on its norm."""
        now = self.snapshot()
        problem = as_one(now.problem())
        doubts = doubts_of_norm(problem.graph, problem.judgement, problem.poses, check)
        with self._front, self._lock:
            self._live.take_doubts(now.optimised, doubts)
            self._changes += 1

    def settle(self, stopped: Stopped = lambda: False) -> Improvement | None:
        """
        Judge all loops and solve to the end; None: there are no factors yet.

        What is under way makes way.

        Raises
        ------
        Interrupted : told to stop, or the map was replaced.

        """
        with self._alone():
            with self._standing() as now:
                live, loops = self._live, self._live.begin_judgement()
                self._grown = live.size()
            whole = now.problem()
            if not len(whole.graph.between):
                return None
            problem, check = as_one(whole), self.calm.kept(self._check_of(live, stopped))
            improvement = optimise(problem, self._solver, check)
            check()
            front = front_of(replace(problem, judgement=improvement.judgement), improvement.poses,
                             len(whole.graph.between), check)
            improvement = of_all(improvement, whole)
            with self._front, self._lock:
                live.take_judgement(improvement.judgement, improvement.poses, loops, True)
            self.adopt(improvement, front, improvement.judgement)
        self._on_end()
        return improvement

    def adopt(self, improvement: Improvement, front: Front | None = None,
              pending: Judgement | None = None, looks: Sequence[Look] = ()) -> None:
        """
        Take over a map that was made of a snapshot; keyframes since then follow along.

        front : made of it, None: it cannot be factored; pending, looks : see `LiveMap.adopt`

        Raises
        ------
        Interrupted : it was made for a map that is there no more.
        ArithmeticError : it is not finite; nothing is taken over.

        """
        with self._front, self._lock:
            if improvement.map != self._live.number:
                raise Interrupted
            before = self._map_to_odom_now()
            self._live.adopt(improvement, front, self._solver.outer_tolerance, pending, looks)
            self._note_map(before)

    def _note_map(self, before: Array) -> None:
        """Note that the map is another now; before : map -> odom until then."""
        self._map_to_odom = None
        self._moved = (self._moved or (before,))[0], self._map_to_odom_now()
        self._changes += 1
        self.maps += 1

    def moved(self) -> tuple[Array, Array]:
        """Return map -> odom as it was when this was asked before, and as it is, (1, p) each."""
        with self._lock:
            (before, after), self._moved = self._moved or 2 * (self._map_to_odom_now(),), None
            return before, after

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

    def _on_end(self) -> None:
        """Hear that a worker is done."""
        self._ended.set()
