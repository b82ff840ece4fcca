# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The running back end: odometry and loops in, optimised poses out; any thread may call it.

It consists of a keeper, which owns the graph and its map, and `Updates` of that map.
"""

import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import cache
from weakref import WeakSet

from l1slam_ros.core.errors import GraphError, OptionError, require
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.graph.measurements import (
    LoopClosure,
    OdometrySample,
    in_order,
    require_sound,
)
from l1slam_ros.core.names import OF_THE_NODE
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.online.odometry.odometry_stream import BaseFrame
from l1slam_ros.core.online.options import GraphBuilderOptions
from l1slam_ros.core.options import Options, option
from l1slam_ros.core.running.improve import Improvement
from l1slam_ros.core.running.keeper.keeper import Keeper
from l1slam_ros.core.running.keeper.revisions import Revisions
from l1slam_ros.core.running.keeper.updates import Updates
from l1slam_ros.core.running.keeper.workers import Background
from l1slam_ros.core.running.keeper.workers import Stopped as Stopped
from l1slam_ros.core.running.snapshot import (
    Behind,
    Counts,
    LoopStates,
    Robot,
    SavedMap,
    Snapshot,
)
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions

# Dimension of the world -> the manifold of the poses.
_MANIFOLDS: dict[int, Manifold] = {2: se2, 3: se3}
# [s] With `background=True`: the time without new data after which the back end is idle.
_PAUSE = 0.2


@dataclass(frozen=True)
class RobustOptions(Options):
    """Whether loops are judged."""

    enabled: bool = option(
        True, 'use a loop only once other loops or the odometry confirm it; false: use every '
        'loop at once')


@dataclass(frozen=True)
class BackendOptions(GraphBuilderOptions):
    """All options of the back end; a mapping may also hold options that only its node has."""

    PASSED_OVER = OF_THE_NODE

    solver: OptimiserOptions = OptimiserOptions()
    robust: RobustOptions = RobustOptions()


class Backend:
    """
    Makes a map from odometry and loops while they come.

    Parameters
    ----------
    options : see `BackendOptions`
    dimension : of the world, 2 or 3
    background : update in a thread of its own whenever there is something new, until `close` or
        the end of the `with` block; not in a process that is forked from this one

    Attributes
    ----------
    manifold : the manifold of the poses
    options : as they are now
    base_frame, base_frame_of : the name of the first robot's frame, and of that of a robot by its
        number, as far as they are known; a reset keeps them
    calm : background work pauses inside `with backend.calm:`

    Raises
    ------
    OptionError : there is no such dimension, or an argument is of another kind.

    """

    def __init__(self, options: BackendOptions = BackendOptions(),  # noqa: B008
                 dimension: int = 2, background: bool = False):
        _require_options(options)
        require(bool, 'background', background, 'True or False')
        require(int, 'dimension', dimension, '2 or 3')
        if dimension not in _MANIFOLDS:
            raise OptionError(f'dimension is {dimension!r}, expected 2 or 3')
        self.manifold = _MANIFOLDS[dimension]
        self.options = options
        self.base_frame_of = cache(lambda _: BaseFrame(options.base_frame))
        self.base_frame = self.base_frame_of(0)
        self._keeper = Keeper(_builder(self), options.solver, options.robust.enabled)
        self._updates = Updates(self._keeper, self._wake)
        self.calm = self._updates.calm
        # Sizes of the graph, and at which revision.
        self._counted: tuple[int, dict[str, int]] = (-1, {})
        self._called = -_PAUSE
        self._background = Background(self._help, _PAUSE) if background else None
        _ALL.add(self)

    def __enter__(self) -> 'Backend':
        """Return the back end; the end of the block closes it."""
        return self

    def __exit__(self, *_: object) -> None:
        """See `close`."""
        self.close()

    def close(self) -> None:
        """End the background threads; raise the error that one of them met, if any."""
        try:
            if self._background is not None:
                self._background.close()
        finally:
            with self.alone(urgent=True):
                pass
        self._updates.check()

    # What comes in.

    def add_odometry(self, sample: OdometrySample, robot: int = 0) -> bool:
        """
        Add one sample of a robot; return whether it is used, see `GraphBuilder.add_odometry`.

        robot : its number, 0 the first one's, whose frame is that of the map
        """
        require_sound(sample, OdometrySample)
        _require_robots(robot)
        used = self._keeper.add_odometry(sample, robot)
        self._wake()
        return used

    def add_loop(self, loop: LoopClosure) -> None:
        """Add one loop closure, turned round if it leads back; see `GraphBuilder.add_loop`."""
        require_sound(loop, LoopClosure)
        _require_robots(*loop.robots)
        self._keeper.add_loop(in_order(loop))
        self._wake()

    def set_options(self, options: BackendOptions) -> None:
        """
        Use other options from now on; the graph stays as it is.

        If loops are to be judged that were not before, or the other way round, all are judged
        anew.
        """
        _require_options(options)
        self.options = options
        self._keeper.set_options(options, options.solver, options.robust.enabled)
        self._wake()

    def reset(self) -> None:
        """Begin with an empty graph."""
        self._keeper.begin(_builder(self))
        self._wake()

    def saved(self) -> SavedMap | None:
        """Return the state from which another back end can continue; None without factors."""
        return self._keeper.saved()

    def restore(self, saved: SavedMap) -> int:
        """
        Continue from the state that another back end has `saved`, in place of the present map.

        Return the number of its graph in this back end, see `SavedMap`.
        """
        found, robust = saved.builder.graph.manifold, self.options.robust.enabled
        if found is not self.manifold:
            raise GraphError(f'a map of {found.NAME}, expected one of {self.manifold.NAME}')
        builder = _builder(self)
        builder.restore(saved.builder)
        builder.set_options(self.options)  # they may have changed since it was made
        graph = (self._keeper.begin(builder, saved.optimised, saved.judgement)
                 if saved.robust == robust else
                 self._keeper.begin(builder, saved.optimised.unfinished()))
        self._wake()
        return graph

    # What is done.

    def update(self, budget: float = 0.1, stopped: Stopped = lambda: False,
               taken: Callable[[], None] = lambda: None) -> Improvement | None:
        """
        Put new factors into the map and start background work; return None if nothing was to do.

        What has come, up to some ten milliseconds of work, is in the map when `taken` is
        called; up to there the `seconds` of what is returned count. Then it waits up to `budget`
        seconds for the background work, which goes on by itself after that; with
        `background=True` it does not wait.

        Raises
        ------
        Interrupted : told to stop, or to make way for `settle`, or the map was replaced.

        """
        self._called = time.monotonic()
        behind = self._background is not None and self._background.is_alive
        return self._updates.update(budget, stopped, waits=not behind, taken=taken)

    def settle(self, stopped: Stopped = lambda: False) -> Improvement | None:
        """
        Judge all loops and solve to the end; None: there are no factors yet.

        Work that is under way is interrupted; another call of `settle` is finished first.

        Raises
        ------
        Interrupted : told to stop, or the map was replaced.

        """
        return self._updates.settle(stopped)

    def alone(self, urgent: bool = False) -> AbstractContextManager[None]:
        """Pause all solving within the block; urgent : interrupt a `settle`, too."""
        return self._updates.alone(urgent)

    def _help(self, idle: bool, stopped: Stopped) -> bool:
        """Update in the background; return whether there may be more to do later."""
        if not idle and time.monotonic() < self._called + _PAUSE:
            return True  # a caller's own update would have to wait for it
        # If there was nothing to do now, there may be when the back end is idle.
        return self._updates.update(0.0, stopped, idle) is not None or not idle

    def _wake(self) -> None:
        """Wake the background thread: there may be something to do."""
        if self._background is not None:
            self._background.wake()

    # What is there.

    @property
    def revisions(self) -> Revisions:
        """The number that counts changes; a kept result is stale if its own number is lower."""
        return self._keeper.revisions

    @property
    def poses(self) -> Array:
        """All keyframes in the map of the first robot, (n, p), see `Snapshot.drawn`."""
        return self.snapshot().drawn

    def snapshot(self) -> Snapshot:
        """Return a snapshot of the back end, with the due loops as factors; it never changes."""
        return self._keeper.snapshot()

    def loop_states(self) -> LoopStates:
        """Return the state of each loop; first those in the graph, in its order."""
        return self.snapshot().loop_states()

    def robot(self, robot: int = 0) -> Robot | None:
        """Return the pose of a robot; None before its first odometry in this map."""
        return self._keeper.robot(robot)

    def moved(self, robot: int = 0) -> tuple[Array, Array]:
        """Return map -> odom of a robot as it was when this was asked before, and is, (1, p)."""
        return self._keeper.moved(robot)

    def counts(self) -> Counts:
        """Return the size of the graph, counts of messages, and the verdict on the map."""
        with self._keeper.reading() as builder:
            revision = self.revisions.now
            notes = builder.notes
            refused, told = dict(notes.refused), dict(notes.told)
            verdict = self._keeper.state.of_all, builder.keyframe_stamps
        if self._counted[0] != revision:
            self._counted = revision, self.snapshot().sizes()
        return Counts(self._counted[1], refused, told, *verdict)

    def behind(self) -> Behind:
        """Return the state of the background work."""
        state, _, size = self._keeper.look()
        return Behind.of(state, size.loops, time.monotonic(), self._updates.failing,
                         self._updates.at_rest)

    def news(self) -> list[str]:
        """Return new sentences on messages since the last call, see `GraphBuilder.notes`."""
        with self._keeper.reading() as builder:
            return builder.notes.news()

    def marginal_covariance(self, keyframe: int, seen_from: int | None = None) -> Array | None:
        """
        Return the covariance of a keyframe in its own axes, (d, d).

        It is that of the least squares map of the accepted factors, with the estimated noise,
        relative to the keyframe `seen_from`, if any, else to the first one, or to the world where
        absolute poses are accepted. None: the map does not have one of them, or its graph is too
        dense to be factored.
        """
        return self._keeper.covariance(keyframe, seen_from)


def _require_options(options: object) -> None:
    require(BackendOptions, 'options', options,
            'BackendOptions; BackendOptions.from_mapping makes them of a mapping')


def _require_robots(*robots: int) -> None:
    for robot in robots:
        require(int, 'the robot', robot, 'its number, 0 or more')
        if robot < 0:
            raise OptionError(f'the robot is {robot}, expected its number, 0 or more')


def _builder(backend: Backend) -> GraphBuilder:
    return GraphBuilder(backend.manifold, backend.options, base_frames=backend.base_frame_of)


_ALL: WeakSet[Backend] = WeakSet()
_at_rest = ExitStack()


def _before_fork() -> None:
    for backend in tuple(_ALL):
        _at_rest.enter_context(backend.alone(urgent=True))


# A forked process inherits locks, but not the threads that hold them, of ours and
# Python's. So all background work stops during a fork.
os.register_at_fork(before=_before_fork, after_in_parent=_at_rest.close,
                    after_in_child=_at_rest.close)
