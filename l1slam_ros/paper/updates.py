# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What an update costs while the map grows: Figure 5, and what `benchmarks/incremental.py` measures.

In: a graph, fed to the back end pose by pose, in turn with a peer if there is one. Out: the
seconds of each update, and the maps on the way. Seconds are of the thread's processor time: others
on the machine do not lengthen them, and what goes on behind is counted by itself.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph, turned
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.graph.recording import recorded
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.running.backend import Backend, BackendOptions, RobustOptions
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.files import invented_stamps
from l1slam_ros.io.free_memory import give_back_freed_memory

# [s] What is left to the workers after the last keyframe; the driver lags no more than this.
IDLE, _LAG = 1.0, 0.1
# As in City10k, the graph of the figure in the paper.
_EDGES_PER_POSE = 2.07
# Everything is called before it is timed, on a world of so many keyframes.
_WARM_UP = 200
# The batch is solved at so many sizes of the map.
_BATCHES = 40

# Gives the peer a keyframe; the seconds of its update, [] once its time was up.
Peer = Callable[[int], list[float]]


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

    def first(self, accepted: Mask, poses: Array) -> 'Kept':
        """Return it as it was with fewer factors, accepted (k,), and poses (n, p)."""
        part = first_of(self.graph, len(poses), np.arange(len(accepted)))
        return Kept(part, accepted, poses)


@dataclass
class Updates:
    """
    What was measured of one graph.

    ours, peer : seconds of each update; the peer's time may have been up before the end; behind :
    seconds of our other threads; elapsed : wall time [s]; marks : what was accepted at regular
    distances, and the poses; at_rest : a second after the last keyframe.
    """

    ours: list[float] = field(default_factory=list)
    peer: list[float] = field(default_factory=list)
    behind: float = 0.0
    elapsed: float = 0.0
    marks: list[tuple[Mask, Array]] = field(default_factory=list)
    at_rest: Kept | None = None

    @cached_property
    def on_the_way(self) -> list[Kept]:
        """
        The maps at the marks, the last one at the last keyframe.

        Made when asked for: each graph of a growing one that is kept holds all its arrays, and
        they would be counted as the back end's memory.
        """
        return [self.at_rest.first(*mark) for mark in self.marks] if self.at_rest else []


def first_of(graph: FactorGraph, poses: int, rows: Indices) -> FactorGraph:
    """Return the graph of the first keyframes, and of factors (k,) between them."""
    factors = graph.between
    part = FactorGraph(graph.manifold, poses)
    part.append_between(factors.i[rows], factors.j[rows], factors.measurement[rows],
                        factors.sqrt_information[rows])
    return part


@dataclass(frozen=True)
class Drive:
    """
    What a robot measures on the way, that of a graph.

    keyframes, dimension : how many, of which world; messages : each keyframe's odometry and the
    loops that end there, ten keyframes a second
    """

    keyframes: int
    dimension: int
    messages: Iterable[tuple[OdometrySample, list[LoopClosure]]]

    @staticmethod
    def of(graph: FactorGraph) -> 'Drive':
        """Return that of a graph."""
        forward = turned(graph, graph.between.i > graph.between.j)
        stamps = invented_stamps(graph.n_poses).tolist()
        dimension = int(graph.manifold.positions(graph.manifold.identity(1)).shape[1])
        return Drive(graph.n_poses, dimension, recorded(forward, stamps))


def run_updates(drive: Drive, peer: Peer | None, rate: float, maps: int,
                robust: bool = True, advance: Callable[[], None] = lambda: None) -> Updates:
    """
    Feed the back end with a drive, an update after each keyframe, and the peer in turn.

    rate : keyframes per second, fewer where the updates of both take longer; maps : how many are
    kept; advance : called after each keyframe
    """
    options = BackendOptions(KeyframeOptions(0.0, 0.0, 0.0), OdometryOptions('increment'),
                             robust=RobustOptions(robust))
    kept = set(np.linspace(drive.keyframes / maps, drive.keyframes, maps).astype(int))
    found = Updates()
    with Backend(options, drive.dimension) as backend:
        began = time.perf_counter()
        whole = time.process_time()
        alone = time.thread_time()
        due = began
        for k, (sample, loops) in enumerate(drive.messages):
            backend.add_odometry(sample)
            for loop in loops:
                backend.add_loop(loop)
            before = time.thread_time()
            backend.update(0.0)
            found.ours.append(time.thread_time() - before)
            if peer:
                found.peer += peer(k)
            if k + 1 in kept:
                now = backend.snapshot()
                found.marks.append((now.judgement.accepted, now.poses))
                del now
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


def measure_growth(keyframes: int, rate: float, rng: np.random.Generator,
                   advance: Callable[[], None] = lambda: None) -> tuple[Updates, Array]:
    """
    Return what updates cost in a world in the proportions of City10k, and batch solves on the way.

    The batch, in seconds (k,) at each of the snapshots, is Gauss-Newton on all that has come, from
    the map as it is, ordered anew.
    """
    give_back_freed_memory()
    run_updates(Drive.of(_world(_WARM_UP, rng)), None, np.inf, 1)
    graph = _world(keyframes, rng)
    updates = run_updates(Drive.of(graph), None, rate, _BATCHES, advance=advance)
    return updates, np.array([_batch_seconds(now) for now in updates.on_the_way])


def _world(keyframes: int, rng: np.random.Generator) -> FactorGraph:
    return simulate_world(keyframes, round(_EDGES_PER_POSE * keyframes), WorldOptions(), rng).graph


def _batch_seconds(now: Kept) -> float:
    began = time.process_time()
    minimise_l2(now.graph, now.poses, LeastSquaresOptions(), cholesky_of(now.graph))
    return time.process_time() - began
