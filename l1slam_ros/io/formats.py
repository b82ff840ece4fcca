# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Reading a graph from any input file, and writing one to any output file.

`l1slam_ros.read_graph` and `write_graph` are at the end.
"""

import math
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
from l1slam_ros.core.graph.parts import initial_poses
from l1slam_ros.core.names import QUATERNION, ROTATION_INFORMATION
from l1slam_ros.io.bags.topics import BAG_SUFFIXES, DEFAULT_TOPICS, Topics
from l1slam_ros.io.bounded import unpacked_name
from l1slam_ros.io.files import require_file, require_folder
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file, write_graph_file
from l1slam_ros.io.graphs.left_out import left_out_of, nothing_left_out
from l1slam_ros.io.graphs.robot_log import RobotLog
from l1slam_ros.io.graphs.rows import begins_as_graph
from l1slam_ros.io.graphs.side_files import BESIDE, WRITTEN_BESIDE, beside
from l1slam_ros.io.jrl.document import cbor_library, is_cbor
from l1slam_ros.io.jrl.layout import JRL_SUFFIXES
from l1slam_ros.io.ours import refuse_others
from l1slam_ros.io.trajectory import write_tum

if TYPE_CHECKING:
    from l1slam_ros.core.online.options import GraphBuilderOptions
    from l1slam_ros.core.scans.points import Scan


def _read_jrl_file(path: Path, rotation_information: str, _: float | None) -> GraphRecord:
    from l1slam_ros.io.jrl.reading import read_jrl_file

    return read_jrl_file(path, rotation_information)


# Suffix -> reader. A reader takes the path, `rotation_information`, see `GraphRecord`, and the
# information of factors without one, and raises FileError.
GRAPH_READERS: dict[str, Callable[[Path, str, float | None], GraphRecord]] = {
    '.g2o': read_graph_file,
    '.jrl': _read_jrl_file,
    '.cbor': _read_jrl_file,
    '.graph': read_graph_file,
    '.toro': read_graph_file,
}


# Suffixes of CARMEN logs with scans, packed or not.
LOG_SUFFIXES = ('.clf', '.log', '.bz2', '.gz')


class _Origin(NamedTuple):
    """The content of a file that is not in the `FactorGraph`; the fields are of `GraphRecord`."""

    ids: Indices
    stamps: Indices | None = None
    left_out: np.ndarray | None = None
    comments: tuple[tuple[int, str], ...] = ()
    log: RobotLog | None = None
    drift: float = 0.0


# For each graph that `read_graph` returned, what `write_graph` writes besides.
_ORIGINS: WeakKeyDictionary[FactorGraph, _Origin] = WeakKeyDictionary()


def read_input(path: Path, options: 'GraphBuilderOptions | None' = None,
               topics: Topics = DEFAULT_TOPICS, rotation_information: str = QUATERNION,
               dimension: int = 2, information: float | None = None,
               more: Sequence[Path] = ()) -> GraphRecord:
    """
    Read a graph file or grow a graph from a bag.

    Parameters
    ----------
    path : .g2o, .graph, .toro, .jrl, .cbor, each also packed (.gz, .bz2), .txt with such content,
        .mcap, .db3, .bag (ROS 1) or a rosbag2 directory
    options : how messages of a bag become keyframes; None: the node's defaults. A note in the bag
        replaces defaults
    topics : the topics of a bag
    rotation_information : see `GraphRecord`; the record keeps it for writing
    dimension : of the poses of a bag (2 or 3), unless the bag notes it
    information : the entries on the diagonal of the information of factors of a graph file that
        state none; None: such a file is refused
    more : further bags of the drive whose first bag is `path`

    Raises
    ------
    FileError : the file cannot be read, or holds no graph.

    """
    if not path.exists():
        raise FileError(path, 'no such file or directory; expected a graph, a bag or a log')
    if is_bag(path):
        with optional_libraries():
            from l1slam_ros.io.bags.to_graph import graph_from_bag

        record = graph_from_bag(path, options, topics, dimension, more)
        return replace(record, rotation_information=rotation_information)
    read = graph_reader(path)
    if read is not None:
        return read(path, rotation_information, information)
    raise FileError(path, f'unknown kind of file; expected {", ".join(GRAPH_READERS)}, '
                    f'{", ".join(BAG_SUFFIXES)} or a rosbag2 directory')


def graph_reader(path: Path) -> Callable[[Path, str, float | None], GraphRecord] | None:
    """
    Return what reads a graph file, by its name; None: it is none.

    Raises
    ------
    FileError : it is a text file that cannot be read.

    """
    # `map.g2o.1` is the previous map of the node.
    suffix = Path(unpacked_name(path).removesuffix('.1')).suffix
    # Some programs give their graphs the name of any text.
    is_text = path.suffix.lower() == '.txt' and begins_as_graph(path)
    return read_graph_file if is_text else GRAPH_READERS.get(suffix)


def is_bag(path: Path) -> bool:
    """Tell whether an input is read as a bag."""
    return path.is_dir() or path.suffix.lower() in BAG_SUFFIXES


def is_log(path: Path) -> bool:
    """Tell whether an input is read as a log of scans, see `io.scans`."""
    return (path.is_file() and path.suffix.lower() in LOG_SUFFIXES
            and Path(unpacked_name(path)).suffix not in GRAPH_READERS)


def stored_poses(record: GraphRecord) -> Array:
    """Return the poses (n, p) that the input stores, else those of `initial_poses`."""
    return initial_poses(record.graph, record.poses, record.ids)


def with_poses(record: GraphRecord) -> GraphRecord:
    """Return the record with `stored_poses`; unchanged if there are none."""
    try:
        return replace(record, poses=stored_poses(record))
    except GraphError:
        return record


@contextmanager
def named(path: Path | str) -> Iterator[None]:
    """Turn a GraphError of the block into a FileError that names the file of the graph."""
    try:
        yield
    except GraphError as error:
        raise FileError(path, str(error)) from error


def files_of(path: Path) -> list[Path]:
    """Return an input and the files beside it that may be read with it."""
    return [path, *(beside(path, what) for what in BESIDE)]


def check_output(path: Path, inputs: Iterable[Path] = (), force: bool = False,
                 also: tuple[str, ...] = ()) -> None:
    """
    Check, before any work is done, that an output can be written.

    Parameters
    ----------
    path : see `write_output`
    inputs : the files that are read; they are never replaced
    force : whether to replace files of other programs
    also : further files that will be written beside it, such as `truth`

    Raises
    ------
    FileError : it cannot be written, or would replace an input or a file of another program.

    """
    suffix = path.suffix.lower()
    if path.name == '-':
        raise FileError(path, 'nothing is written to standard output; expected the name of a file '
                        'or of a bag directory')
    if suffix not in ('.g2o', *JRL_SUFFIXES, '.tum', ''):
        raise FileError(path, f'unknown suffix; expected .g2o, {", ".join(JRL_SUFFIXES)}, .tum, '
                        'or none for a bag directory')
    if is_cbor(path):
        cbor_library()
    if path.suffix:
        require_file(path)
    else:
        with optional_libraries():
            import l1slam_ros.io.bags.writer  # noqa: F401

        require_folder(path)
    if suffix in ('.g2o', *JRL_SUFFIXES):
        also = (*WRITTEN_BESIDE, *also)
    refuse_others([path, *(beside(path, what) for what in also)], inputs, force)


def check_graph_output(path: Path, inputs: Iterable[Path] = (), force: bool = False,
                       also: tuple[str, ...] = ()) -> None:
    """Do the checks of `check_output`, and refuse a format that holds no graph."""
    check_output(path, inputs, force, also)
    if path.suffix.lower() == '.tum':
        raise FileError(path, 'a trajectory has no edges; expected .g2o, '
                        f'{", ".join(JRL_SUFFIXES)}, or no suffix for a bag directory')


def write_output(path: Path, record: GraphRecord, truth: Array | None = None,
                 force: bool = False, scans: 'Sequence[Scan]' = ()) -> None:
    """
    Write a graph with its poses in the format of the suffix; without a suffix, a bag.

    truth : (n, p) true poses, written to bags and JRL files only; force : whether to replace files
    of other programs; scans : see `write_graph_bag`, written to bags only

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
               information: float | None = None) -> tuple[FactorGraph, Array | None]:
    """
    Return the graph in a file, and the poses (n, p) stored with it, or None.

    Poses are x y theta [m, rad] in the plane, and x y z qx qy qz qw [m, quaternion] in space.
    Keyframes are numbered from 0, in the order of the vertex ids of the file. Lines and messages
    that are skipped, and damage of a bag, are reported as Python warnings.

    Parameters
    ----------
    path : .g2o, TORO .graph or .toro, .jrl, .cbor, each also packed (.gz, .bz2), a rosbag2
        directory, .mcap, .db3, or .bag of ROS 1
    odom_topic, loop_topic : of a bag: the topics of the odometry and of the loops, or of the pose
        graph of a front end, see `l1slam solve --help`
    rotation_information : the rotation block of the information in a 3D g2o file is that of the
        quaternion's vector part, `quaternion`, as in g2o, or that of the angle, `angle`
    information : the entries on the diagonal of the information of factors of a graph file that
        state none; None: such a file is refused

    Raises
    ------
    FileError : naming file and line, what was found and what was expected.
    OptionError : an argument has the wrong type or value.

    """
    _check_reading(path, rotation_information)
    if information is not None:
        require((int, float), 'information', information, 'a number')
        if not 0 < information < math.inf:
            raise OptionError(f'information is {information:g}, expected a number above 0')
    for name, topic in (('odom_topic', odom_topic), ('loop_topic', loop_topic)):
        require(str, name, topic, 'the name of a topic')
    record = read_input(Path(path), topics=Topics(odom_topic, loop_topic),
                        rotation_information=rotation_information, information=information)
    for sentence in filter(None, (*record.skipped, record.damage)):
        warnings.warn(sentence, stacklevel=2)
    _ORIGINS[record.graph] = _Origin(record.ids, record.stamps, record.left_out, record.comments,
                                     record.log, record.drift)
    return record.graph, record.poses


def write_graph(path: str | os.PathLike[str], graph: FactorGraph, poses: Array, *,
                rotation_information: str = QUATERNION, inliers: Mask | None = None,
                force: bool = False) -> None:
    """
    Write a graph with poses (n, p), whole or not at all.

    A graph of `read_graph` keeps its ids, stamps and comments, as long as the number of its
    keyframes is the same.

    Parameters
    ----------
    path : .g2o, .jrl, .cbor, .tum (the poses alone), or a name without suffix for a bag directory
    rotation_information : see `read_graph`
    inliers : (m,) bool, as in a `Solution`: the other factors are written such that other programs
        do not use them. None: the inliers of the solution with these poses; without one, the
        factors that were left out in the file that was read stay left out
    force : whether to replace what this program did not write; a folder that is no bag is kept
        beside the new one, under the time of its last change

    Raises
    ------
    FileError : the file cannot be written, would replace a file of another program, or the format
        has no place for a part of the graph.
    GraphError : poses or inliers have the wrong shape, or a pose is not finite.
    OptionError : an argument has the wrong type or value.

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
    elif left_out is not None:  # factors appended since are used
        left_out = np.concatenate((left_out, nothing_left_out(len(factors) - len(left_out))))
        drift = origin.drift
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
