# SPDX-License-Identifier: Apache-2.0
"""
The incremental back end: samples and loops in, optimised poses out, from many threads.

It owns the growing graph; how its map is kept is told in `upkeep`.
"""

import os
from contextlib import ExitStack
from dataclasses import dataclass
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
from l1slam_ros.core.online.graph_builder import GraphBuilder, GraphBuilderOptions
from l1slam_ros.core.online.odometry.odometry_stream import BaseFrame
from l1slam_ros.core.online.snapshot import Behind, LoopStates, Optimised, Robot, SavedMap
from l1slam_ros.core.online.upkeep.threads import Background
from l1slam_ros.core.online.upkeep.upkeep import Stopped as Stopped
from l1slam_ros.core.online.upkeep.upkeep import Upkeep
from l1slam_ros.core.options import Options, option
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions

# What poses live on, by the dimension of the world.
_MANIFOLDS: dict[int, Manifold] = {2: se2, 3: se3}
# [s] In the background nothing has come for a while when it has not for so long.
_PAUSE = 0.2


@dataclass(frozen=True)
class RobustOptions(Options):
    """Whether loops are doubted."""

    enabled: bool = option(
        True, 'believe a loop only once others, or the odometry, vouch for it; without, every '
        'loop is used at once')


@dataclass(frozen=True)
class BackendOptions(GraphBuilderOptions):
    """Everything the back end can be told; a mapping may say what its node is told besides."""

    PASSED_OVER = OF_THE_NODE

    solver: OptimiserOptions = OptimiserOptions()
    robust: RobustOptions = RobustOptions()


class Backend(Upkeep):
    """
    Keeps a map while it grows.

    Parameters
    ----------
    options : see `BackendOptions`
    dimension : of the world, 2 or 3
    background : update in a thread of its own whenever there is something new, until `close` or
        the end of the `with` block; not in a process that is forked from this one

    Attributes
    ----------
    manifold : what the poses live on
    base_frame : of the robot, as far as is known; no reset forgets it

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
        self.manifold, self._options = _MANIFOLDS[dimension], options
        super().__init__(options.solver, options.robust.enabled)
        self.base_frame = BaseFrame(options.base_frame)
        self._counted: tuple[object, dict[str, int]] = (None, {})
        self._background: Background | None = None
        self._graph: object = None
        self._graphs = 0
        self.reset()
        self.maps = 0
        if background:
            self._background = Background(
                lambda idle, stopped: self._update(0.0, stopped, idle), _PAUSE)
        _ALL.add(self)

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
        self._replace(self._new_builder(), Optimised.nothing(self.manifold.identity(0)))

    def saved(self) -> SavedMap | None:
        """Return all that another back end goes on from; None: there are no factors yet."""
        with self._standing() as now:
            if now.graph.between.is_absolute.all():
                return None
            state = self._builder.grown()
            number = self._graphs
        return SavedMap(state, now.known(), now.robust, number)

    def restore(self, saved: SavedMap) -> int:
        """
        Go on from what another back end has `saved`, in the place of the map there is.

        Return the number of its graph in this one, see `SavedMap`.
        """
        found, made = saved.builder.graph.manifold, saved.optimised
        if found is not self.manifold:
            raise GraphError(f'a map of {found.NAME}, expected one of {self.manifold.NAME}')
        builder = self._new_builder()
        builder.restore(saved.builder)
        return self._replace(builder, made if saved.robust == self._robust else made.unjudged())

    def _new_builder(self) -> GraphBuilder:
        return GraphBuilder(self.manifold, self._options, base_frame=self.base_frame)

    def _replace(self, builder: GraphBuilder, optimised: Optimised) -> int:
        """Begin a map with the graph of a builder; what is made for the one before is left."""
        with self._lock:
            # Options may have changed since it was made.
            builder.options = self._options
            self._builder = builder
            self._begin_map(optimised)
            number = self._graphs
        self._wake()
        return number

    @property
    def poses(self) -> Array:
        """All keyframes in the map frame, (n, p): the optimised ones, then odometry from there."""
        return self.snapshot().poses

    def loop_states(self) -> LoopStates:
        """Return what has become of each loop, those of the graph first, in its order."""
        return self.snapshot().loop_states()

    def counts(self) -> tuple[dict[str, int], dict[str, int]]:
        """Return the sizes of the graph, and how many loops were refused for which cause."""
        with self._lock:
            version, refused = self._version(), dict(self._builder.notes.refused)
        if self._counted[0] != version:
            self._counted = version, self.snapshot().sizes()
        return self._counted[1], refused

    def told(self) -> dict[str, int]:
        """Return how often the odometry did not go on as robots move; see `Notes.told`."""
        with self._lock:
            return dict(self._builder.notes.told)

    def behind(self) -> Behind:
        """Return what goes on behind updates."""
        with self._lock:
            return self._live.behind()

    def marginal_covariance(self, keyframe: int) -> Array | None:
        """
        Return the covariance of a keyframe in its own axes, (d, d).

        Exact for the least squares map of what is accepted, the noise as it was found: relative
        to the first keyframe, or to the world if absolute poses are believed. None: no factored
        map has the keyframe, or it is too dense to be factored.
        """
        with self._front:
            front = self._live.front
            known = front is not None and 0 <= keyframe < front.keyframes
            return front.covariance(keyframe) if front and known else None

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
        _require_options(options)
        with self._standing() as now:
            self._changes += 1
            doubted, self._robust = self._robust, options.robust.enabled
            self._options = self._builder.options = options
            self._solver = options.solver
            if doubted != self._robust:
                self._begin(self._builder, now.known().unjudged())
        self._wake()

    def add_odometry(self, sample: OdometrySample) -> bool:
        """Add one sample; return whether it is used, see `GraphBuilder.add_odometry`."""
        require_sound(sample, OdometrySample)
        with self._lock:
            self._samples += 1
            try:
                used = self._builder.add_odometry(sample)
            finally:  # of two samples the second may be refused
                self._begin_map()
        self._wake()
        return used

    def robot(self) -> Robot | None:
        """Return where the robot is; None: no odometry has said yet where it is in this map."""
        with self._lock:
            last = self._builder.stream.last
            return Robot(last.stamp, last.pose, self._map_to_odom_now()) if last else None

    def _begin_map(self, optimised: Optimised | None = None) -> None:
        """Begin with what is known of another map; None: with nothing, if the builder did."""
        if optimised is None and self._builder.graph is self._graph:
            return
        self.maps += 1
        self._graphs += 1
        self._graph = self._builder.graph
        self._begin(self._builder, optimised or Optimised.nothing(self.manifold.identity(0)))

    def add_loop(self, loop: LoopClosure) -> None:
        """Add one loop closure, turned round if it leads back; see `GraphBuilder.add_loop`."""
        require_sound(loop, LoopClosure)
        loop = in_order(loop)
        with self._lock:
            self._changes += 1
            self._builder.add_loop(loop)
        self._wake()

    def _on_end(self) -> None:
        super()._on_end()
        self._wake()

    def _wake(self) -> None:
        """Tell the background that there may be something to do."""
        if self._background is not None:
            self._background.wake()


def _require_options(options: object) -> None:
    require(BackendOptions, 'options', options,
            'BackendOptions; BackendOptions.from_mapping makes them of a mapping')


_ALL: WeakSet[Backend] = WeakSet()
_at_rest = ExitStack()


def _before_fork() -> None:
    for backend in tuple(_ALL):
        _at_rest.enter_context(backend._alone())


def _in_child() -> None:
    for backend in tuple(_ALL):
        backend._background = None
    _at_rest.close()


# Threads do not come along into a process that is forked, but what they have locked does, of ours,
# numba's and Python's: so nothing is at work meanwhile.
os.register_at_fork(before=_before_fork, after_in_parent=_at_rest.close, after_in_child=_in_child)
