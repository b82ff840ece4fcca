# SPDX-License-Identifier: Apache-2.0
"""
What an update costs while the map grows: Figure 5, and what `benchmarks/incremental.py` measures.

In: a graph, fed to the back end pose by pose, in turn with another one where there is one.
Out: the seconds of each update, and the maps on the way. Seconds are of the thread's processor
time: others on the machine do not lengthen them, and what goes on behind is counted by itself.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph, turned
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.graph.recording import recorded
from l1slam_ros.core.online.backend import Backend, BackendOptions, RobustOptions
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.compilation import load
from l1slam_ros.io.trajectory import invented_stamps

# [s] What is left to the workers after the last keyframe; the driver lags no more than this.
IDLE, _LAG = 1.0, 0.1
# As in City10k, the graph of the figure in the paper.
_EDGES_PER_POSE = 2.07
# Everything is called before it is timed, on a world of so many keyframes.
_WARM_UP = 200
# The batch is solved at so many sizes of the map.
_BATCHES = 40


@dataclass(frozen=True)
class Kept:
    """The graph at one moment, what is believed of it, (m,) bool, and its map, (n, p)."""

    graph: FactorGraph
    accepted: Mask
    poses: Array

    @staticmethod
    def of(backend: Backend) -> 'Kept':
        """Return what a back end has; its snapshot would hold the factors of its front, too."""
        now = backend.snapshot()
        return Kept(now.graph, now.judgement.accepted, now.poses)


@dataclass
class Updates:
    """
    What was measured of one graph.

    ours, peer : seconds of each update; the peer's time may have been up before the end; behind :
    seconds of our other threads; elapsed : wall time [s]; on_the_way : maps at regular distances,
    the last one at the last keyframe; at_rest : a second later.
    """

    ours: list[float] = field(default_factory=list)
    peer: list[float] = field(default_factory=list)
    behind: float = 0.0
    elapsed: float = 0.0
    on_the_way: list[Kept] = field(default_factory=list)
    at_rest: Kept | None = None


def measurements(graph: FactorGraph) -> Iterator[tuple[OdometrySample, list[LoopClosure]]]:
    """Yield each keyframe's odometry and the loops that end there, ten keyframes a second."""
    forward = turned(graph, graph.between.i > graph.between.j)
    return recorded(forward, invented_stamps(graph.n_poses).tolist())


def run_updates(graph: FactorGraph, rate: float, maps: int, robust: bool = True,
                advance: Callable[[], None] = lambda: None,
                peer: Callable[[int], list[float]] = lambda k: []) -> Updates:
    """
    Feed the back end with a graph, an update after each keyframe, and a peer in turn.

    rate : keyframes per second, fewer where the updates of both take longer; maps : how many are
    kept; advance : called after each keyframe; peer : adds keyframe k and its factors, too, and
    returns the seconds of that, none once its time is up
    """
    options = BackendOptions(KeyframeOptions(0.0, 0.0, 0.0), OdometryOptions('increment'),
                             robust=RobustOptions(robust))
    kept = set(np.linspace(graph.n_poses / maps, graph.n_poses, maps).astype(int))
    found = Updates()
    with Backend(options, dimension_of(graph)) as backend:
        began, whole, alone = time.perf_counter(), time.process_time(), time.thread_time()
        due = began
        for k, (sample, loops) in enumerate(measurements(graph)):
            backend.add_odometry(sample)
            for loop in loops:
                backend.add_loop(loop)
            before = time.thread_time()
            backend.update(0.0)
            found.ours.append(time.thread_time() - before)
            found.peer += peer(k)
            if k + 1 in kept:
                found.on_the_way.append(Kept.of(backend))
            advance()
            due = max(due + 1 / rate, time.perf_counter() - _LAG)
            time.sleep(max(due - time.perf_counter(), 0.0))
        found.elapsed = time.perf_counter() - began
        found.behind = (time.process_time() - whole) - (time.thread_time() - alone)
        end = time.perf_counter() + IDLE
        while backend.update(0.1) is not None and time.perf_counter() < end:
            pass
        found.at_rest = Kept.of(backend)
    return found


def dimension_of(graph: FactorGraph) -> int:
    """Return 2 or 3, as the back end calls it."""
    return int(graph.manifold.positions(graph.manifold.identity(1)).shape[1])


def measure_growth(keyframes: int, rate: float, rng: np.random.Generator,
                   advance: Callable[[], None] = lambda: None) -> tuple[Updates, Array]:
    """
    Return what updates cost in a world in the proportions of City10k, and batch solves on the way.

    The batch, in seconds (k,) at each of the snapshots, is Gauss-Newton on all that has come, from
    the map as it is, ordered anew.
    """
    load()
    run_updates(_world(_WARM_UP, rng), np.inf, 1)
    graph = _world(keyframes, rng)
    updates = run_updates(graph, rate, _BATCHES, advance=advance)
    return updates, np.array([_batch_seconds(now) for now in updates.on_the_way])


def _world(keyframes: int, rng: np.random.Generator) -> FactorGraph:
    return simulate_world(keyframes, round(_EDGES_PER_POSE * keyframes), WorldOptions(), rng).graph


def _batch_seconds(now: Kept) -> float:
    began = time.process_time()
    minimise_l2(now.graph, now.poses, LeastSquaresOptions(), cholesky_of(now.graph))
    return time.process_time() - began
