# SPDX-License-Identifier: Apache-2.0
"""
The incremental back end: samples and loops in, optimised poses out, from as many threads as like.

It owns the growing graph, the poses and the dual. An update is three steps:

    problem = backend.snapshot().problem()
    improvement = improve(problem, options, budget)     # the work; touches nothing of the backend
    backend.adopt(improvement)                          # poses and dual for the next warm start

One lock is held to append, to take a snapshot and to adopt, never while solving, reading or
writing a file. A second one lets one thread at a time solve.

What is being solved for a map that is replaced meanwhile, or that `settle` is to solve in the
place of an update, is told to stop, and never adopted.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass

from l1slam_ros.core.errors import Interrupted, OptionError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample, require_finite
from l1slam_ros.core.online.background import Background
from l1slam_ros.core.online.graph_builder import GraphBuilder, GraphBuilderOptions
from l1slam_ros.core.online.loop_states import LoopStates
from l1slam_ros.core.online.parts import as_one, of_all
from l1slam_ros.core.online.snapshot import Optimised, Robot, SavedMap, Snapshot
from l1slam_ros.core.online.update import Improvement, improve, optimise
from l1slam_ros.core.options import Options, option
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions

# What poses live on, by the dimension of the world.
_MANIFOLDS: dict[int, Manifold] = {2: se2}

# Asked on the way, often: whether to stop.
Stopped = Callable[[], bool]


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
    moved : map -> odom before and after the last map that was adopted, (1, p) each

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
        self._lock, self._solving = threading.Lock(), threading.Lock()
        self._make_way = False
        self.maps = self._map = self._changes = self._samples = 0
        # The version at which an update found nothing to do.
        self._at_rest: object = None
        self._counted: tuple[object, dict[str, int]] = (None, {})
        self._background: Background | None = None
        self.moved = self.manifold.identity(1), self.manifold.identity(1)
        self._optimised: Optimised
        self.reset()
        self.maps = 0
        if background:
            self._background = Background(lambda stopped: self.update(stopped=stopped))

    def __enter__(self) -> 'Backend':
        """Return the back end; the end of the block closes it."""
        return self

    def __exit__(self, *_: object) -> None:
        """See `close`."""
        self.close()

    def close(self) -> None:
        """End updates in the background; raise what one of them raised, if any did."""
        if self._background is not None:
            self._background.close()

    def reset(self) -> None:
        """Forget everything."""
        self._replace(GraphBuilder(self.manifold, self._options),
                      Optimised.nothing(self.manifold.identity(0)))

    def saved(self) -> SavedMap | None:
        """Return all that another back end goes on from; None: there are no factors yet."""
        with self._lock:
            if self._builder.graph.between.is_absolute.all():
                return None
            now, growth = self._snapshot(), self._builder.grown()
        return SavedMap(growth, now.optimised.of_all(now.problem()), now.robust)

    def restore(self, saved: SavedMap) -> None:
        """Go on from what another back end has `saved`, in the place of the map there is."""
        builder = GraphBuilder(self.manifold, self._options)
        builder.restore(saved.growth)
        self._replace(builder, saved.as_judged(self._options.robust.enabled))

    def _replace(self, builder: GraphBuilder, optimised: Optimised) -> None:
        """Begin a map with the graph of a builder; what is made for the one before is left."""
        with self._lock:
            # Options may have changed since it was made.
            builder.options = self._options
            self._builder = builder
            self._begin_map(optimised)
        self._wake()

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
            self._map, self._version(), builder.graph.copy(), builder.gaps, builder.stamps,
            builder.odometry, self._map_to_odom_now(), builder.loop_rows, builder.loop_stamps,
            self._optimised, self._options.robust.enabled)

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
                self._optimised = self._optimised.unjudged()
            self._options = self._builder.options = options
        self._wake()

    def add_odometry(self, sample: OdometrySample) -> Array | None:
        """
        Add one sample; return the odometry frame seen from the map for it, (1, p).

        None: it is held, not used yet; see `GraphBuilder.add_odometry`.
        """
        require_finite(sample.pose3)
        with self._lock:
            self._samples += 1
            self._builder.add_odometry(sample)
            self._follow()
            map_to_odom = None if self._builder.held else self._map_to_odom_now()
        self._wake()
        return map_to_odom

    def robot(self) -> Robot | None:
        """Return where the robot is; None: no odometry has said yet where it is in this map."""
        with self._lock:
            last = self._builder.last
            return Robot(last.stamp, last.pose, self._map_to_odom_now()) if last else None

    def begin_anew(self) -> None:
        """Forget the only sample so far; see `GraphBuilder.begin_anew`."""
        with self._lock:
            self._builder.begin_anew()
            self._follow()

    def _follow(self) -> None:
        """Begin a map where the builder did."""
        if self._builder.graph is not self._graph:
            self._begin_map(Optimised.nothing(self.manifold.identity(0)))

    def _begin_map(self, optimised: Optimised) -> None:
        """Leave what was made of the graph that there was, for what is known of another."""
        self.maps += 1
        self._map += 1
        self._changes += 1
        self._graph, self._optimised = self._builder.graph, optimised
        self._map_to_odom: tuple[Array, Array] | None = None

    def add_loop(self, loop: LoopClosure) -> None:
        """Add one loop closure; see `GraphBuilder.add_loop`."""
        require_finite(loop.pose3)
        with self._lock:
            self._changes += 1
            self._builder.add_loop(loop)
        self._wake()

    def update(self, budget: float = 0.1, stopped: Stopped = lambda: False) -> Improvement | None:
        """
        Improve the map for about `budget` seconds; None: there was nothing to do.

        Raises
        ------
        Interrupted : told to stop, or to make way for `settle`, or the map was replaced.

        """
        with self._solving:
            with self._lock:
                if self._at_rest == self._version():
                    return None
                now, solver = self._snapshot(), self._options.solver
            problem = now.problem()
            if problem.settled or not problem.graph.n_poses:
                self._at_rest = now.version
                return None

            def check() -> None:
                if self._make_way or stopped() or problem.map != self._map:
                    raise Interrupted

            improvement = of_all(improve(as_one(problem), solver, budget, check), problem)
            check()
            self.adopt(improvement)
        return improvement

    def settle(self, stopped: Stopped = lambda: False) -> Improvement | None:
        """
        Judge all loops and solve to the end; None: there are no factors yet.

        An update that is under way makes way.

        Raises
        ------
        Interrupted : told to stop, or the map was replaced.

        """
        self._make_way = True
        with self._solving:
            self._make_way = False
            with self._lock:
                now, solver = self._snapshot(), self._options.solver
            problem = now.problem()
            if not len(problem.graph.between):
                return None

            def check() -> None:
                if stopped() or problem.map != self._map:
                    raise Interrupted

            improvement = of_all(optimise(as_one(problem), solver, check), problem)
            check()
            self.adopt(improvement)
        self._wake()
        return improvement

    def adopt(self, improvement: Improvement) -> None:
        """
        Take over what was made of a snapshot; keyframes since then follow along.

        What was made when loops were judged otherwise is left.

        Raises
        ------
        Interrupted : it was made for a map that is there no more.
        ArithmeticError : it is not finite; nothing is taken over.

        """
        with self._lock:
            if improvement.map != self._map:
                raise Interrupted
            if improvement.robust == self._options.robust.enabled:
                before = self._map_to_odom_now()
                self._optimised = improvement.taken_over(
                    self._optimised, self._options.solver.outer_tolerance)
                self._map_to_odom = None
                self.moved = before, self._map_to_odom_now()
                self._changes += 1
            self.maps += 1

    def alone(self, work: Callable[[], bool]) -> bool:
        """Do some work while nothing is being solved, nor begins to be; return what it returns."""
        with self._solving:
            return work()

    def _map_to_odom_now(self) -> Array:
        """Return the odometry frame seen from the map: what the last optimised keyframe says."""
        poses, manifold, offset = self._optimised.poses, self.manifold, self._builder.offset
        last = len(poses) - 1
        if last < 0:
            return manifold.identity(1)
        # Asked for with every sample: worked out when an update or a new offset changes it.
        if self._map_to_odom is None or self._map_to_odom[0] is not offset:
            odometry = self._builder.odometry[last : last + 1]
            to_kept = manifold.compose(poses[last:], manifold.inverse(odometry))
            self._map_to_odom = offset, manifold.compose(to_kept, offset)
        return self._map_to_odom[1]

    def _wake(self) -> None:
        """Tell the background that there may be something to do."""
        if self._background is not None:
            self._background.wake()
