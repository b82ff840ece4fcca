# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Reading a JRL file as a graph with its further content; see `layout`."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import WORLD, BetweenFactors
from l1slam_ros.core.names import QUATERNION
from l1slam_ros.core.robust.odometry.drift import correction
from l1slam_ros.io.files import counted
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.graphs.left_out import (
    REJECTED,
    SLIP,
    STRUCK,
    SUSPECT,
    nothing_left_out,
)
from l1slam_ros.io.graphs.robot_log import RobotLog
from l1slam_ros.io.graphs.robots import keyframes_of
from l1slam_ros.io.graphs.side_files import named_loops
from l1slam_ros.io.jrl.covariances import roots_of
from l1slam_ros.io.jrl.document import Node, read_document
from l1slam_ros.io.jrl.layout import FACTORS, OURS, POSES, poses_of, row_of
from l1slam_ros.io.jrl.times import stamps_of

_EXPECTED = 'BetweenFactorPose2 or BetweenFactorPose3'


@dataclass
class _Factors:
    """
    The pose factors of a file, in its order, by lists.

    nodes : where each stands; keys : of both ends, the same twice of an absolute one; entries :
    see `RobotLog`; numbers : of each in its entry; skipped : kind -> how many are of another one;
    circles : where those from a key to itself stand.
    """

    manifold: Manifold | None = None
    nodes: list[Node] = field(default_factory=list)
    keys: list[tuple[int, int]] = field(default_factory=list)
    alone: list[bool] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)
    entries: list[tuple[int, int]] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    skipped: Counter[str] = field(default_factory=Counter)
    circles: int = 0

    def add(self, node: Node, robot: int, entry: int, number: int) -> None:
        """Add a measurement."""
        kind = node['type'].text()
        manifold, alone = FACTORS.get(kind, (None, False))
        if manifold is None:
            self.skipped[kind] += 1
            return
        if manifold is not (self.manifold or manifold):
            node['type'].refuse('all poses in the plane, or all in space, as those before')
        names = ('key', 'key') if alone else ('key1', 'key2')
        keys = node[names[0]].whole(), node[names[1]].whole()
        if keys[0] == keys[1] and not alone:
            self.circles += 1
            return
        self.manifold = manifold
        self.nodes.append(node)
        self.keys.append(keys)
        self.alone.append(alone)
        self.rows.append(row_of(node['prior' if alone else 'measurement'], manifold))
        self.entries.append((robot, entry))
        self.numbers.append(number)

    @property
    def places(self) -> dict[tuple[int, int, int], int]:
        """(robot, entry, number in the entry) -> the number of the factor."""
        return {(*entry, number): k for k, (entry, number) in enumerate(
            zip(self.entries, self.numbers, strict=True))}

    def sentences(self) -> list[str]:
        """Return a sentence for each kind of measurement that is not used."""
        circles = [f'{counted(self.circles, "edge")} from a key to itself not used'] if (
            self.circles) else []
        return circles + [f'{count:,} {kind if kind.isalnum() else "odd"} '
                          f'{"is" if count == 1 else "are"} not used: no pose factor'
                          for kind, count in self.skipped.items()]


def read_jrl_file(path: Path, rotation_information: str = QUATERNION) -> GraphRecord:
    """
    Read a JRL file, with the vouched-for and struck-out loops beside it.

    The keys tell which factors are odometry, and which robot a keyframe belongs to; see `robots`.
    Priors are absolute poses. The initialization is the stored start if it has all keys.

    Parameters
    ----------
    path : of JSON, or of CBOR
    rotation_information : of a g2o file that may be made of it; here it is of the angles

    Raises
    ------
    FileError : naming the place in it, what was found and what was expected.
    MissingError : the library that reads CBOR is not installed.

    """
    root = read_document(path)
    letters = _robots(root)
    factors, stamps = _factors(root, letters)
    manifold = factors.manifold
    if manifold is None or all(factors.alone):
        raise FileError(path, f'no edges; expected measurements of the type {_EXPECTED}')
    start = _values(root.find('initialization'), manifold)
    ids = np.unique(np.array([*factors.keys, *((key, key) for key in start)], np.int64))
    keys = np.array(factors.keys, np.int64)
    log = _log(path, root, letters, stamps, factors)
    times, on_times = stamps_of(ids, keys, log)
    missing = [key for key in ids.tolist() if key not in start]
    poses = None if missing else poses_of([start[key] for key in ids.tolist()], manifold)
    on_start = [f'initialization is not used: it lacks {len(missing):,} of '
                f'{counted(len(ids), "key")}'] if start and missing else []
    written = poses_of(factors.rows, manifold)
    measurement = written.copy()
    left_out, corrected = _left_out(root, letters, factors, measurement)
    roots, on_noise = roots_of([node['covariance'] for node in factors.nodes], manifold)
    graph = keyframes_of(ids, manifold)
    i, j = np.searchsorted(ids, keys).T
    i, none = np.where(factors.alone, WORLD, i), np.zeros(len(i), bool)
    trusted, struck = (
        named_loops(path, name, ids, BetweenFactors(
            i, j, measurement, roots, none, none, graph.predecessor))
        for name in ('trusted', 'struck'))
    here = left_out == STRUCK
    graph.append_between(i, j, measurement, roots, trusted & ~struck & ~here,
                         (struck & ~trusted) | here)
    return GraphRecord(
        graph, poses, ids, times,
        (*factors.sentences(), *on_noise, *on_start, *on_times),
        rotation_information=rotation_information, left_out=left_out, log=log,
        drift=correction(graph.between, corrected, written[corrected]))


def read_truth(path: Path, manifold: Manifold) -> tuple[Indices, Array]:
    """
    Return the true poses in a JRL file: ids (n,), ascending, and poses (n, p).

    manifold : the poses are wanted on it, whatever they are of in the file

    Raises
    ------
    FileError : there are none, or the file is no JRL file.

    """
    root = read_document(path)
    for found in (manifold, *(other for other in POSES.values() if other is not manifold)):
        ids, poses = _sorted(_values(root.find('groundtruth'), found), found)
        if len(ids):
            return ids, (poses if found is manifold
                         else manifold.from_pose3(found.to_pose3(poses)))
    raise FileError(path, 'has no groundtruth; expected one, or another reference')


def _robots(root: Node) -> dict[str, int]:
    """Return the place of each robot by its character; those without a place of their own last."""
    places: dict[str, int] = {}
    listed = root.find('robots')
    for node in listed.elements() if listed else ():
        places.setdefault(_letter(node), len(places))
    for name, node in root['measurements'].members():
        if len(name) != 1:
            node.refuse('measurements by robots, each a single character')
        places.setdefault(name, len(places))
    return places


def _letter(node: Node) -> str:
    if isinstance(node.value, str) and len(node.value) == 1:
        return node.value
    if type(node.value) is not int or not 0 <= node.value < 128:
        node.refuse('the number of a character')
    return chr(node.value)


def _factors(root: Node, letters: dict[str, int]) -> tuple[_Factors, tuple[tuple[int, ...], ...]]:
    """Read the factors in the order of the robots; return them with the stamps of all entries."""
    factors = _Factors()
    stamps = []
    measurements = root['measurements']
    for letter, robot in letters.items():
        own = []
        entries = measurements.find(letter)
        for k, entry in enumerate(entries.elements() if entries else ()):
            own.append(entry['stamp'].whole())
            found = entry.find('measurements')
            for number, node in enumerate(found.elements() if found else ()):
                factors.add(node, robot, k, number)
        stamps.append(tuple(own))
    return factors, tuple(stamps)


def _values(node: Node | None, manifold: Manifold) -> dict[int, list[float]]:
    """Return the poses of keys; if several robots give one, that of the robot of the key."""
    rows: dict[int, list[float]] = {}
    for letter, values in node.members() if node else ():
        for value in values.elements():
            key = value['key'].whole()
            if POSES.get(value['type'].text()) is manifold and (
                    key not in rows or key >> 56 == ord(letter[:1] or '\0')):
                rows[key] = row_of(value, manifold)
    return rows


def _sorted(rows: dict[int, list[float]], manifold: Manifold) -> tuple[Indices, Array]:
    ids = np.array(sorted(rows), np.int64)
    return ids, poses_of([rows[key] for key in ids.tolist()], manifold)


def _log(path: Path, root: Node, letters: dict[str, int],
         stamps: tuple[tuple[int, ...], ...], factors: _Factors) -> RobotLog:
    name = root.find('name')
    ours = root.find(OURS)
    false = ours.find('false') if ours and ours.find('left_out') else (
        root.find('outlier_factors'))
    manifold = factors.manifold or se2
    true_ids, true_poses = _sorted(_values(root.find('groundtruth'), manifold), manifold)
    return RobotLog(
        name.text() if name else path.stem, tuple(map(ord, letters)), stamps,
        np.array(factors.entries, np.int64).reshape(-1, 2),
        _flagged(root.find('potential_outlier_factors'), letters, factors),
        _flagged(false, letters, factors), true_ids, true_poses)


def _flagged(node: Node | None, letters: dict[str, int], factors: _Factors) -> Mask | None:
    """Return which factors a list names, (m,) bool; None if there is no such list."""
    if node is None or node.value is None:
        return None
    mask = np.zeros(len(factors.nodes), bool)
    for rows, _ in _named(node, letters, factors, 2):
        mask[rows] = True
    return mask


def _named(node: Node, letters: dict[str, int], factors: _Factors,
           size: int) -> list[tuple[int, list[Node]]]:
    """Return the factors that a part names, and for each a list of `size` values."""
    places = factors.places
    found = []
    for letter, list_ in node.members():
        for of_one in list_.elements():
            parts = list(of_one.elements())
            if len(parts) != size:
                of_one.refuse(f'a list of {size}: an entry, a measurement')
            entry, number, *rest = parts
            row = places.get((letters.get(letter, -1), entry.whole(), number.whole()))
            if row is not None:  # of a factor that is skipped nothing is to be known
                found.append((row, rest))
    return found


def _left_out(root: Node, letters: dict[str, int], factors: _Factors,
              measurement: Array) -> tuple[np.ndarray, Indices]:
    """Return why each factor is left out, (m,), and of which what was measured is put back."""
    words = nothing_left_out(len(factors.nodes))
    changed = list[int]()
    ours = root.find(OURS)
    if ours is None or factors.manifold is None:
        return words, np.array(changed, np.int64)
    if part := ours.find('left_out'):
        for row, (word,) in _named(part, letters, factors, 3):
            if word.text() not in (REJECTED, SUSPECT, SLIP, STRUCK):
                word.refuse('why it is left out')
            words[row] = word.text()
    if part := ours.find('measured'):
        for row, (pose,) in _named(part, letters, factors, 3):
            measurement[row] = poses_of([row_of(pose, factors.manifold)], factors.manifold)[0]
            changed.append(row)
    return words, np.array(changed, np.int64)
