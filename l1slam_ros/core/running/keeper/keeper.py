# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The keeper owns the growing graph, the state of its map, and two locks.

In: messages, and results computed from snapshots. Out: snapshots, and the revision, a number that
counts all changes and tells whether a stored result is still up to date.

    _front_lock     the front and its bordered systems, while factors are added or steps computed
    _graph_lock     graph, odometry, loops, state, revision: held briefly; messages never wait

A thread that needs both takes them in this order; neither is held while solving, or while a file
is read or written. The state changes under both locks, or under the graph lock alone where a map
begins anew: a result that was computed for the map before is refused then (`Interrupted`).
"""

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from l1slam_ros.core.bordered.front import MOST_ROWS, Front, Look
from l1slam_ros.core.errors import Interrupted
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import BetweenFactors
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.online.options import GraphBuilderOptions
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.running.improve import Improvement
from l1slam_ros.core.running.keeper.revisions import Revisions
from l1slam_ros.core.running.keeper.schedule import Size
from l1slam_ros.core.running.keeper.workers import PoliteLock
from l1slam_ros.core.running.map_state import Carried, MapState, Transition
from l1slam_ros.core.running.map_to_odom import MapToOdom, Newest, move_all
from l1slam_ros.core.running.optimised import Optimised
from l1slam_ros.core.running.robot_maps import Joins, Seen, map_ends
from l1slam_ros.core.running.snapshot import Robot, SavedMap, Snapshot
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions

# Number of factors that a front takes while its lock is held and before the clock is read; one if
# the front has so many rows that a loop takes milliseconds.
_AT_ONCE, _LONG = 4, MOST_ROWS // 4
# How often the next state is worked out without a lock before it is with all.
_TRIES = 3


class Keeper:
    """
    Keeps a graph and the state of its map.

    Parameters
    ----------
    builder : of the graph
    solver, robust : the options of these names

    """

    def __init__(self, builder: GraphBuilder, solver: OptimiserOptions, robust: bool):
        self._front_lock, self._graph_lock = PoliteLock(), threading.Lock()
        self._builder, self._solver, self._robust = builder, solver, robust
        self._front: Front | None = None
        nothing = Optimised.nothing(builder.graph.manifold.identity(0))
        # By robot.
        self._odom: dict[int, MapToOdom] = {}
        self._joins = Joins()
        self._revisions = Revisions()
        self._state = MapState.beginning(0, robust, nothing, Judgement.nothing(), 0)

    @property
    def state(self) -> MapState:
        """The state of the map as it is now."""
        return self._state

    @property
    def revisions(self) -> Revisions:
        """The revisions as they are now."""
        return self._revisions

    @property
    def solver(self) -> OptimiserOptions:
        """The options of the solver as they are now."""
        return self._solver

    # What comes in.

    def add_odometry(self, sample: OdometrySample, robot: int) -> bool:
        """See `Backend.add_odometry`."""
        with self._graph_lock:
            builder, graph = self._builder, self._builder.graph
            keyframes = graph.n_poses
            try:
                return builder.add_odometry(sample, robot)
            finally:  # of two samples the second may be refused
                if builder.graph is not graph:
                    self._begin()
                elif graph.n_poses != keyframes:
                    self._revisions = self._revisions.after(grown=True)
                elif len(builder.loops.waiting):
                    # Any sample may be the one that a loop waits for, or the one at which it
                    # expires.
                    self._revisions = self._revisions.after()

    def add_loop(self, loop: LoopClosure) -> None:
        """See `Backend.add_loop`."""
        with self._graph_lock:
            self._revisions = self._revisions.after()
            self._builder.add_loop(loop)

    def begin(self, builder: GraphBuilder, optimised: Optimised | None = None,
              judgement: Judgement | None = None) -> int:
        """
        Begin a map with the graph of a builder; results for the map before are no longer taken.

        optimised, judgement : of the graph, None: nothing is known of it yet. Return the revision
        that names the graph, see `Revisions`.
        """
        with self._graph_lock:
            self._builder = builder
            self._begin(optimised, judgement)
            return self._revisions.graph

    def set_options(self, options: GraphBuilderOptions, solver: OptimiserOptions,
                    robust: bool) -> None:
        """See `Backend.set_options`."""
        with self.standing() as now:
            self._builder.set_options(options)
            self._solver, doubted, self._robust = solver, self._robust, robust
            self._revisions = self._revisions.after()
            if doubted != robust:
                self._begin(now.optimised().unfinished(), same_graph=True)

    def _begin(self, optimised: Optimised | None = None, judgement: Judgement | None = None,
               same_graph: bool = False) -> None:
        """Begin a map, see `begin`; the graph is locked."""
        builder, self._front = self._builder, None
        self._revisions = self._revisions.after(map=not same_graph, graph=not same_graph)
        optimised = optimised or Optimised.nothing(builder.graph.manifold.identity(0))
        judgement = judgement or Judgement.nothing()
        judged_loops = int((builder.loops.rows < len(judgement.accepted)).sum())
        self._odom = {}
        ends = map_ends(Seen.of(builder), optimised.poses, None, judgement.accepted)
        for robot, end in ends.items():
            self._odom[robot] = MapToOdom(end)
        self._state = MapState.beginning(
            self._revisions.now, self._robust, optimised, judgement, judged_loops)

    # What is there.

    @contextmanager
    def reading(self) -> Iterator[GraphBuilder]:
        """Yield the builder, locked: it does not change within the block."""
        with self._graph_lock:
            yield self._builder

    def snapshot(self) -> Snapshot:
        """Return a copy of the present state, with the loops that are due as factors."""
        with self.standing() as now:
            return now

    @contextmanager
    def standing(self) -> Iterator[Snapshot]:
        """Yield a snapshot; graph, front and state do not change within the block."""
        with self._front_lock:
            front = self._front
            views = front.views if front else ()
            with self._graph_lock:
                self._add_due_loops()
                builder, loops = self._builder, self._builder.loops
                # A map that began meanwhile has no front.
                views = views if front is self._front else ()
                yield Snapshot(
                    self._state, builder.graph.copy(), builder.keyframe_stamps,
                    builder.keyframe_poses, self._odom_of(0).now(builder.robots[0]), loops.rows,
                    loops.stamps, loops.robots, views, front.pattern if front and views else None)

    def saved(self) -> SavedMap | None:
        """See `Backend.saved`."""
        with self.standing() as now:
            if now.graph.between.is_absolute.all():
                return None
            builder, graph = self._builder.grown(), self._revisions.graph
        return SavedMap(builder, now.optimised(), now.judgement, now.state.robust, graph)

    def look(self) -> tuple[MapState, BetweenFactors, Size]:
        """Return the state, the factors, and the size of the graph."""
        with self._graph_lock:
            return self._state, self._builder.graph.between, Size.of(self._builder)

    def robot(self, robot: int) -> Robot | None:
        """See `Backend.robot`."""
        with self._graph_lock:
            odometry = self._builder.robots.get(robot)
            last = odometry.stream.last if odometry else None
            if odometry is None or last is None:
                return None
            odom = self._odom_of(robot)
            return Robot(last.stamp, last.pose, odom.now(odometry), odom.joined)

    def moved(self, robot: int) -> tuple[Array, Array]:
        """See `Backend.moved`."""
        with self._graph_lock:
            return self._odom_of(robot).moved(self._builder.robots[robot])

    def _odom_of(self, robot: int) -> MapToOdom:
        """Return map -> odom of a robot; the graph is locked."""
        if robot not in self._odom:
            # Nothing can join what is not in the map.
            none = self._builder.graph.manifold.identity(0)
            self._odom[robot] = MapToOdom(Newest(-1, none, robot == 0))
        return self._odom[robot]

    def covariance(self, keyframe: int, seen_from: int | None) -> Array | None:
        """See `Backend.marginal_covariance`."""
        with self._front_lock:
            front = self._front
            known = front is not None and all(
                0 <= one < front.keyframes for one in (keyframe, seen_from or 0))
            return front.covariance(keyframe, seen_from) if front and known else None

    # What the front takes.

    def take_what_has_come(self, deadline: float,
                           in_vain: Callable[[], bool] = lambda: False) -> None:
        """
        Make factors of the due loops; let the front take new factors until the deadline [s].

        in_vain : let it take none, see `Updates._in_vain`
        """
        with self._front_lock, self._graph_lock:
            self._add_due_loops()
        taken = False
        took = 0.0  # [s] by the factors before, if any
        while (now := time.monotonic()) + took < deadline and not in_vain():
            with self._front_lock:
                if not self._take_some():
                    break
            taken = True
            self._front_lock.let_others()  # else they would wait for the deadline
            took = time.monotonic() - now
        if taken:
            with self._front_lock:
                with self._graph_lock:
                    front, state, seen = self._front, self._state, Seen.of(self._builder)
                ends = self._joins.ends(seen, state.table, state.optimised.poses, front)
                with self._graph_lock:
                    if self._state.began == state.began:
                        self._move(ends)

    def _add_due_loops(self) -> None:
        """Turn loops whose times the odometry has reached into factors; the graph is locked."""
        graph, loops = self._builder.graph, self._builder.loops
        waiting = len(loops.waiting)
        new = self._builder.add_due_loops()
        if len(loops.waiting) != waiting:
            self._state = self._state.told(graph.between)
            self._revisions = self._revisions.after(grown=new > 0)

    def _take_some(self) -> bool:
        """Let the front take a few factors; return whether it did; the front is locked."""
        with self._graph_lock:
            front, state, factors = self._front, self._state, self._builder.graph.between
        if front is None or front.closed or front.rows >= len(factors):
            return False
        end = front.rows + (_AT_ONCE if front.border < _LONG else 1)
        what = state.table.for_front(factors, front.rows, end, state.robust)
        looks = front.take(factors, what)
        with self._graph_lock:
            if self._state is state:  # else another map has begun
                self._state = state.taken(looks, Carried.by(front))
        return bool(looks)

    def _move(self, ends: Mapping[int, Newest]) -> None:
        """Note a changed map; ends : its last keyframe of each robot; the graph is locked."""
        move_all([(self._odom_of(robot), self._builder.robots[robot], end)
                  for robot, end in ends.items()])
        self._revisions = self._revisions.after(map=True)

    # What the workers make.

    def adopt(self, improvement: Improvement, front: Front | None = None,
              pending: Judgement | None = None, looks: Sequence[Look] = ()) -> None:
        """
        Publish a map that was made of a snapshot; keyframes since then move along with it.

        front : of this map, None: the map cannot be factored; pending, looks : see
        `MapState.adopted`

        Raises
        ------
        Interrupted : another map has begun since the snapshot.
        ArithmeticError : a pose is not finite; the map before stays.

        """
        with self._graph_lock:
            seen = Seen.of(self._builder)
        ends = map_ends(seen, improvement.poses, front, improvement.judgement.accepted)
        carried = Carried.by(front) if front else None
        former = self._front
        tolerance = self._solver.outer_tolerance

        def publish() -> None:
            self._front = front
            self._move(ends)

        self.change(improvement.map, lambda state, factors: state.adopted(
            improvement, carried, looks, pending, factors, tolerance, time.monotonic()), publish)
        # To free its memory takes long, so an update must not hold the last reference.
        with self._front_lock:
            pass
        del former

    def begin_judgement(self) -> tuple[Snapshot, int]:
        """Return a snapshot to judge, and the revision since which its graph has not grown."""
        with self.standing() as now:
            self._state = self._state.being_judged(time.monotonic())
            return now, self._revisions.grown

    def change(self, began: int, transition: Transition,
               publish: Callable[[], None] = lambda: None) -> None:
        """
        Replace the state by `transition` of it; publish : called then, with both locks.

        That takes milliseconds where the graph is large, so it is worked out without a lock, and
        again where the state has changed meanwhile; at last with both. began : names the map.

        Raises
        ------
        Interrupted : another map has begun.

        """
        for _ in range(_TRIES):
            state, factors, _ = self.look()
            if state.began != began:
                raise Interrupted
            found = transition(state, factors)
            with self._front_lock, self._graph_lock:
                if self._state is state:
                    # Of factors that were there already, a person may have said something since.
                    now = self._builder.graph.between
                    self._state = found if now is factors else found.told(now)
                    self._revisions = self._revisions.after()
                    return publish()
        with self._front_lock, self._graph_lock:
            if self._state.began != began:
                raise Interrupted
            self._state = transition(self._state, self._builder.graph.between)
            self._revisions = self._revisions.after()
            publish()
