# SPDX-License-Identifier: Apache-2.0
"""
Any input file -> graph, and a graph -> any output file; nothing is solved here.

In the end `l1slam_ros.read_graph` and `write_graph`.
"""

import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from l1slam_ros.core.errors import FileError, GraphError, OptionError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.names import QUATERNION, ROTATION_INFORMATION
from l1slam_ros.core.robust.inspection import initial_poses
from l1slam_ros.io.bags.topics import BAG_SUFFIXES, DEFAULT_TOPICS, Topics
from l1slam_ros.io.files import require_file, require_folder
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file, write_graph_file
from l1slam_ros.io.trajectory import write_tum

if TYPE_CHECKING:
    from l1slam_ros.core.online.graph_builder import GraphBuilderOptions

# By the suffix of a file. A reader takes the path and what the rotation block of the information
# is of, and raises FileError.
GRAPH_READERS: dict[str, Callable[[Path, str], GraphRecord]] = {
    '.g2o': read_graph_file,
    '.graph': read_graph_file,
}


def read_input(path: Path, options: 'GraphBuilderOptions | None' = None,
               topics: Topics = DEFAULT_TOPICS, rotation_information: str = QUATERNION,
               dimension: int = 2) -> GraphRecord:
    """
    Read a graph file or grow a graph from a bag.

    Parameters
    ----------
    path : .g2o, .graph, .mcap, .db3, .bag (ROS 1) or a rosbag2 directory
    options : what makes keyframes of a bag's messages; None: the node's defaults. Where the bag's
        note says it otherwise, defaults give way
    topics : where in a bag to look
    rotation_information : see `GraphRecord`; written back it is as it was read
    dimension : of the world of a bag that does not note it

    Raises
    ------
    FileError : it cannot be read, or there is no graph in it.

    """
    if not path.exists():
        raise FileError(path, 'no such file or directory')
    if is_bag(path):
        from l1slam_ros.io.bags.to_graph import graph_from_bag

        record = graph_from_bag(path, options, topics, dimension)
        return replace(record, rotation_information=rotation_information)
    # The map before the one of that name, too.
    name = path.name.lower().removesuffix('.1')
    for suffix, read in GRAPH_READERS.items():
        if name.endswith(suffix):
            return read(path, rotation_information)
    raise FileError(path, f'unknown kind of file; expected {", ".join(GRAPH_READERS)}, '
                    f'{", ".join(BAG_SUFFIXES)} or a rosbag2 directory')


def is_bag(path: Path) -> bool:
    """Tell whether an input is taken for a bag."""
    return path.is_dir() or path.suffix.lower() in BAG_SUFFIXES


def stored_poses(record: GraphRecord) -> Array:
    """Return the stored start, (n, p), or what comes in its place; see `initial_poses`."""
    return initial_poses(record.graph, record.poses, record.ids)


def with_poses(record: GraphRecord) -> GraphRecord:
    """Return the record with `stored_poses`; as it is where there are none to be had."""
    try:
        return replace(record, poses=stored_poses(record))
    except GraphError:
        return record


@contextmanager
def named(path: Path | str) -> Iterator[None]:
    """Let what is wrong with a graph name the file it came from."""
    try:
        yield
    except GraphError as error:
        raise FileError(path, str(error)) from error


def check_output(path: Path) -> None:
    """Refuse, before any work is done, an output that could not be written in the end."""
    if path.suffix.lower() not in ('.g2o', '.tum', ''):
        raise FileError(path, 'unknown suffix; expected .g2o, .tum, or none for a bag directory')
    if path.suffix:
        require_file(path)
    else:
        from l1slam_ros.io.bags.writer import refuse_other_than_bag

        require_folder(path)
        refuse_other_than_bag(path)


def check_graph_output(path: Path) -> None:
    """Refuse, as `check_output`, an output that does not hold a graph."""
    check_output(path)
    if path.suffix.lower() == '.tum':
        raise FileError(path, 'a trajectory has no edges; expected .g2o, or no suffix for a bag '
                        'directory')


def write_output(path: Path, record: GraphRecord, truth: Array | None = None) -> None:
    """
    Write a graph with its poses, in the format that the suffix names; none: a bag.

    truth : (n, p) poses, which a bag has a topic for

    Raises
    ------
    FileError : an unknown suffix, or the file cannot be written.
    GraphError : the format has no place for a part of the graph.

    """
    check_output(path)
    if path.suffix.lower() == '.g2o':
        write_graph_file(path, record)
    elif path.suffix.lower() == '.tum':
        write_tum(path, record.times, stored_poses(record), record.graph.manifold)
    else:
        from l1slam_ros.io.bags.from_graph import write_graph_bag

        write_graph_bag(path, record, truth)


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
    record = read_input(Path(path), rotation_information=rotation_information)
    for sentence in filter(None, (*record.skipped, record.damage)):
        warnings.warn(sentence, stacklevel=2)
    return record.graph, record.poses


def write_graph(path: str | os.PathLike[str], graph: FactorGraph, poses: Array, *,
                rotation_information: str = QUATERNION) -> None:
    """
    Write a graph with poses (n, p), whole or not at all.

    Parameters
    ----------
    path : .g2o, .tum (the poses alone), or a name without a suffix for a bag directory
    rotation_information : see `read_graph`

    Raises
    ------
    FileError : it cannot be written, or the format has no place for a part of the graph.
    GraphError : poses of another shape, or not finite.

    """
    _check_reading(rotation_information)
    expected = (graph.n_poses, graph.manifold.POSE_SIZE)
    if np.shape(poses) != expected:
        raise GraphError(f'poses have the shape {np.shape(poses)}, expected {expected}')
    if not np.isfinite(poses).all():
        row = int(np.argmin(np.isfinite(poses).all(axis=1)))
        raise GraphError(f'pose {row} is {np.asarray(poses)[row]}, expected finite numbers')
    write_output(Path(path), GraphRecord(
        graph, np.asarray(poses, float), np.arange(graph.n_poses),
        rotation_information=rotation_information))


def _check_reading(rotation_information: str) -> None:
    if rotation_information not in ROTATION_INFORMATION:
        raise OptionError(f'rotation_information is {rotation_information!r}, expected one of '
                          f'{", ".join(ROTATION_INFORMATION)}')
