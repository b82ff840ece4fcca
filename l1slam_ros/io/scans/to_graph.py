# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Making a graph from scans: a front end finds odometry and loops, robust solves make a map for it.

In: scans in order, each with the robot's pose by wheel odometry. Out: the graph, to be judged and
solved like any other. The same scans make the same graph: nothing here depends on the clock.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import root_of_inverse
from l1slam_ros.core.graph.factor_graph import FactorGraph, component_labels
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.robust.innovation import sample_posterior
from l1slam_ros.core.scans.front_end import ScanFrontEnd
from l1slam_ros.core.scans.loops import ScanLoop
from l1slam_ros.core.scans.odometry import Step
from l1slam_ros.core.scans.points import Mount, Points, Scan
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.io.files import counted
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.scans.scan_path import ScanPath

# The map is solved anew for each loop while there are few, later when they grew by this fraction.
_MORE_LOOPS = 0.1


@dataclass(frozen=True)
class ScanMap:
    """
    A graph made from scans.

    points : of its keyframes; path : the poses of all scans; has_wheels : in each drive in which
    the scans move, so does the odometry beside them.
    """

    record: GraphRecord
    points: list[Points]
    path: ScanPath
    has_wheels: bool


def map_scans(scans: Iterable[tuple[Scan, Array]], mount: Mount,
              report: Callable[[int, int], None] = lambda scans, loops: None) -> ScanMap:
    """
    Make a graph from scans; return it with the points of its keyframes.

    Parameters
    ----------
    scans : each with the robot's pose by wheel odometry at its stamp, (3,); stamps ascend
    mount : the pose of the laser on the robot
    report : called at each keyframe with the numbers of scans and of loops so far

    """
    return map_drives([(scans, mount)], report)


def map_drives(drives: Iterable[tuple[Iterable[tuple[Scan, Array]], Mount]],
               report: Callable[[int, int], None]) -> ScanMap:
    """
    Return, as `map_scans`, the graph of the scans of several drives, loops between them included.

    drives : scans and mount of each; in the graph each is a robot, numbered from 0
    """
    made = _Making(ScanFrontEnd())
    count = 0
    for scans, mount in drives:
        made.begin_drive(mount)
        for scan, wheels in scans:
            count += 1
            if made.take(scan, wheels):
                report(count, made.loops)
    return made.finished()


class _Making:
    """A graph that grows with the scans."""

    def __init__(self, front_end: ScanFrontEnd):
        self.loops = 0
        self._drive = -1
        self._front_end = front_end
        self._graph = FactorGraph(se2)
        self._mapped = 0  # loops in the map that the front end knows
        self._said: list[str] = []
        self._stamps: list[int] = []
        self._poses: list[Array] = []
        self._last: list[int] = []
        self._first_wheels: list[Array] = []
        self._turned: set[int] = set()  # the drives whose wheels did

    def begin_drive(self, mount: Mount) -> None:
        """Begin another drive with the next scan."""
        self._drive += 1
        self._front_end.begin_drive(mount)

    def take(self, scan: Scan, wheels: Array) -> bool:
        """Add a scan; return whether it became a keyframe."""
        if len(self._first_wheels) == self._drive:
            self._first_wheels.append(wheels)
        if (wheels != self._first_wheels[-1]).any():
            self._turned.add(self._drive)
        step = self._front_end.add(scan, wheels)
        if step.said:
            self._said.append(step.said)
        if step.keyframe is not None:
            self._append(step)
        self._stamps.append(scan.stamp)
        self._poses.append(step.pose)
        self._last.append(self._graph.n_poses - 1)
        self._add(self._front_end.loops())
        if self.loops > (1 + _MORE_LOOPS) * self._mapped:
            self._mapped = self.loops
            self._front_end.place(*_mapped(self._graph))
        return step.keyframe is not None

    def _append(self, step: Step) -> None:
        """Append the newest keyframe, and its odometry if it continues from the one before."""
        keyframes = self._front_end.keyframes
        if len(keyframes) < 2 or keyframes[-1].part != keyframes[-2].part:
            self._graph.add_poses(1, self._drive)
            return
        motion = se2.between(keyframes[-2].pose[None], keyframes[-1].pose[None])
        self._graph.append_step(motion, root_of_inverse(step.covariance[None]), self._drive)

    def _add(self, loops: list[ScanLoop]) -> None:
        self.loops += len(loops)
        for loop in loops:
            self._graph.append_between(
                np.array([loop.i]), np.array([loop.j]), loop.measurement[None],
                root_of_inverse(loop.covariance[None]))

    def finished(self) -> ScanMap:
        """Return the result; no more scans can be added."""
        self._add(self._front_end.last_loops())
        keyframes = self._front_end.keyframes
        stamps = np.array([keyframe.stamp for keyframe in keyframes], np.int64)
        said = tuple(f'{sentence} ({counted(self._said.count(sentence), "time")})'
                     for sentence in dict.fromkeys(self._said))
        record = GraphRecord(self._graph, None, np.arange(self._graph.n_poses), stamps, said)
        path = ScanPath(np.array(self._stamps, np.int64), np.array(self._poses).reshape(-1, 3),
                        np.array(self._last, np.int64))
        drives, count = np.unique(self._graph.robot, return_counts=True)
        has_wheels = self._turned.issuperset(drives[count > 1].tolist())
        return ScanMap(record, [keyframe.points for keyframe in keyframes], path, has_wheels)


def _mapped(graph: FactorGraph) -> tuple[Array, Array]:
    """Return the map and its uncertainty; see `ScanFrontEnd.place`."""
    judgement, poses = robust_solve(graph)
    part = judgement.believed(graph)
    unknown = np.full((len(poses), 2), np.inf)
    if component_labels(part).max() > 0:
        return poses, unknown
    try:
        samples = sample_posterior(part, poses, cholesky_of(part)).samples[:-1]
    except GraphError:
        return poses, unknown
    scale = float(np.sqrt(judgement.found_variance(graph).max()))
    steps = scale * np.concatenate((np.zeros_like(samples[:1]), samples))
    steps[:, :2] = se2.rotation(poses) @ steps[:, :2]
    square = ((steps - steps[-1:]) ** 2).mean(axis=2)
    return poses, np.sqrt(np.column_stack((square[:, :2].sum(axis=1), square[:, 2])))
