# SPDX-License-Identifier: Apache-2.0
"""A graph and its poses -> what a map shows."""

from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.initial import odometry_poses
from l1slam_ros.core.manifold import Array
from l1slam_ros.core.metrics import align
from l1slam_ros.io.graph_file import GraphRecord
from l1slam_ros.io.plot import MapDrawing
from l1slam_ros.offline import matching_rows


def drawing(title: str, record: GraphRecord, poses: Array, truth_path: Path | None,
            note: str) -> MapDrawing:
    """
    Return the map of poses (n, p), with its odometry and, from a file, the truth.

    The truth is moved onto the poses by rigid alignment, as for the position error.
    """
    graph = record.graph
    factors, positions = graph.between, graph.manifold.positions
    try:
        odometry = positions(odometry_poses(graph))
    except GraphError:  # a graph without a whole chain can still be drawn
        odometry = None
    truth = None
    if truth_path is not None:
        ours, reference = matching_rows(record, truth_path)
        R, t = align(positions(reference), positions(poses)[ours])
        truth = positions(reference) @ R.T + t
    loops = np.stack((factors.i, factors.j), axis=1)[~factors.is_odometry]
    return MapDrawing(title, positions(poses), odometry, truth, loops, note=note)
