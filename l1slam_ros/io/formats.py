# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Any input file -> graph, and a graph -> any output file; nothing is solved here.

In the end `l1slam_ros.read_graph` and `write_graph`.
"""

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from l1slam_ros.core.errors import (
    FileError,
    GraphError,
    OptionError,
    optional_libraries,
    require,
)
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.measurements import as_poses
from l1slam_ros.core.names import QUATERNION, ROTATION_INFORMATION
from l1slam_ros.core.robust.inspection import initial_poses
from l1slam_ros.io.bags.topics import BAG_SUFFIXES, DEFAULT_TOPICS, Topics
from l1slam_ros.io.files import require_file, require_folder
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file, write_graph_file
from l1slam_ros.io.graphs.left_out import left_out_of, nothing_left_out
from l1slam_ros.io.graphs.robot_log import RobotLog
from l1slam_ros.io.graphs.side_files import BESIDE, WRITTEN_BESIDE, beside
from l1slam_ros.io.jrl.document import cbor_library, is_cbor
from l1slam_ros.io.jrl.layout import JRL_SUFFIXES
from l1slam_ros.io.ours import refuse_others
from l1slam_ros.io.trajectory import write_tum

if TYPE_CHECKING:
    from l1slam_ros.core.online.options import GraphBuilderOptions
    from l1slam_ros.core.scans.points import Scan


def _read_jrl_file(path: Path, rotation_information: str) -> GraphRecord:
    from l1slam_ros.io.jrl.reading import read_jrl_file

    return read_jrl_file(path, rotation_information)


# By the suffix of a file. A reader takes the path and what the rotation block of the information
# is of, and raises FileError.
GRAPH_READERS: dict[str, Callable[[Path, str], GraphRecord]] = {
    '.g2o': read_graph_file,
    '.jrl': _read_jrl_file,
    '.cbor': _read_jrl_file,
    '.graph': read_graph_file,
}


# Of CARMEN logs with scans, packed or not.
LOG_SUFFIXES = ('.clf', '.log', '.bz2', '.gz')


class _Origin(NamedTuple):
    """What the file of a graph says besides; see `GraphRecord`."""

    ids: Indices
    stamps: Indices | None = None
    left_out: np.ndarray | None = None
    comments: tuple[tuple[int, str], ...] = ()
    log: RobotLog | None = None


# By the graphs that `read_graph` returned, which know nothing of files.
_ORIGINS: WeakKeyDictionary[FactorGraph, _Origin] = WeakKeyDictionary()


def read_input(path: Path, options: 'GraphBuilderOptions | None' = None,
               topics: Topics = DEFAULT_TOPICS, rotation_information: str = QUATERNION,
               dimension: int = 2) -> GraphRecord:
    """
    Read a graph file or grow a graph from a bag.

    Parameters
    ----------
    path : .g2o, .graph, .jrl, its .cbor, .mcap, .db3, .bag (ROS 1) or a rosbag2 directory
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
        with optional_libraries():
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


def is_log(path: Path) -> bool:
    """Tell whether an input is taken for a log of scans, see `io.scans`."""
    return path.is_file() and path.suffix.lower() in LOG_SUFFIXES


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


def files_of(path: Path) -> list[Path]:
    """Return an input and all that may be read beside it."""
    return [path, *(beside(path, what) for what in BESIDE)]


def check_output(path: Path, inputs: Iterable[Path] = (), force: bool = False,
                 also: tuple[str, ...] = ()) -> None:
    """
    Refuse, before any work is done, an output that could not be written in the end.

    Parameters
    ----------
    path : see `write_output`
    inputs : what is read, and never written
    force : whether to replace what others wrote
    also : what will be written beside it besides, as `truth`

    """
    suffix = path.suffix.lower()
    if suffix not in ('.g2o', *JRL_SUFFIXES, '.tum', ''):
        raise FileError(path, f'unknown suffix; expected .g2o, {", ".join(JRL_SUFFIXES)}, .tum, '
                        'or none for a bag directory')
    if is_cbor(path):
        cbor_library()
    if path.suffix:
        require_file(path)
    else:
        with optional_libraries():
            from l1slam_ros.io.bags.writer import refuse_other_than_bag

        require_folder(path)
        refuse_other_than_bag(path)
    if suffix in ('.g2o', *JRL_SUFFIXES):
        also = (*WRITTEN_BESIDE, *also)
    refuse_others([path, *(beside(path, what) for what in also)], inputs, force)


def check_graph_output(path: Path, inputs: Iterable[Path] = (), force: bool = False,
                       also: tuple[str, ...] = ()) -> None:
    """Refuse, as `check_output`, an output that does not hold a graph."""
    check_output(path, inputs, force, also)
    if path.suffix.lower() == '.tum':
        raise FileError(path, 'a trajectory has no edges; expected .g2o, '
                        f'{", ".join(JRL_SUFFIXES)}, or no suffix for a bag directory')


def write_output(path: Path, record: GraphRecord, truth: Array | None = None,
                 force: bool = False, scans: 'Sequence[Scan]' = ()) -> None:
    """
    Write a graph with its poses, in the format that the suffix names; none: a bag.

    truth : (n, p) poses, which bags and JRL files have a place for; force : whether to replace
    what others wrote; scans : see `write_graph_bag`; only a bag has a place for them

    Raises
    ------
    FileError : an unknown suffix, or the file cannot be written.
    GraphError : the format has no place for a part of the graph.

    """
    check_output(path, force=force)
    if path.suffix.lower() == '.g2o':
        write_graph_file(path, record)
    elif path.suffix.lower() in JRL_SUFFIXES:
        from l1slam_ros.io.jrl.writing import write_jrl_file

        write_jrl_file(path, record, truth)
    elif path.suffix.lower() == '.tum':
        write_tum(path, record.times, stored_poses(record), record.graph.manifold)
    else:
        from l1slam_ros.io.bags.from_graph import write_graph_bag

        write_graph_bag(path, record, truth, scans)


def read_graph(path: str | os.PathLike[str], *, odom_topic: str = DEFAULT_TOPICS.odometry,
               loop_topic: str = DEFAULT_TOPICS.loops, rotation_information: str = QUATERNION,
               ) -> tuple[FactorGraph, Array | None]:
    """
    Return the graph in a file, and the poses (n, p) that it stores, None where none.

    Poses are x y theta [m, rad] in the plane, x y z qx qy qz qw in space.

    Keyframes are numbered from 0, in the order of the file's vertex ids. What was skipped, or lost
    where a bag is damaged, is warned of.

    Parameters
    ----------
    path : .g2o, TORO .graph, .jrl or its .cbor, a rosbag2 directory, .mcap, .db3, or .bag of ROS 1
    odom_topic, loop_topic : where a bag has its odometry and its loops, or pose graphs of a front
        end, see `l1slam solve --help`; of a graph file they say nothing
    rotation_information : what the rotation block of the information in a 3D g2o file is of,
        `quaternion`, its vector part, as g2o has it, or `angle`

    Raises
    ------
    FileError : naming file and line, what was found and what was expected.
    OptionError : an argument is of another kind.

    """
    _check_reading(path, rotation_information)
    for name, topic in (('odom_topic', odom_topic), ('loop_topic', loop_topic)):
        require(str, name, topic, 'the name of a topic')
    record = read_input(Path(path), topics=Topics(odom_topic, loop_topic),
                        rotation_information=rotation_information)
    for sentence in filter(None, (*record.skipped, record.damage)):
        warnings.warn(sentence, stacklevel=2)
    _ORIGINS[record.graph] = _Origin(record.ids, record.stamps, record.left_out, record.comments,
                                     record.log)
    return record.graph, record.poses


def write_graph(path: str | os.PathLike[str], graph: FactorGraph, poses: Array, *,
                rotation_information: str = QUATERNION, inliers: Mask | None = None,
                force: bool = False) -> None:
    """
    Write a graph with poses (n, p), whole or not at all.

    A graph of `read_graph` keeps the ids, stamps and comments that it came with, as long as it has
    as many keyframes.

    Parameters
    ----------
    path : .g2o, .jrl or its .cbor, .tum (the poses alone), or a name without a suffix for a bag
        directory
    rotation_information : see `read_graph`
    inliers : (m,) bool of the factors, as of a `Solution`: the others are written as what was left
        out, which other programs do not use; None: those of the solution whose poses these are, or
        else those that were left out in the file read
    force : whether to replace what was there, though this program did not write it

    Raises
    ------
    FileError : it cannot be written, would replace what others wrote, or the format has no place
        for a part of the graph.
    GraphError : poses or inliers of another shape, or poses that are not finite.
    OptionError : an argument is of another kind.

    """
    _check_reading(path, rotation_information)
    require(FactorGraph, 'graph', graph, 'a FactorGraph, as read_graph returns first')
    from l1slam_ros.core.robust.door import believed

    known, drift = believed(graph, poses)
    inliers = known if inliers is None else inliers
    poses = as_poses(graph, poses, 'poses have')
    if not np.isfinite(poses).all():
        row = int(np.argmin(np.isfinite(poses).all(axis=1)))
        raise GraphError(f'pose {row} is {poses[row]}, expected finite numbers')
    origin = _ORIGINS.get(graph)
    factors = graph.between
    if origin is None or len(origin.ids) != graph.n_poses:
        origin = _Origin(np.arange(graph.n_poses))
    left_out = origin.left_out
    if inliers is not None:
        if np.shape(inliers) != (len(factors),):
            raise GraphError(f'inliers have the shape {np.shape(inliers)}, expected '
                             f'{(len(factors),)}')
        left_out = left_out_of(np.asarray(inliers, bool), factors)
    elif left_out is not None:  # what was appended since is believed
        left_out = np.concatenate((left_out, nothing_left_out(len(factors) - len(left_out))))
    write_output(Path(path), GraphRecord(
        graph, poses, origin.ids, origin.stamps, left_out=left_out,
        rotation_information=rotation_information, comments=origin.comments, drift=drift,
        log=origin.log),
        force=force)


def _check_reading(path: object, rotation_information: str) -> None:
    require((str, os.PathLike), 'path', path, 'the name of a file')
    if rotation_information not in ROTATION_INFORMATION:
        raise OptionError(f'rotation_information is {rotation_information!r}, expected one of '
                          f'{", ".join(ROTATION_INFORMATION)}')
