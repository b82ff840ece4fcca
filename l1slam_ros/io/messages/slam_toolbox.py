# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Reading the graph of slam_toolbox: `PoseGraph`, and `NewNodeEvent`, which has the stamps of nodes.

Each PoseGraph repeats all nodes and edges. The poses of nodes are those of slam_toolbox's own
solver and are not read. An edge is the target seen from the source. Its covariance, rows x y
heading, is in the axes of the source and is converted to those of the measured pose. In different
versions `relative_pose` is a Pose or a Pose2D, and an event has `edge` or `edges`.
"""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.io.messages.conversion import stamp_of
from l1slam_ros.io.messages.edge_graph import EdgeGraph, Told

GRAPH = 'slam_toolbox/msg/PoseGraph'
NEW_NODE = 'slam_toolbox/msg/NewNodeEvent'


class SlamToolbox(EdgeGraph):
    """The graph of one slam_toolbox; after a reset, that of the new map alone."""

    def _told(self, message: Any, topic: str) -> Iterator[Told]:
        if hasattr(message, 'new_node_id'):
            self._note(message.new_node_id, stamp_of(message))
            edges = message.edges if hasattr(message, 'edges') else [message.edge]
        else:
            edges = message.edges
        for edge in edges:
            yield _told_by(edge)

    def _note(self, node: int, stamp: int) -> None:
        """Store the stamp of a node; a number that has another stamp begins a new map."""
        if self._stamps.get(node, stamp) != stamp:
            self._stamps, self._edges = {}, {}
        self._stamps[node] = stamp


def _told_by(edge: Any) -> Told:
    pose = edge.relative_pose
    if hasattr(pose, 'theta'):
        heading = float(pose.theta)
        position = SimpleNamespace(x=pose.x, y=pose.y, z=0.0)
        orientation = SimpleNamespace(
            x=0.0, y=0.0, z=float(np.sin(heading / 2)), w=float(np.cos(heading / 2)))
    else:
        position, orientation = pose.position, pose.orientation
        heading = 2 * float(np.arctan2(orientation.z, orientation.w))
    covariance = _in_axes_of_target(np.array(edge.covariance, float).reshape(3, 3), heading)
    return Told(edge.source_id, edge.target_id, abs(edge.target_id - edge.source_id) != 1,
                position, orientation, covariance)


def _in_axes_of_target(covariance: Array, heading: float) -> Array:
    """Return a covariance (3, 3) in the axes of the source as (6, 6) in those of the target."""
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = np.zeros((6, 6))
    turned[np.ix_(se2.COVARIANCE_ROWS, se2.COVARIANCE_ROWS)] = turn @ covariance @ turn.T
    return turned
