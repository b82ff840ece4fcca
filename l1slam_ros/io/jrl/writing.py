# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Writing a graph as a JRL file; see `layout`.

A graph that was read from such a file keeps its entries, stamps and flags. For other graphs there
is one entry for each keyframe, with a counter as stamp if the graph has no stamps; a factor is in
the entry of its later keyframe. Factors that the map does not use stay in their entries and are
listed in `outlier_factors`: **a program that ignores this list uses them**.
"""

import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.odometry.drift import straightened
from l1slam_ros.io.files import replacing
from l1slam_ros.io.graphs.graph_file import GraphRecord, left_out_words
from l1slam_ros.io.graphs.robot_log import RobotLog
from l1slam_ros.io.graphs.robots import robots_of
from l1slam_ros.io.graphs.side_files import write_beside
from l1slam_ros.io.jrl.covariances import lists_of
from l1slam_ros.io.jrl.document import document_bytes
from l1slam_ros.io.jrl.layout import MARK_NAME, OURS, kind_of, values_of
from l1slam_ros.io.ours import WROTE

# The robot for keys without a letter.
_ONE = ord('a')
_Parts = dict[str, list[Any]]


def write_jrl_file(path: str | os.PathLike[str], record: GraphRecord,
                   truth: Array | None = None) -> None:
    """
    Write a graph with its poses; numbers are read back exactly.

    truth : (n, p) true poses, in the place of those of the log

    Raises
    ------
    FileError : the file cannot be written, or an id cannot be a key.
    MissingError : the library that writes CBOR is not installed.

    """
    path = Path(path)
    if record.ids.min(initial=0) < 0:
        raise FileError(path, f'vertex {record.ids.min()} cannot be a key; expected ids from 0 '
                        'on; nothing is written')
    content = document_bytes(path, _document(record, _log_of(path, record, truth)))
    with replacing(path) as temporary:
        with temporary.open('wb') as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        write_beside(path, record.ids, None, record.graph.between)


def _log_of(path: Path, record: GraphRecord, truth: Array | None) -> RobotLog:
    """Return what a graph's log says, as it came, or made up."""
    log = record.log
    count = len(record.graph.between)
    if log is None or len(log.entries) > count:  # or it is of another graph
        log = _new_log(path, record)
    elif len(log.entries) < count:  # some were added to the graph that was read
        log = _longer(log, record)
    if truth is not None:
        log = replace(log, true_ids=record.ids, true_poses=truth)
    return log


def _new_log(path: Path, record: GraphRecord) -> RobotLog:
    factors = record.graph.between
    codes = _codes(record.ids)
    n = len(codes)
    stamps = np.arange(n) if record.stamps is None else record.stamps
    robots = np.unique(codes)
    place = np.searchsorted(robots, codes)
    # The entry of each keyframe among those of its robot, in the order of time.
    order = np.lexsort((np.arange(n), stamps, place))
    entry = np.empty(n, np.int64)
    first = np.searchsorted(place[order], np.arange(len(robots)))
    entry[order] = np.arange(n) - first[place[order]]
    i, j = factors.pairs.T
    later = np.where(stamps[i] > stamps[j], i, j)
    return RobotLog(
        path.name.split('.')[0], tuple(robots.tolist()),
        tuple(tuple(np.sort(stamps[place == k]).tolist()) for k in range(len(robots))),
        np.stack((place[later], entry[later]), axis=1), None, None,
        np.zeros(0, np.int64), np.zeros((0, record.graph.manifold.POSE_SIZE)))


def _longer(log: RobotLog, record: GraphRecord) -> RobotLog:
    """Return the log with factors that came later, each in the last entry of its robot."""
    j = record.graph.between.j[len(log.entries):]
    places = {code: k for k, code in enumerate(log.robots)}
    robots = [places.get(code, 0) for code in _codes(record.ids[j]).tolist()]
    more = [(robot, max(len(log.stamps[robot]) - 1, 0)) for robot in robots]
    stamps = tuple(own or (0,) for own in log.stamps)

    def longer(mask: Any) -> Any:
        return None if mask is None else np.append(mask, np.zeros(len(more), bool))

    return replace(log, stamps=stamps, entries=np.concatenate((log.entries, more)),
                   doubtful=longer(log.doubtful), false=longer(log.false))


def _codes(ids: Indices) -> Indices:
    codes = robots_of(ids)
    return np.where(codes == 0, _ONE, codes)


def _document(record: GraphRecord, log: RobotLog) -> dict[str, Any]:
    graph = record.graph
    words = left_out_words(record)
    factors = graph.between
    letters = [chr(code) for code in log.robots]
    is_out = words != ''
    is_loop = ~factors.is_odometry & ~factors.is_absolute
    entries, places = _entries(_as_written(record, words), record.ids, log)
    flags = (is_loop & ~factors.trusted if log.doubtful is None else log.doubtful) | is_out

    def named(rows: Indices, *columns: Iterable[Any]) -> _Parts:
        parts: _Parts = {letter: [] for letter in letters}
        for (robot, *place), *values in zip(places[rows].tolist(), *columns, strict=True):
            parts[letters[robot]].append([*place, *values])
        return parts

    document: dict[str, Any] = {
        'name': log.name, 'robots': list(log.robots),
        'measurements': dict(zip(letters, entries, strict=True))}
    if len(log.true_ids):
        document['groundtruth'] = _values(log.true_ids, log.true_poses, log, graph)
    if record.poses is not None:
        document['initialization'] = _values(record.ids, record.poses, log, graph)
    document['potential_outlier_factors'] = named(np.flatnonzero(flags))
    ours: dict[str, Any] = {}
    if is_out.any():
        document['outlier_factors'] = named(np.flatnonzero(is_out))
        ours['left_out'] = named(np.flatnonzero(is_out), words[is_out].tolist())
        if log.false is not None:
            ours['false'] = named(np.flatnonzero(log.false))
    elif log.false is not None:
        document['outlier_factors'] = named(np.flatnonzero(log.false))
    if record.drift:
        rows = np.flatnonzero(factors.is_odometry & ~is_out)
        ours['measured'] = named(rows, values_of(factors.measurement[rows], graph.manifold))
    # The mark is what the file ends with: it is looked for there.
    return {**document, OURS: {**ours, MARK_NAME: WROTE}}


def _as_written(record: GraphRecord, words: np.ndarray) -> FactorGraph:
    """Return the graph with the odometry as the map has it, but for that which is left out."""
    if not record.drift:
        return record.graph
    other = straightened(record.graph, record.drift)
    used = words == ''
    graph = record.graph.without_factors()
    both = (record.graph.between, other.between)
    measured, corrected = (factors.measurement for factors in both)
    factors = both[0]
    graph.append_between(factors.i, factors.j, np.where(used[:, None], corrected, measured),
                         factors.sqrt_information, factors.trusted, factors.struck)
    return graph


def _entries(graph: FactorGraph, ids: Indices,
             log: RobotLog) -> tuple[list[list[dict[str, Any]]], Indices]:
    """Return the entries of each robot, and robot, entry and number in it of factors (m, 3)."""
    entries: list[list[dict[str, Any]]] = [
        [{'stamp': stamp} for stamp in own] for own in log.stamps]
    factors = graph.between
    manifold = graph.manifold
    numbers = []
    rows = zip(log.entries.tolist(), factors.is_absolute.tolist(), ids[factors.pairs].tolist(),
               values_of(factors.measurement, manifold),
               lists_of(factors.sqrt_information, manifold), strict=True)
    for (robot, entry), absolute, (i, j), pose, covariance in rows:
        factor: dict[str, Any] = {'type': kind_of(manifold, absolute)}
        factor |= {'key': j, 'prior': pose} if absolute else {
            'key1': i, 'key2': j, 'measurement': pose}
        own = entries[robot][entry].setdefault('measurements', [])
        numbers.append(len(own))
        own.append({**factor, 'covariance': covariance})
    return entries, np.column_stack((log.entries, np.array(numbers, np.int64)))


def _values(ids: Indices, poses: Array, log: RobotLog, graph: FactorGraph) -> _Parts:
    """Return poses (k, p) of keys (k,) by robots."""
    parts: _Parts = {chr(code): [] for code in log.robots}
    letters = [chr(code if code in log.robots else log.robots[0])
               for code in _codes(ids).tolist()]
    for letter, key, value in zip(letters, ids.tolist(), values_of(poses, graph.manifold),
                                  strict=True):
        parts[letter].append({'key': key, **value})
    return parts
