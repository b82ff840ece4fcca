# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Scans of several drives -> a graph of each, and the loops that the front end finds between them.

In: logs of scans. Out: a record for each log, with the loops within it, and the others apart.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.scans.laser_log import LaserLog
from l1slam_ros.io.scans.reading import read_log
from l1slam_ros.io.scans.to_graph import ScanMap, map_drives

_FEWEST = 2


@dataclass(frozen=True)
class Found:
    """
    Loops between inputs.

    inputs, ids : (m, 2) the number of the input, from 0, and the vertex in it, of both ends;
    measurement : (m, p); roots : (m, d, d) of the information; said : what the front end said of
    all inputs, in sentences.
    """

    inputs: Indices
    ids: Indices
    measurement: Array
    roots: Array
    said: tuple[str, ...]


def scanned(paths: Sequence[Path], odom_topic: str, scan_topic: str,
            report: Callable[[int, int, int], None]) -> tuple[list[GraphRecord], Found]:
    """
    Return a record of each log or bag, and the loops between them.

    report : told of how many scans of how many were used, and how many loops were found

    Raises
    ------
    FileError : one of them cannot be read, holds no scans, or is of a robot that did not move.

    """
    logs = [read_log(path, odom_topic, scan_topic) for path in paths]
    total = sum(len(log.scans) for log in logs)
    made = map_drives([(zip(log.scans, log.wheels, strict=True), log.mount) for log in logs],
                      lambda scans, loops: report(scans, total, loops))
    robot = made.record.graph.robot
    records = []
    for number, (path, log) in enumerate(zip(paths, logs, strict=True)):
        keyframes = np.flatnonzero(robot == number)
        if len(keyframes) < _FEWEST:
            raise FileError(path, f'{len(log.scans):,} scans of a robot that did not move; '
                            f'expected {_FEWEST} keyframes or more')
        records.append(_record(made, keyframes, log))
    return records, _between(made)


def _record(made: ScanMap, keyframes: Indices, log: LaserLog) -> GraphRecord:
    """Return what is of one drive alone; its keyframes stand behind each other."""
    factors = made.record.graph.between
    first = int(keyframes[0])
    graph = FactorGraph(made.record.graph.manifold, len(keyframes))
    own = np.isin(factors.pairs, keyframes).all(axis=1)
    graph.append_between(factors.i[own] - first, factors.j[own] - first,
                         factors.measurement[own], factors.sqrt_information[own])
    stamps = made.record.times[keyframes]
    return GraphRecord(graph, None, np.arange(len(keyframes)), stamps, log.skipped,
                       damage=log.damage)


def _between(made: ScanMap) -> Found:
    graph = made.record.graph
    factors, robot = graph.between, graph.robot
    first = np.searchsorted(robot, np.arange(robot.max() + 1))
    ends = robot[factors.pairs]
    apart = ends[:, 0] != ends[:, 1]
    inputs = ends[apart]
    return Found(inputs, factors.pairs[apart] - first[inputs], factors.measurement[apart],
                 factors.sqrt_information[apart], made.record.skipped)
