# SPDX-License-Identifier: Apache-2.0
"""`l1slam_ros.read_graph` and `write_graph`: any file of a graph -> the graph, and back."""

import os
import warnings
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import GraphError, OptionError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.names import QUATERNION, ROTATION_INFORMATION
from l1slam_ros.io import formats
from l1slam_ros.io.graphs.graph_file import GraphRecord


def read_graph(path: str | os.PathLike[str], *,
               rotation_information: str = QUATERNION) -> tuple[FactorGraph, Array | None]:
    """
    Return the graph in a file, and the poses (n, p) that it stores, None where none.

    Poses are x y theta [m, rad] in the plane, x y z qx qy qz qw in space.

    Keyframes are numbered from 0, in the order of the file's vertex ids. What was skipped, or lost
    where a bag is damaged, is warned of.

    Parameters
    ----------
    path : .g2o, TORO .graph, a rosbag2 directory, .mcap, .db3, or .bag of ROS 1
    rotation_information : what the rotation block of the information in a 3D g2o file is of,
        `quaternion`, its vector part, as g2o has it, or `angle`

    Raises
    ------
    FileError : naming file and line, what was found and what was expected.

    """
    _check_reading(rotation_information)
    record = formats.read_input(Path(path), rotation_information=rotation_information)
    for sentence in filter(None, (*record.skipped, record.damage)):
        warnings.warn(sentence, stacklevel=2)
    return record.graph, record.poses


def write_graph(path: str | os.PathLike[str], graph: FactorGraph, poses: Array, *,
                rotation_information: str = QUATERNION) -> None:
    """
    Write a graph with poses (n, p), whole or not at all.

    Parameters
    ----------
    path : .g2o, .graph, .tum (the poses alone), or a name without a suffix for a bag directory
    rotation_information : see `read_graph`

    Raises
    ------
    FileError : it cannot be written, or the format has no place for a part of the graph.
    GraphError : poses of another shape.

    """
    _check_reading(rotation_information)
    expected = (graph.n_poses, graph.manifold.POSE_SIZE)
    if np.shape(poses) != expected:
        raise GraphError(f'poses have the shape {np.shape(poses)}, expected {expected}')
    formats.write_output(Path(path), GraphRecord(
        graph, np.asarray(poses, float), np.arange(graph.n_poses),
        rotation_information=rotation_information))


def _check_reading(rotation_information: str) -> None:
    if rotation_information not in ROTATION_INFORMATION:
        raise OptionError(f'rotation_information is {rotation_information!r}, expected one of '
                          f'{", ".join(ROTATION_INFORMATION)}')
