# SPDX-License-Identifier: Apache-2.0
"""
How good the map is while it grows, and what an update costs.

    python benchmarks/incremental.py GRAPH [--every K] [--budget S]

Feeds the factors of a graph file in order of time to the back end, as the node would, with an
update after every K keyframes. At ten checkpoints the same graph is also solved to the end. Prints
seconds per update and by how much the L1 cost of the map lies above that of the whole solve.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.online.backend import Backend, BackendOptions
from l1slam_ros.core.online.graph_builder import GraphBuilderOptions
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.online.update import optimise
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file
from l1slam_ros.io.trajectory import invented_stamps

CHECKPOINTS = 10


def measurements(record: GraphRecord) -> Iterator[tuple[OdometrySample, list[LoopClosure]]]:
    """Yield each keyframe's odometry and the loops that end at it."""
    graph, factors = record.graph, record.graph.between
    stamps = invented_stamps(graph.n_poses)
    chain, measured = se2.to_pose3(odometry_poses(graph)), se2.to_pose3(factors.measurement)
    root = factors.sqrt_information
    covariance = np.zeros((len(factors), 6, 6))
    rows = np.array(se2.COVARIANCE_ROWS)
    covariance[:, rows[:, None], rows] = np.linalg.inv(root.transpose(0, 2, 1) @ root)
    step = {int(max(factors.i[k], factors.j[k])): k for k in np.flatnonzero(factors.is_odometry)}
    loops: dict[int, list[LoopClosure]] = {}
    for k in np.flatnonzero(~factors.is_odometry):
        loops.setdefault(int(factors.j[k]), []).append(LoopClosure(
            stamps[factors.i[k]], stamps[factors.j[k]], measured[k], covariance[k]))
    none = np.zeros((6, 6))
    for k in range(graph.n_poses):
        motion = covariance[step[k]] if k else none
        yield OdometrySample(int(stamps[k]), chain[k], motion, none), loops.get(k, [])


def run(record: GraphRecord, every: int, budget: float) -> tuple[list[float], list[float]]:
    """Return seconds of each update, and the excess [%] at each checkpoint."""
    growth = GraphBuilderOptions(KeyframeOptions(0.0, 0.0, 0.0), OdometryOptions('increment'))
    options = BackendOptions(growth.keyframe, growth.odometry, growth.loop)
    backend = Backend(options)
    seconds: list[float] = []
    excess: list[float] = []
    checkpoint = max(record.graph.n_poses // CHECKPOINTS // every, 1) * every
    for k, (sample, loops) in enumerate(measurements(record), 1):
        backend.add_odometry(sample)
        for loop in loops:
            backend.add_loop(loop)
        if k % every:
            continue
        began = time.perf_counter()
        improvement = backend.update(budget)
        seconds.append(time.perf_counter() - began)
        if k % checkpoint == 0 and improvement is not None and improvement.cost > 0:
            problem = backend.snapshot().problem()
            best = min(optimise(problem, options.solver).cost, improvement.cost)
            excess.append(100 * (improvement.cost / best - 1))
    return seconds, excess


def main() -> None:
    """Run and print one line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('graph', type=Path)
    parser.add_argument('--every', type=int, default=10, help='keyframes between two updates')
    parser.add_argument('--budget', type=float, default=0.1, help='of one update [s]')
    arguments = parser.parse_args()
    seconds, excess = run(read_graph_file(arguments.graph), arguments.every, arguments.budget)
    median, p99 = 1e3 * np.percentile(seconds, (50, 99))
    print(f'{arguments.graph.stem}: {len(seconds)} updates, median {median:.0f} ms, '
          f'p99 {p99:.0f} ms, max {1e3 * max(seconds):.0f} ms; cost above the whole solve: '
          f'mean {np.mean(excess):.2f}%, max {max(excess):.2f}%')


if __name__ == '__main__':
    main()
