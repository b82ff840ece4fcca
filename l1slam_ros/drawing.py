# SPDX-License-Identifier: Apache-2.0
"""A graph and its poses -> what a map shows; a solution -> the curve of its costs."""

from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError, GraphError
from l1slam_ros.core.initial import odometry_poses, pair_key
from l1slam_ros.core.manifold import Array
from l1slam_ros.core.metrics import align
from l1slam_ros.core.noise import Mask
from l1slam_ros.io.graph_file import GraphRecord
from l1slam_ros.io.plot import Curve, MapDrawing
from l1slam_ros.io.side_files import false_loops_path, read_false_loops
from l1slam_ros.offline import Outcome, matching_rows


def drawing(path: Path, record: GraphRecord, poses: Array, truth_path: Path | None,
            name: str, note: str = '', accepted: Mask | None = None) -> MapDrawing:
    """
    Return the map of poses (n, p), with its odometry and, from a file, the truth.

    name : what the poses are. The odometry sets out from the first of them; the truth is moved
    onto them by rigid alignment, as for the position error. Loops that the file of false loops
    beside the input `path` names are drawn as such, those that are not accepted, (m,) bool, as
    rejected.
    """
    graph = record.graph
    factors, positions = graph.between, graph.manifold.positions
    try:
        chain = odometry_poses(graph)
        first = np.broadcast_to(poses[0], chain.shape)
        odometry = positions(graph.manifold.compose(first, chain))
    except GraphError:  # a graph without a whole chain can still be drawn
        odometry = None
    truth = None
    if truth_path is not None:
        ours, reference = matching_rows(record, truth_path)
        R, t = align(positions(reference), positions(poses)[ours])
        truth = positions(reference) @ R.T + t
    pairs, false = factors.pairs, known_false(path, record)
    kept = np.ones(len(factors), bool) if accepted is None else accepted
    return MapDrawing(path.name, positions(poses), odometry, truth,
                      pairs[~factors.is_odometry & ~false & kept], rejected=pairs[~kept],
                      false=pairs[false & kept], name=name, note=note)


def known_false(path: Path, record: GraphRecord) -> np.ndarray:
    """
    Return which factors are false loops, (m,) bool, by the file beside the input `path`, if any.

    Raises
    ------
    FileError : that file is damaged, or names an edge that the graph does not have.

    """
    side, factors, n = false_loops_path(path), record.graph.between, record.graph.n_poses
    ids = read_false_loops(side)
    index = np.minimum(np.searchsorted(record.ids, ids), n - 1)
    false = pair_key(index[:, 0], index[:, 1], n)
    pairs = pair_key(factors.i, factors.j, n)
    unknown = (record.ids[index] != ids).any(axis=1) | ~np.isin(false, pairs)
    if unknown.any():
        i, j = ids[np.argmax(unknown)]
        raise FileError(side, f'no edge between {i} and {j} in {path}; expected its false loops, '
                        'or no such file')
    return ~factors.is_odometry & np.isin(pairs, false)


def cost_curve(norm: str, outcome: Outcome) -> Curve:
    """Return the costs of a solve, iteration by iteration, its beginning and end named."""
    costs = outcome.solution.history
    iterations = np.arange(len(costs), dtype=float)
    marks = [(0.0, outcome.initial_cost, 'initial')]
    if outcome.seed_cost is not None:
        marks.append((0.0, outcome.seed_cost, 'seed'))
    if len(costs) > 1:
        marks.append((iterations[-1], float(costs[-1]), 'final'))
    return Curve(f'{norm} cost', iterations, costs, tuple(marks))
