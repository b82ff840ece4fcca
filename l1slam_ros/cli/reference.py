# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What is known of an input: true poses from a file or a topic, and which loops are false."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error, align, poses_at
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.io.files import NANOSECONDS, counted, stamp_text
from l1slam_ros.io.formats import is_bag
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.graphs.side_files import beside, named_loops
from l1slam_ros.io.scans.scan_path import ScanPath
from l1slam_ros.io.trajectory import Reference, read_reference

# [ns] As far as that a pose may lie before the first or after the last true one: files round.
_SAME_STAMP = 1_000_000
# A gap in the truth is bridged up to so many of its usual steps, and up to so long [ns] anyway.
_USUAL_STEPS = 3
_SHORT = NANOSECONDS


@dataclass(frozen=True)
class Truth:
    """
    Where some keyframes should be.

    rows : (k,) these keyframes; poses : (k, p) theirs; path : (l, p) the true poses from the first
    of them to the last, a row of NaN in each gap; skipped : sentences on what was not used;
    steps : (k, 3) or None, from each keyframe to where `poses` has the robot a little later
    """

    rows: Indices
    poses: Array
    path: Array
    skipped: tuple[str, ...] = ()
    steps: Array | None = None

    def estimate(self, record: GraphRecord, poses: Array) -> Array:
        """Return the estimates of a map (n, p) for the true `poses`, (k, p)."""
        own: Array = poses[self.rows]
        return own if self.steps is None else record.graph.manifold.compose(own, self.steps)


def read_truth(source: str, record: GraphRecord, input_path: Path,
               scans: ScanPath | None = None) -> Truth:
    """
    Return the truth about a graph.

    Parameters
    ----------
    source : a TUM or CSV file, a graph file, `id x y theta` text; or `BAG:/TOPIC`, where `bag`
        stands for an input that is one
    record, input_path : the graph, and where it is from
    scans : the odometry between its keyframes, where it is known: where there are fewer true poses
        than keyframes, these are compared where they are, not with what lies between them

    Raises
    ------
    FileError : it cannot be read, or shares fewer than two poses with the graph.

    """
    reference = _read(source, record, input_path)
    keys = record.times if reference.stamped else record.ids
    steps = None
    if reference.stamped and scans is not None and _sparser(reference.keys, keys):
        theirs, rows, steps = scans.steps_at(
            reference.keys, _longest(scans.stamps), _SAME_STAMP)
        poses = reference.poses[theirs]
        gaps = _gaps(reference.keys)
    elif reference.stamped:
        rows, poses, gaps = _at_stamps(record, reference, keys)
    else:
        _, rows, theirs = np.intersect1d(keys, reference.keys, return_indices=True)
        poses = reference.poses[theirs]
        gaps = np.zeros(0, np.int64)
    if len(rows) < 2:
        stampless = reference.stamped and record.stamps is None
        hint = '; the graph has no stamps, so its poses are 0.1 s apart from 1000 s on'
        raise FileError(source, f'shares {counted(len(rows), "pose")} with the graph, expected '
                        f'2 or more; it has {_interval(reference.keys, reference.stamped)}, the '
                        f'graph {_interval(keys, reference.stamped)}{hint if stampless else ""}')
    scored = keys[rows]
    first, last = np.searchsorted(reference.keys, [scored.min(), scored.max()])
    inside = gaps[(gaps > first) & (gaps <= last)] - first
    path = np.insert(reference.poses[first:last + 1], inside, np.nan, axis=0)
    return Truth(rows, poses, path, reference.skipped, steps)


def _interval(keys: Indices, stamped: bool) -> str:
    """Return the first and the last of some stamps or ids in words."""
    if not len(keys):
        return 'no poses'
    first, last = int(keys.min()), int(keys.max())
    return (f'times from {stamp_text(first)} to {stamp_text(last)} s' if stamped
            else f'ids from {first} to {last}')


def _read(source: str, record: GraphRecord, input_path: Path) -> Reference:
    bag, colon, topic = source.rpartition(':/')
    if colon and not Path(source).exists():
        from l1slam_ros.io.bags.to_graph import read_truth_topic

        path = input_path if bag == 'bag' and is_bag(input_path) else Path(bag)
        return read_truth_topic(path, f'/{topic}', record.graph.manifold)
    return read_reference(source, record.graph.manifold, by_stamps=record.stamps is not None)


def _at_stamps(record: GraphRecord, reference: Reference,
               stamps: Indices) -> tuple[Indices, Array, Indices]:
    """Return the keyframes that have truth, it, and before which true poses there is a gap."""
    if len(reference.keys) < 2:
        return np.zeros(0, np.int64), reference.poses[:0], np.zeros(0, np.int64)
    rows, poses = poses_at(record.graph.manifold, reference.keys, reference.poses, stamps,
                           _longest(reference.keys), _SAME_STAMP)
    return rows, poses, _gaps(reference.keys)


def _longest(stamps: Indices) -> int:
    """Return how long a gap between some stamps is bridged [ns]."""
    return max(_USUAL_STEPS * int(np.median(np.diff(stamps))), _SHORT)


def _gaps(stamps: Indices) -> Indices:
    """Return before which of some stamps there is a gap that is not bridged."""
    return np.flatnonzero(np.diff(stamps) > _longest(stamps)) + 1


def _sparser(true: Indices, own: Indices) -> bool:
    """Tell whether there are fewer true stamps than own ones, of the time that has both."""
    def between(stamps: Indices) -> int:
        first = max(true[0], own[0])
        last = min(true[-1], own[-1])
        return int(((stamps >= first) & (stamps <= last)).sum())

    return between(true) < between(own)


def position_error(record: GraphRecord, poses: Array, truth: Truth) -> float:
    """Return the RMSE of the positions [m] of poses (n, p) after rigid alignment."""
    positions = record.graph.manifold.positions
    return absolute_trajectory_error(
        positions(truth.estimate(record, poses)), positions(truth.poses))


def true_path(record: GraphRecord, poses: Array, truth: Truth) -> Array:
    """Return the positions (l, k) of the true path, moved onto poses (n, p) as for the error."""
    positions = record.graph.manifold.positions
    R, t = align(positions(truth.poses), positions(truth.estimate(record, poses)))
    return positions(truth.path) @ R.T + t


def known_false(path: Path, record: GraphRecord) -> Mask:
    """
    Return which factors are false loops, (m,) bool, by the file beside the input `path`, if any.

    Or else by what the input itself says.

    Raises
    ------
    FileError : that file is damaged, or names an edge that the graph does not have.

    """
    if record.log is not None and not beside(path, 'false').exists():
        return record.log.known_false
    return named_loops(path, 'false', record.ids, record.graph.between)
