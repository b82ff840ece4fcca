# SPDX-License-Identifier: Apache-2.0
"""
What an update costs while the map grows, and how good the map is.

    python benchmarks/incremental.py GRAPH [--lies KIND] [--share .3] [--rate 200] [--poses N]
                                     [--no-robust] [--no-peer]

Feeds the factors of a graph file in order of time to the back end, pose by pose, at so many
keyframes per second, with an update after each; after every update of ours gtsam's ISAM2 gets the
same pose, in the same thread, without the false loops. Milliseconds are of the thread's processor
time. At the checkpoints the L1 cost is compared with the optimum of the factors believed there,
and false loops that are held are counted, both after the run.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import peer_environment

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.graph.spanning_tree import odometry_poses, pair_key
from l1slam_ros.core.names import KINDS_OF_FALSE_LOOPS
from l1slam_ros.core.online.backend import Backend, BackendOptions, RobustOptions
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.online.snapshot import Snapshot
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.exact import minimise_interior_point
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS, insert_loops
from l1slam_ros.io.compilation import fill_cache
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file
from l1slam_ros.io.trajectory import invented_stamps

CHECKPOINTS = 20
# [s] What is left to the workers before the last checkpoint.
_IDLE = 1.0
# [m or rad] ISAM2 linearises again what has moved by more, after each pose.
_RELINEARISE = 0.1


def dimension_of(graph: FactorGraph) -> int:
    """Return 2 or 3, as the back end calls it."""
    return graph.manifold.positions(graph.manifold.identity(1)).shape[1]


def measurements(record: GraphRecord) -> Iterator[tuple[OdometrySample, list[LoopClosure]]]:
    """Yield each keyframe's odometry and the loops that end at it."""
    graph, factors = record.graph, record.graph.between
    stamps = invented_stamps(graph.n_poses)
    manifold = graph.manifold
    chain, measured = map(manifold.to_pose3, (odometry_poses(graph), factors.measurement))
    root = factors.sqrt_information
    covariance = np.zeros((len(factors), 6, 6))
    rows = np.array(manifold.COVARIANCE_ROWS)
    covariance[:, rows[:, None], rows] = np.linalg.inv(root.transpose(0, 2, 1) @ root)
    ends = np.maximum(factors.i, factors.j)
    step = {int(ends[k]): k for k in np.flatnonzero(factors.is_odometry)}
    loops: dict[int, list[LoopClosure]] = {}
    for k in np.flatnonzero(~factors.is_odometry):
        loops.setdefault(int(ends[k]), []).append(LoopClosure(
            stamps[factors.i[k]], stamps[factors.j[k]], measured[k], covariance[k]))
    none = np.zeros((6, 6))
    for k in range(graph.n_poses):
        motion = covariance[step[k]] if k else none
        yield OdometrySample(int(stamps[k]), chain[k], motion, none), loops.get(k, [])


class Isam2:
    """The peer: L2, every loop believed."""

    def __init__(self, graph: FactorGraph):
        import gtsam

        self._gtsam, self._factors, self._k = gtsam, graph.between, graph.manifold.TANGENT_SIZE
        self._Pose, self._Between, self._Prior = (
            (gtsam.Pose2, gtsam.BetweenFactorPose2, gtsam.PriorFactorPose2) if self._k == 3 else
            (gtsam.Pose3, gtsam.BetweenFactorPose3, gtsam.PriorFactorPose3))
        options = gtsam.ISAM2Params()
        options.setRelinearizeThreshold(_RELINEARISE)
        options.relinearizeSkip = 1
        self._isam, self._at = gtsam.ISAM2(options), self._Pose()
        ends = np.maximum(self._factors.i, self._factors.j)
        self._rows = np.split(np.argsort(ends, kind='stable'),
                              np.searchsorted(np.sort(ends), np.arange(1, graph.n_poses)))
        self._odometry = self._factors.is_odometry

    def update(self, k: int) -> float:
        """Add keyframe k and its factors; return the seconds that the update took."""
        gtsam, new, values, step = self._gtsam, self._gtsam.NonlinearFactorGraph(), \
            self._gtsam.Values(), self._Pose()
        if k == 0:
            new.add(self._Prior(0, step, gtsam.noiseModel.Constrained.All(self._k)))
        for row in self._rows[k]:
            i, j = int(self._factors.i[row]), int(self._factors.j[row])
            Z = self._pose(self._factors.measurement[row])
            # In space gtsam's rotations come first.
            root = np.roll(self._factors.sqrt_information[row], self._k // 6 * 3, axis=1)
            new.add(self._Between(i, j, Z, gtsam.noiseModel.Gaussian.SqrtInformation(root)))
            if self._odometry[row]:
                step = Z if j == k else Z.inverse()
        values.insert(k, self._at.compose(step))
        began = time.thread_time()
        self._isam.update(new, values)
        estimate = (self._isam.calculateEstimatePose2 if self._k == 3 else
                    self._isam.calculateEstimatePose3)
        self._at = estimate(k)
        return time.thread_time() - began

    def _pose(self, pose: Array) -> Any:
        if self._k == 3:
            return self._Pose(*pose)
        x, y, z, w = pose[3:]
        return self._Pose(self._gtsam.Rot3.Quaternion(w, x, y, z), pose[:3])


@dataclass
class Run:
    """Seconds of each update of ours and of the peer's, and what there was at checkpoints."""

    ours: list[float] = field(default_factory=list)
    peer: list[float] = field(default_factory=list)
    behind: float = 0.0
    checkpoints: list[Snapshot] = field(default_factory=list)


def run(graph: FactorGraph, truth: FactorGraph | None, robust: bool, rate: float) -> Run:
    """Drive the back end through a graph; truth : what the peer gets, None: there is none."""
    options = BackendOptions(KeyframeOptions(0.0, 0.0, 0.0), OdometryOptions('increment'),
                             robust=RobustOptions(robust))
    found, peer = Run(), Isam2(truth) if truth else None
    every = max(graph.n_poses // CHECKPOINTS, 1)
    with Backend(options, dimension_of(graph)) as backend:
        due, whole, alone = time.perf_counter(), time.process_time(), time.thread_time()
        for k, (sample, loops) in enumerate(measurements(GraphRecord(graph, None, None))):
            backend.add_odometry(sample)
            for loop in loops:
                backend.add_loop(loop)
            began = time.thread_time()
            backend.update(0.0)
            found.ours.append(time.thread_time() - began)
            if peer:
                found.peer.append(peer.update(k))
            if (k + 1) % every == 0:
                found.checkpoints.append(backend.snapshot())
            due = max(due + 1 / rate, time.perf_counter() - 0.1)
            time.sleep(max(due - time.perf_counter(), 0.0))
        found.behind = (time.process_time() - whole) - (time.thread_time() - alone)
        end = time.perf_counter() + _IDLE
        while backend.update(0.1) is not None and time.perf_counter() < end:
            pass
        found.checkpoints.append(backend.snapshot())
    return found


def excess(now: Snapshot) -> float:
    """Return by how much [%] the cost is above the L1 optimum of what is believed."""
    part = now.graph.subset(now.judgement.accepted)
    cost = l1_cost(whitened_residual(part, now.poses))
    best = minimise_interior_point(part, now.poses, OptimiserOptions(), cholesky_of(part)).cost
    return 100 * (cost / best - 1) if best > 1e-6 else 0.0


def held(now: Snapshot, lies: Any) -> tuple[int, int, int]:
    """Return how many false loops are believed, how many true ones are not, and of how many."""
    factors = now.graph.between
    n = max(now.graph.n_poses, lies.max(initial=0) + 1)
    ends = np.sort(factors.pairs, axis=1).T
    false = np.isin(pair_key(*ends, n), pair_key(*np.sort(lies, axis=1).T, n))
    loop, accepted = ~factors.is_odometry, now.judgement.accepted
    return (np.count_nonzero(false & accepted), np.count_nonzero(loop & ~false & ~accepted),
            np.count_nonzero(loop & ~false))


def prefix(graph: FactorGraph, poses: int) -> FactorGraph:
    """Return the graph of the first keyframes."""
    factors = graph.between
    rows = np.flatnonzero(np.maximum(factors.i, factors.j) < poses)
    part = FactorGraph(graph.manifold)
    part.add_poses(poses)
    part.append_between(factors.i[rows], factors.j[rows], factors.measurement[rows],
                        factors.sqrt_information[rows])
    return part


def line(name: str, seconds: list[float]) -> str:
    """Return what updates cost, in milliseconds."""
    ms = 1e3 * np.array(seconds)
    quarters = [np.percentile(part, 95) for part in np.array_split(ms, 4)]
    return (f'{name}: median {np.median(ms):.2f}, p95 {np.percentile(ms, 95):.2f}, p99 '
            f'{np.percentile(ms, 99):.2f}, max {ms.max():.1f} ms, total {ms.sum() / 1e3:.1f} s; '
            f'p95 by quarter {" ".join(f"{q:.2f}" for q in quarters)}')


def main() -> None:
    """Run and print some lines."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('graph', type=Path)
    parser.add_argument('--lies', choices=KINDS_OF_FALSE_LOOPS)
    parser.add_argument('--share', type=float, default=0.3, help='false loops, of all')
    parser.add_argument('--rate', type=float, default=200.0, help='keyframes per second')
    parser.add_argument('--poses', type=int, help='only so many of them')
    parser.add_argument('--no-robust', action='store_true')
    parser.add_argument('--no-peer', action='store_true')
    given = parser.parse_args()
    if not given.no_peer:
        peer_environment.enter()
    fill_cache(lambda done, total: None, lambda: False)
    clean = read_graph_file(given.graph).graph
    clean = prefix(clean, given.poses or clean.n_poses)
    graph, lies = clean, np.zeros((0, 2), np.int64)
    if given.lies:
        best = minimise_l2(clean, odometry_poses(clean), LeastSquaresOptions(),
                           cholesky_of(clean)).poses
        loops = len(clean.between) - clean.n_poses + 1
        false = FALSE_LOOPS[given.lies](clean, best, round(
            loops * given.share / (1 - given.share)), np.random.default_rng(0))
        graph, lies = insert_loops(clean, false), np.stack((false.i, false.j), axis=1)
    # Everything is called once before it is timed.
    run(prefix(graph, min(200, graph.n_poses)), None, not given.no_robust, 1e6)
    found = run(graph, None if given.no_peer else clean, not given.no_robust, given.rate)
    print(line('ours', found.ours), f'behind {found.behind:.1f} s', flush=True)
    if found.peer:
        print(line('ISAM2', found.peer), flush=True)
    above = [excess(now) for now in found.checkpoints]
    print(f'above the optimum: mean {np.mean(above[:-1]):.2f}%, max {max(above[:-1]):.2f}%, '
          f'after {_IDLE:g} s {above[-1]:.3f}%:', *(f'{value:.2f}' for value in above))
    counts = [held(now, lies) for now in found.checkpoints]
    print('false held / true not believed yet:', *(f'{a}/{b}' for a, b, _ in counts),
          f'of {counts[-1][2]}')


if __name__ == '__main__':
    main()
