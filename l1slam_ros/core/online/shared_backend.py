# SPDX-License-Identifier: Apache-2.0
"""
The back end behind a lock: callbacks feed it, the solver improves it, services replace it.

Three threads meet here. The lock is held to append, to take a snapshot and to hand one back,
never while solving, reading or writing a file. A second lock lets one thread at a time solve.

What is being solved for a map that is replaced meanwhile, or that `optimise` is to solve in the
place of an update, is told to stop, and never adopted.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.errors import Interrupted
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import BetweenFactors, FactorGraph
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.online.backend import Backend, BackendOptions, Improvement, improve, optimise
from l1slam_ros.core.online.loop_states import LOOP_STATES, LoopStates
from l1slam_ros.core.online.snapshot import Snapshot

# Asked on the way, often: whether to stop.
Stopped = Callable[[], bool]


@dataclass(frozen=True)
class MapState:
    """
    The map as it is.

    stamps (n,) [ns] and poses (n, p) of all keyframes; map_to_odom (1, p); the factors, and what
    has become of the loops.
    """

    stamps: Indices
    poses: Array
    map_to_odom: Array
    factors: BetweenFactors
    loops: LoopStates


class SharedBackend:
    """
    A `core.backend.Backend` for several threads.

    Parameters
    ----------
    manifold : what the poses live on
    options : see `BackendOptions`

    Attributes
    ----------
    maps : how many maps there were: one more with each that was adopted or took another's place

    """

    def __init__(self, manifold: Manifold, options: BackendOptions):
        self._manifold = manifold
        self._options = options
        self._backend = Backend(manifold, options)
        self.maps = 0
        self._lock = threading.Lock()
        self._solving = threading.Lock()
        self._make_way = False
        # The version at which an update found nothing to do.
        self._at_rest: object = None
        self._counted: tuple[object, dict[str, int]] = (None, {})

    @property
    def version(self) -> object:
        """Other than an earlier one where there may be something new to tell."""
        with self._lock:
            return self._backend, self._backend.version

    def set_options(self, options: BackendOptions) -> None:
        """Work by other options from now on."""
        with self._lock:
            self._options = options
            self._backend.set_options(options)

    def add_odometry(self, sample: OdometrySample) -> Array | None:
        """
        Add one sample; return map_to_odom (1, p) for it.

        None: it is held, not used yet; see `GraphBuilder.add_odometry`.
        """
        with self._lock:
            self._backend.add_odometry(sample)
            return None if self._backend.builder.held else self._backend.map_to_odom

    def begin_anew(self) -> None:
        """Forget the only sample so far; see `GraphBuilder.begin_anew`."""
        with self._lock:
            self._backend.begin_anew()

    def news(self) -> list[str]:
        """Return what is new in the notes on messages; see `GraphBuilder.notes`."""
        with self._lock:
            return self._backend.builder.notes.news()

    def add_loop(self, loop: LoopClosure) -> None:
        """Add one loop closure; see `GraphBuilder.add_loop`."""
        with self._lock:
            self._backend.add_loop(loop)

    def state(self) -> MapState:
        """Return the map as it is now."""
        now = self.snapshot()
        return MapState(now.stamps, now.poses, now.map_to_odom, now.graph.between,
                        now.loop_states())

    def loop_states(self) -> LoopStates:
        """Return what has become of the loops by now."""
        return self.snapshot().loop_states()

    def counts(self) -> tuple[dict[str, int], dict[str, int]]:
        """Return the sizes of the graph, and how many loops were refused for which cause."""
        with self._lock:
            version = self._backend, self._backend.version
            refused = dict(self._backend.builder.refused)
        if self._counted[0] != version:
            now = self.snapshot()
            sizes = {'keyframes': now.graph.n_poses, 'factors': len(now.graph.between)}
            loops = np.bincount(now.loop_states().state, minlength=len(LOOP_STATES))
            sizes |= {f'{name}_loops': int(count)
                      for name, count in zip(LOOP_STATES, loops, strict=True)}
            self._counted = version, sizes
        return self._counted[1], refused

    def snapshot(self) -> Snapshot:
        """Return the back end as it is now, the due loops in its graph, to be read at leisure."""
        with self._lock:
            return self._backend.snapshot()

    def alone(self, work: Callable[[], bool]) -> bool:
        """Do some work while nothing is being solved, nor begins to be; return what it returns."""
        with self._solving:
            return work()

    def update(self, budget: float, stopped: Stopped) -> Improvement | None:
        """
        Improve the map for about `budget` seconds; None: there was nothing to do.

        Raises
        ------
        Interrupted : told to stop, or to make way for `optimise`, or the map was replaced.

        """
        with self._solving:
            with self._lock:
                backend, solver = self._backend, self._options.solver
                if self._at_rest == (backend, backend.version):
                    return None
                now = backend.snapshot()
            problem = now.problem()
            if problem.settled or not problem.graph.n_poses:
                self._at_rest = backend, now.version
                return None

            def check() -> None:
                if self._make_way or stopped() or backend is not self._backend:
                    raise Interrupted

            return self._adopt(improve(problem, solver, budget, check), backend, check)

    def optimise(self, stopped: Stopped) -> Improvement | None:
        """
        Solve to the end, from the map and from the seed; None: there are no factors yet.

        An update that is under way makes way.

        Raises
        ------
        Interrupted : told to stop.

        """
        self._make_way = True
        with self._solving:
            self._make_way = False
            with self._lock:
                backend, solver = self._backend, self._options.solver
                now = backend.snapshot()
            problem = now.problem()
            if not len(problem.graph.between):
                return None

            def check() -> None:
                if stopped() or backend is not self._backend:
                    raise Interrupted

            return self._adopt(optimise(problem, solver, check), backend, check)

    def _adopt(self, improvement: Improvement, backend: Backend,
               check: Callable[[], None]) -> Improvement:
        """Take an improvement over into the back end it was made for, unless told to stop."""
        with self._lock:
            check()
            backend.adopt(improvement)
            self.maps += 1
        return improvement

    def reset(self) -> None:
        """Forget everything."""
        self._replace(Backend(self._manifold, self._options))

    def restore(self, graph: FactorGraph, poses: Array, stamps: Indices) -> None:
        """Replace the map by one of an earlier run; see `Backend.restore`."""
        backend = Backend(self._manifold, self._options)
        backend.restore(graph, poses, stamps)
        self._replace(backend)

    def _replace(self, backend: Backend) -> None:
        with self._lock:
            # Options may have changed since it was made.
            backend.set_options(self._options)
            self._backend = backend
            self.maps += 1
