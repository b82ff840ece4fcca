# SPDX-License-Identifier: Apache-2.0
"""A graph and its poses -> what a map shows; a solution -> the curve of its costs."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from l1slam_ros.core.errors import FileError, GraphError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.spanning_tree import odometry_poses, pair_key
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.graphs.side_files import false_loops_path, read_false_loops
from l1slam_ros.io.plot import Curve, MapDrawing

if TYPE_CHECKING:
    from l1slam_ros.core.robust.batch_map import Outcome
    from l1slam_ros.core.robust.judgement import Judgement


def drawing(path: Path, record: GraphRecord, poses: Array, truth: Array | None,
            name: str, note: str = '', judgement: 'Judgement | None' = None) -> MapDrawing:
    """
    Return the map of poses (n, p), with its odometry, and the path of the truth (l, k) if known.

    name : what the poses are. The odometry sets out from the first of them. Loops that are not
    accepted are drawn as refused or as suspect; of those that are, the ones that the file of false
    loops beside the input `path` names, as false.
    """
    graph = record.graph
    factors, positions = graph.between, graph.manifold.positions
    try:
        chain = odometry_poses(graph)
        first = np.broadcast_to(poses[0], chain.shape)
        odometry = positions(graph.manifold.compose(first, chain))
    except GraphError:  # a graph without a whole chain can still be drawn
        odometry = None
    false, is_loop = known_false(path, record), ~factors.is_odometry
    kept, suspect = np.ones(len(factors), bool), np.zeros(len(factors), bool)
    if judgement is not None:
        kept, suspect = judgement.accepted, judgement.suspect
    pairs = factors.pairs
    return MapDrawing(
        path.name, positions(poses), odometry, truth, pairs[is_loop & kept & ~false],
        suspect=pairs[suspect], rejected=pairs[is_loop & ~kept & ~suspect],
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
    pairs = pair_key(*factors.pairs.T, n)
    unknown = (record.ids[index] != ids).any(axis=1) | ~np.isin(false, pairs)
    if unknown.any():
        i, j = ids[np.argmax(unknown)]
        raise FileError(side, f'no edge between {i} and {j} in {path}; expected its false loops, '
                        'or no such file')
    return ~factors.is_odometry & np.isin(pairs, false)


def cost_curve(norm: str, outcome: 'Outcome') -> Curve:
    """Return the costs of a solve, iteration by iteration, its beginning and end named."""
    costs = outcome.solution.history
    iterations = np.arange(len(costs), dtype=float)
    marks = [(0.0, outcome.initial_cost, 'initial')]
    if outcome.seed_cost is not None:
        marks.append((0.0, outcome.seed_cost, 'seed'))
    if len(costs) > 1:
        marks.append((iterations[-1], float(costs[-1]), 'final'))
    return Curve(f'{norm} cost', iterations, costs, tuple(marks))
