# SPDX-License-Identifier: Apache-2.0
"""
The core without ROS: any input file -> graph -> solution -> any output file.

A bag is grown by the code that the node grows with, so live and offline see one graph.
"""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from l1slam_ros.core import se2
from l1slam_ros.core.errors import FileError, GraphError, MessageError
from l1slam_ros.core.graph import component_labels
from l1slam_ros.core.growth import GraphGrowth, GrowthOptions
from l1slam_ros.core.initial import odometry_poses
from l1slam_ros.core.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.l2 import LeastSquaresOptions, huber_cost, minimise_huber, minimise_l2
from l1slam_ros.core.linearise import whitened_residual
from l1slam_ros.core.manifold import Array, Indices
from l1slam_ros.core.metrics import absolute_trajectory_error
from l1slam_ros.core.optimality import l1_cost, l2_cost
from l1slam_ros.core.optimiser import OptimiserOptions, Report, Solution, minimise
from l1slam_ros.core.seed import seed_poses
from l1slam_ros.io.bag import read_messages, read_note
from l1slam_ros.io.graph_bag import GRAPH_NOTE, LOOP_TOPIC, ODOMETRY_TOPIC, write_graph_bag
from l1slam_ros.io.graph_file import GraphRecord, read_graph_file, write_graph_file
from l1slam_ros.io.messages import loop_closure, odometry_sample
from l1slam_ros.io.trajectory import invented_stamps, read_reference, write_tum

GRAPH_SUFFIXES = ('.g2o', '.graph')
BAG_SUFFIXES = ('.mcap', '.db3')
TRUSTED_LOOP_TOPIC = '/trusted_loop_closures'
# [ns] Stamps that far apart are of one pose: trajectory files print them as rounded floats.
_SAME_STAMP = 1_000_000
NORMS = ('l1', 'l2', 'huber')
STARTS = ('seed', 'file', 'odometry')


def read_input(path: Path, options: GrowthOptions | None = None) -> GraphRecord:
    """
    Read a graph file or grow a graph from a bag.

    Parameters
    ----------
    path : .g2o, .graph, .mcap, .db3 or a rosbag2 directory
    options : what makes keyframes of a bag's messages; None: what the bag's note says, or the
        node's defaults

    Raises
    ------
    FileError : it cannot be read, or there is no graph in it.

    """
    if not path.exists():
        raise FileError(path, 'no such file or directory')
    if path.is_dir() or path.suffix in BAG_SUFFIXES:
        return _grow(path, options or _noted_options(path))
    if path.suffix in GRAPH_SUFFIXES:
        return read_graph_file(path)
    raise FileError(path, f'unknown kind of file; expected {", ".join(GRAPH_SUFFIXES)}, '
                    f'{", ".join(BAG_SUFFIXES)} or a rosbag2 directory')


def _noted_options(path: Path) -> GrowthOptions:
    note = read_note(path)
    options = GrowthOptions()
    if note.get('keyframes') == GRAPH_NOTE['keyframes']:
        options = replace(options, keyframe=KeyframeOptions(0.0, 0.0, 0.0))
    if note.get('covariance') == GRAPH_NOTE['covariance']:
        options = replace(options, odometry=OdometryOptions(GRAPH_NOTE['covariance']))
    return options


def _grow(path: Path, options: GrowthOptions) -> GraphRecord:
    growth = GraphGrowth(se2, options)
    refused: Counter[str] = Counter()
    base_frame = ''
    for topic, _, _, message in read_messages(
            path, (ODOMETRY_TOPIC, LOOP_TOPIC, TRUSTED_LOOP_TOPIC)):
        try:
            if topic == ODOMETRY_TOPIC:
                base_frame = base_frame or message.child_frame_id
                growth.add_odometry(odometry_sample(message))
            else:
                growth.add_loop(loop_closure(message, base_frame, topic == TRUSTED_LOOP_TOPIC))
        except MessageError as error:
            refused[error.cause] += 1
    growth.add_due_loops()
    n = growth.graph.n_poses
    if n < 2:
        raise FileError(path, f'{n} keyframes from its odometry on {ODOMETRY_TOPIC}; '
                        'expected 2 or more')
    refused += growth.refused
    skipped = [f'{count} messages refused: {cause}' for cause, count in refused.items()]
    if growth.n_waiting:
        skipped.append(f'{growth.n_waiting} loops name times after the last odometry')
    return GraphRecord(growth.graph, None, np.arange(n), growth.stamps, tuple(skipped))


def stored_poses(record: GraphRecord) -> Array:
    """Return the stored start, (n, p); where none is stored, the odometry chain."""
    return record.poses if record.poses is not None else odometry_poses(record.graph)


@dataclass(frozen=True)
class Outcome:
    """What `solve` did; costs are of the norm that was asked for, seed_cost None without one."""

    solution: Solution
    initial_cost: float
    seed_cost: float | None
    seconds: float


def solve(
    record: GraphRecord, start: str, norm: str, options: OptimiserOptions,
    least_squares: LeastSquaresOptions, report: Report
) -> Outcome:
    """
    Solve a graph from a start (of `STARTS`) for a norm (of `NORMS`); seconds: solving alone.

    Raises
    ------
    GraphError : the graph is not connected, or has no such start.

    """
    _require_connected(record)
    if start == 'file' and record.poses is None:
        raise GraphError('the input stores no poses to start from; expected --start seed or '
                         'odometry')
    graph, cost = record.graph, cost_function(record, norm, least_squares)
    initial = odometry_poses(graph) if start == 'odometry' else stored_poses(record)
    began = time.perf_counter()
    poses = seed_poses(graph) if start == 'seed' else initial
    if norm == 'l1':
        solution = minimise(graph, poses, options, report=report)
    else:
        minimise_norm = minimise_l2 if norm == 'l2' else minimise_huber
        solution = minimise_norm(graph, poses, least_squares, report)
    return Outcome(solution, cost(initial), cost(poses) if start == 'seed' else None,
                   time.perf_counter() - began)


def cost_function(
    record: GraphRecord, norm: str, least_squares: LeastSquaresOptions
) -> Callable[[Array], float]:
    """Return what `norm` minimises, as a function of the poses."""
    graph, delta = record.graph, least_squares.huber_delta
    of_residual: dict[str, Callable[[Array], float]] = {
        'l1': l1_cost,
        'l2': l2_cost,
        'huber': lambda r: huber_cost(r, graph.manifold.TANGENT_SIZE, delta),
    }
    return lambda poses: of_residual[norm](whitened_residual(graph, poses))


def _require_connected(record: GraphRecord) -> None:
    labels = component_labels(record.graph)
    loose = np.flatnonzero(labels != labels[0])
    if len(loose):
        raise GraphError(f'the graph is not connected: vertex {record.ids[loose[0]]} and '
                         f'{len(loose) - 1} more have no path to vertex {record.ids[0]}')


def matching_rows(record: GraphRecord, reference_path: Path) -> tuple[Indices, Array]:
    """
    Return which keyframes (k,) a reference file has poses of, and these poses (k, p).

    Raises
    ------
    FileError : the reference cannot be read, or shares fewer than two poses.

    """
    reference = read_reference(reference_path, record.graph.manifold)
    keys = stamps_of(record) if reference.stamped else record.ids
    after = np.clip(np.searchsorted(reference.keys, keys), 1, len(reference.keys) - 1)
    nearer_before = keys - reference.keys[after - 1] <= reference.keys[after] - keys
    nearest = np.where(nearer_before, after - 1, after)
    apart = np.abs(reference.keys[nearest] - keys)
    ours = np.flatnonzero(apart <= (_SAME_STAMP if reference.stamped else 0))
    theirs = nearest[ours]
    if len(ours) < 2:
        raise FileError(reference_path, f'shares {len(ours)} poses with the graph, '
                        'expected 2 or more')
    return ours, reference.poses[theirs]


def position_error(record: GraphRecord, poses: Array, reference_path: Path) -> float:
    """Return the RMSE of the positions [m] after rigid alignment; errors as `matching_rows`."""
    ours, reference = matching_rows(record, reference_path)
    positions = record.graph.manifold.positions
    return absolute_trajectory_error(positions(poses)[ours], positions(reference))


def stamps_of(record: GraphRecord) -> Indices:
    """Return the stamps of the keyframes, (n,) [ns], invented where the input has none."""
    return record.stamps if record.stamps is not None else invented_stamps(record.graph.n_poses)


def check_output(path: Path) -> None:
    """Refuse, before any work is done, an output whose suffix names no format."""
    if path.suffix not in (*GRAPH_SUFFIXES, '.tum', ''):
        raise FileError(path, f'unknown suffix; expected {", ".join(GRAPH_SUFFIXES)}, .tum, or '
                        'none for a bag directory')


def write_output(path: Path, record: GraphRecord, poses: Array) -> None:
    """
    Write a graph with its poses (n, p), in the format that the suffix names; none: a bag.

    Raises
    ------
    FileError : an unknown suffix, or the file cannot be written.

    """
    check_output(path)
    if path.suffix in GRAPH_SUFFIXES:
        write_graph_file(path, replace(record, poses=poses))
    elif path.suffix == '.tum':
        write_tum(path, stamps_of(record), poses, record.graph.manifold)
    else:
        write_graph_bag(path, record)
