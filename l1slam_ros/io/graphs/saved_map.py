# SPDX-License-Identifier: Apache-2.0
"""The map of a back end as a file, and back."""

from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.online.snapshot import Snapshot
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file, write_graph_file


def save_map(path: Path, now: Snapshot) -> int:
    """
    Write graph, poses, stamps and trust as g2o and beside it; return how many keyframes.

    Raises
    ------
    FileError : there is no graph yet, or the file cannot be written.

    """
    if not len(now.graph.between):
        raise FileError(path, 'there is no graph yet to be saved')
    poses = now.poses
    write_graph_file(path, GraphRecord(now.graph, poses, np.arange(len(poses)), now.stamps))
    return len(poses)


def load_map(path: Path) -> tuple[FactorGraph, Array, Indices]:
    """
    Return the graph of a saved map, its poses (n, p) and stamps (n,) [ns].

    Raises
    ------
    FileError : the file is none.

    """
    record = read_graph_file(path)
    if record.poses is None or record.stamps is None:
        raise FileError(path, 'has no poses or no stamps beside it; expected a saved map')
    return record.graph, record.poses, record.stamps
