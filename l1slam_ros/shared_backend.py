# SPDX-License-Identifier: Apache-2.0
"""
The back end behind a lock: callbacks of one thread feed it, a worker of another improves it.

The lock is held to append and to take or hand back a snapshot, never while solving. Everything
that replaces the map (`update`, `optimise`, `reset`, `load`) is called by the worker alone.
"""

import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from l1slam_ros.core.backend import (
    LOOP_STATES,
    Backend,
    BackendOptions,
    Improvement,
    LoopStates,
    improve,
    optimise,
)
from l1slam_ros.core.errors import FileError
from l1slam_ros.core.graph import BetweenFactors
from l1slam_ros.core.manifold import Array, Indices, Manifold
from l1slam_ros.core.measurements import LoopClosure, OdometrySample
from l1slam_ros.io.graph_file import GraphRecord, read_graph_file, write_graph_file


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
    A `core.backend.Backend` for two threads.

    Parameters
    ----------
    manifold : what the poses live on
    options : see `BackendOptions`

    """

    def __init__(self, manifold: Manifold, options: BackendOptions):
        self._manifold = manifold
        self._options = options
        self._backend = Backend(manifold, options)
        self._lock = threading.Lock()

    def set_options(self, options: BackendOptions) -> None:
        """Work by other options from now on."""
        with self._lock:
            self._options = options
            self._backend.set_options(options)

    def add_odometry(self, sample: OdometrySample) -> bool:
        """Add one sample; return whether it is used: `GraphGrowth.add_odometry` may hold it."""
        with self._lock:
            self._backend.add_odometry(sample)
            return not self._backend.growth.held

    def begin_anew(self) -> None:
        """Forget the only sample so far; see `GraphGrowth.begin_anew`."""
        with self._lock:
            self._backend.growth.begin_anew()

    def news(self) -> list[str]:
        """Return what is new in the notes on messages; see `GraphGrowth.notes`."""
        with self._lock:
            return self._backend.growth.notes.news()

    def add_loop(self, loop: LoopClosure) -> None:
        """Add one loop closure; see `GraphGrowth.add_loop`."""
        with self._lock:
            self._backend.add_loop(loop)

    def state(self) -> MapState:
        """Return the map as it is now."""
        with self._lock:
            backend = self._backend
            return MapState(backend.growth.stamps, backend.poses, backend.map_to_odom,
                            backend.growth.graph.between, backend.loop_states())

    def loop_states(self) -> LoopStates:
        """Return what has become of the loops by now."""
        with self._lock:
            return self._backend.loop_states()

    def counts(self) -> tuple[dict[str, int], dict[str, int]]:
        """Return the sizes of the graph, and how many loops were refused for which cause."""
        with self._lock:
            growth = self._backend.growth
            sizes = {'keyframes': growth.graph.n_poses, 'factors': len(growth.graph.between)}
            loops = np.bincount(self._backend.loop_states().state, minlength=len(LOOP_STATES))
            sizes |= {f'{name}_loops': int(count)
                      for name, count in zip(LOOP_STATES, loops, strict=True)}
            return sizes, dict(growth.refused)

    def update(self, budget: float) -> Improvement | None:
        """Improve the map for about `budget` seconds; None: there was nothing to do."""
        with self._lock:
            problem = self._backend.problem()
            solver = self._options.solver
        if problem.settled or not problem.graph.n_poses:
            return None
        return self._adopt(improve(problem, solver, budget))

    def optimise(self) -> Improvement | None:
        """Solve to the end, from the map and from the seed; None: there are no factors yet."""
        with self._lock:
            problem = self._backend.problem()
            solver = self._options.solver
        if not len(problem.graph.between):
            return None
        return self._adopt(optimise(problem, solver))

    def _adopt(self, improvement: Improvement) -> Improvement:
        with self._lock:
            self._backend.adopt(improvement)
        return improvement

    def reset(self) -> None:
        """Forget everything."""
        with self._lock:
            self._backend = Backend(self._manifold, self._options)

    def save(self, path: Path) -> int:
        """Write graph, poses, stamps and trust as g2o and beside it; return how many keyframes."""
        with self._lock:
            graph, poses = self._backend.growth.graph.copy(), self._backend.poses
            stamps = self._backend.growth.stamps
        if not len(graph.between):
            raise FileError(path, 'there is no graph yet to be saved')
        write_graph_file(path, GraphRecord(graph, poses, np.arange(len(poses)), stamps))
        return len(poses)

    def load(self, path: Path) -> int:
        """Replace the map by a saved one; odometry goes on from its last keyframe."""
        record = read_graph_file(path)
        if record.poses is None or record.stamps is None:
            raise FileError(path, 'has no poses or no stamps beside it; expected a saved map')
        if len(record.graph.prior):
            raise FileError(path, 'has prior factors, which a growing map has no rows for; '
                            'expected a saved map')
        backend = Backend(self._manifold, self._options)
        backend.restore(record.graph, record.poses, record.stamps)
        with self._lock:
            self._backend = backend
        return len(record.poses)
