# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Pose graphs that front ends publish: their loop closures by stamps, or the graph as a whole.

Read are `rtabmap_msgs/MapGraph` and `pose_graph_tools_msgs/PoseGraph`, by their attributes. Each
message repeats the graph so far, or adds to it. The transform of an edge is the pose of its second
keyframe, seen from the first. Only measurements count: no virtual link, prior, landmark, gravity,
mesh, nor what the front end itself has rejected.

RTAB-Map names keyframes by numbers alone. The newest of a message is that of the message's stamp;
the times of those that came before the first message nobody knows.
"""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import root_of_inverse, usable
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.measurements import LoopClosure, in_order
from l1slam_ros.core.online.keyframes import reduced_covariance
from l1slam_ros.io.messages.conversion import checked_pose3, stamp_of

MAP_GRAPH = 'rtabmap_msgs/msg/MapGraph'
POSE_GRAPH = 'pose_graph_tools_msgs/msg/PoseGraph'
# Types of edges: the odometry's; loops, of RTAB-Map: global, local in space and time, by a user.
_ODOMETRY = 0
_LINKS, _EDGES = {_ODOMETRY, 1, 2, 3, 4}, {_ODOMETRY, 1}


class _Edge(NamedTuple):
    """An edge between two keyframes; pose3 (7,); covariance (6, 6), zeros where not stated."""

    i: int
    j: int
    is_loop: bool
    pose3: Array
    covariance: Array


class PoseGraphs:
    """The graph of one robot, message by message; each edge is taken once."""

    def __init__(self) -> None:
        self._stamps: dict[int, int] = {}
        # None: it cannot be used.
        self._edges: dict[tuple[int, int, bool], _Edge | None] = {}
        self._robot: int | None = None

    def take(self, message: Any) -> Iterator[LoopClosure | MessageError]:
        """
        Yield the loops that are new in a message, and an error for each that cannot be used.

        Its errors' causes are those of `conversion`, and `robot`, `keyframe`: a loop of another
        robot, or of a keyframe whose time nobody knows.
        """
        edges = self._of_numbers(message) if hasattr(message, 'links') else self._of_nodes(message)
        for i, j, kind, pose, covariance in edges:
            key = (min(i, j), max(i, j), kind != _ODOMETRY)
            if i == j or key in self._edges:
                continue
            self._edges[key] = None
            try:
                pose3 = checked_pose3(pose.position, pose.orientation)
                self._edges[key] = edge = _Edge(i, j, key[2], pose3, covariance)
                if edge.is_loop:
                    yield self._loop(edge)
            except MessageError as error:
                yield error

    def _of_numbers(self, message: Any) -> Iterator[tuple[int, int, int, Any, Array]]:
        """Yield the edges of a MapGraph."""
        newest, known = max(message.poses_id, default=0), max(self._stamps, default=0)
        if newest > known:
            self._stamps[newest] = stamp_of(message.header)
        elif newest < known:  # begun anew, or its newest are gone: their numbers come again
            self._stamps = {k: stamp for k, stamp in self._stamps.items() if k < newest}
            self._edges = {key: edge for key, edge in self._edges.items() if key[1] < newest}
        for link in message.links:
            if link.type in _LINKS:
                pose = SimpleNamespace(position=link.transform.translation,
                                       orientation=link.transform.rotation)
                yield link.from_id, link.to_id, link.type, pose, _inverse(link.information)

    def _of_nodes(self, message: Any) -> Iterator[tuple[int, int, int, Any, Array]]:
        """Yield the edges of a PoseGraph."""
        for node in message.nodes:
            self._robot = node.robot_id if self._robot is None else self._robot
            if node.robot_id == self._robot:
                self._stamps[node.key] = stamp_of(node.header)
        for edge in message.edges:
            if edge.type in _EDGES and {edge.robot_from, edge.robot_to} == {self._robot}:
                yield (edge.key_from, edge.key_to, edge.type, edge.pose,
                       np.array(edge.covariance, float).reshape(6, 6))

    def _loop(self, edge: _Edge) -> LoopClosure:
        """Return a loop as the later keyframe, seen from the earlier one."""
        for number in edge.i, edge.j:
            if number not in self._stamps:
                raise MessageError('keyframe', f'a loop of keyframe {number}; expected one whose '
                                   'time a message has told')
        return in_order(LoopClosure(
            self._stamps[edge.i], self._stamps[edge.j], edge.pose3, edge.covariance))

    def graph(self, manifold: Manifold, model: Array) -> tuple[FactorGraph, Indices]:
        """
        Return all edges so far as a graph, and the numbers of its keyframes, (n,).

        model : (d, d) covariance where none is stated
        """
        edges = sorted(filter(None, self._edges.values()), key=lambda edge: edge.is_loop)
        numbers = np.array([(edge.i, edge.j) for edge in edges], np.int64).reshape(-1, 2)
        ids, ends = np.unique(numbers, return_inverse=True)
        ends = ends.reshape(-1, 2)
        covariance = reduced_covariance(
            manifold, np.array([edge.covariance for edge in edges]).reshape(-1, 6, 6))
        covariance = np.where(usable(covariance)[:, None, None], covariance, model)
        graph = FactorGraph(manifold, len(ids))
        graph.append_between(
            ends[:, 0], ends[:, 1],
            manifold.from_pose3(np.array([edge.pose3 for edge in edges]).reshape(-1, 7)),
            root_of_inverse(covariance))
        return graph, ids


def _inverse(information: Any) -> Array:
    """Return the covariance (6, 6) of an information, zeros where it has none."""
    matrix = np.array(information, float).reshape(6, 6)
    return np.linalg.inv(matrix) if usable(matrix[None])[0] else np.zeros((6, 6))
