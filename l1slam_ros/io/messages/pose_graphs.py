# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Reading `rtabmap_msgs/MapGraph` and `pose_graph_tools_msgs/PoseGraph`.

Each message repeats the graph so far, or adds to it. Only measurements are used: no virtual links,
priors, landmarks, gravity or meshes, and no loops that the front end itself has rejected.

RTAB-Map names keyframes by numbers alone. The newest keyframe of a message has the stamp of the
message; the stamps of keyframes before the first message are unknown.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import usable
from l1slam_ros.io.messages.conversion import stamp_of
from l1slam_ros.io.messages.edge_graph import EdgeGraph, Told

MAP_GRAPH = 'rtabmap_msgs/msg/MapGraph'
POSE_GRAPH = 'pose_graph_tools_msgs/msg/PoseGraph'
# Types of edges: 0 odometry; RTAB-Map's loops: global, local in space, local in time, by a user.
_ODOMETRY = 0
_LINKS = {_ODOMETRY, 1, 2, 3, 4}
_EDGES = {_ODOMETRY, 1}


class PoseGraphs(EdgeGraph):
    """The graph of one robot."""

    def __init__(self) -> None:
        super().__init__()
        self._robot: int | None = None

    def _told(self, message: Any, topic: str) -> Iterator[Told]:
        return self._of_numbers(message) if hasattr(message, 'links') else self._of_nodes(message)

    def _of_numbers(self, message: Any) -> Iterator[Told]:
        """Yield the edges of a MapGraph."""
        newest, known = max(message.poses_id, default=0), max(self._stamps, default=0)
        if newest > known:
            self._stamps[newest] = stamp_of(message.header)
        elif newest < known:  # a new map, or keyframes were removed: numbers are used again
            self._stamps = {k: stamp for k, stamp in self._stamps.items() if k < newest}
            self._edges = {key: edge for key, edge in self._edges.items() if key[1] < newest}
        for link in message.links:
            if link.type in _LINKS:
                yield Told(link.from_id, link.to_id, link.type != _ODOMETRY,
                           link.transform.translation, link.transform.rotation,
                           _inverse(link.information))

    def _of_nodes(self, message: Any) -> Iterator[Told]:
        """Yield the edges of a PoseGraph."""
        for node in message.nodes:
            self._robot = node.robot_id if self._robot is None else self._robot
            if node.robot_id == self._robot:
                self._stamps[node.key] = stamp_of(node.header)
        for edge in message.edges:
            if edge.type in _EDGES and {edge.robot_from, edge.robot_to} == {self._robot}:
                yield Told(edge.key_from, edge.key_to, edge.type != _ODOMETRY,
                           edge.pose.position, edge.pose.orientation,
                           np.array(edge.covariance, float).reshape(6, 6))


def _inverse(information: Any) -> Array:
    """Return the inverse (6, 6) of an information; zeros if it has none."""
    matrix = np.array(information, float).reshape(6, 6)
    return np.linalg.inv(matrix) if usable(matrix[None])[0] else np.zeros((6, 6))
