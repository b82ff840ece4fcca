# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Collecting a graph of edges between numbered keyframes from the messages of a front end.

The transform of an edge is the pose of its second keyframe, seen from the first. The poses that a
front end publishes are its own map; they are never read.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import root_of_inverse, usable
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.measurements import LoopClosure, in_order
from l1slam_ros.core.online.keyframes import (
    OdometryOptions,
    diagonal_covariance,
    reduced_covariance,
)
from l1slam_ros.core.online.options import GraphBuilderOptions
from l1slam_ros.io.graphs.robots import keyframes_of, robots_of
from l1slam_ros.io.messages.conversion import checked_pose3

# Numbers of keyframes are kept in 64 bits with a sign.
_LAST_NUMBER = 2**63 - 1


class Edge(NamedTuple):
    """An edge between two keyframes; pose3 (7,); covariance (6, 6), zeros where not stated."""

    i: int
    j: int
    is_loop: bool
    pose3: Array
    covariance: Array


class Told(NamedTuple):
    """An unchecked edge: position and orientation are fields of a message."""

    i: int
    j: int
    is_loop: bool
    position: Any
    orientation: Any
    covariance: Array


class EdgeGraph(ABC):
    """A graph that grows message by message; an edge that is sent again is used once."""

    def __init__(self) -> None:
        self._stamps: dict[int, int] = {}
        # None: an edge that cannot be used.
        self._edges: dict[tuple[int, int, bool], Edge | None] = {}

    def take(self, message: Any, topic: str = '') -> Iterator[LoopClosure | MessageError]:
        """
        Yield the new loops of a message, and an error for each that cannot be used.

        The causes of errors are those of `conversion`, `number`: a number beyond 63 bits, and
        `robot` and `keyframe`: a loop between robots, or of a keyframe without a known stamp. The
        method `graph` has the loops of the last two.

        topic : that of the message
        """
        try:
            for told in self._told(message, topic):
                yield from self._taken(told)
        except MessageError as error:
            yield error

    @abstractmethod
    def _told(self, message: Any, topic: str) -> Iterator[Told]:
        """Yield the edges in a message, and store the stamps of its keyframes."""

    def _taken(self, told: Told) -> Iterator[LoopClosure | MessageError]:
        key = (min(told.i, told.j), max(told.i, told.j), told.is_loop)
        if told.i == told.j or key in self._edges:
            return
        self._edges[key] = None
        try:
            if key[1] > _LAST_NUMBER:
                raise MessageError('number', f'an edge of keyframe {key[1]}; expected numbers up '
                                   'to 2^63 - 1')
            pose3 = checked_pose3(told.position, told.orientation)
            self._edges[key] = edge = Edge(told.i, told.j, key[2], pose3, told.covariance)
            if edge.is_loop:
                yield self._loop(edge)
        except MessageError as error:
            yield error

    def _loop(self, edge: Edge) -> LoopClosure:
        """Return a loop as the later keyframe, seen from the earlier one."""
        robots = robots_of(np.array([edge.i, edge.j]))
        if robots[0] != robots[1]:
            raise MessageError('robot', 'a loop between two robots; expected those of one')
        for number in edge.i, edge.j:
            if number not in self._stamps:
                raise MessageError('keyframe', f'a loop of keyframe {number}, whose stamp no '
                                   'message has given; expected a known keyframe')
        return in_order(LoopClosure(
            self._stamps[edge.i], self._stamps[edge.j], edge.pose3, edge.covariance))

    def _used(self) -> list[Edge]:
        """Return the edges of the graph, the odometry first."""
        return sorted(filter(None, self._edges.values()), key=lambda edge: edge.is_loop)

    def graph(self, manifold: Manifold,
              options: GraphBuilderOptions) -> tuple[FactorGraph, Indices]:
        """
        Return all edges so far as a graph, and the numbers of its keyframes, (n,).

        options : their noise models are used where no covariance is stated
        """
        edges = self._used()
        numbers = np.array([(edge.i, edge.j) for edge in edges], np.int64).reshape(-1, 2)
        ids, ends = np.unique(numbers, return_inverse=True)
        ends = ends.reshape(-1, 2)
        measured = manifold.from_pose3(np.array([edge.pose3 for edge in edges]).reshape(-1, 7))
        covariance = reduced_covariance(
            manifold, np.array([edge.covariance for edge in edges]).reshape(-1, 6, 6))
        is_loop = np.array([edge.is_loop for edge in edges], bool)
        model = np.where(is_loop[:, None, None], diagonal_covariance(
            manifold, options.loop.sigma_translation, options.loop.sigma_rotation),
            _of_motion(manifold, measured, options.odometry))
        covariance = np.where(usable(covariance)[:, None, None], covariance, model)
        graph = keyframes_of(ids, manifold)
        graph.append_between(ends[:, 0], ends[:, 1], measured, root_of_inverse(covariance))
        return graph, ids

    def sentences(self) -> list[str]:
        """Return a sentence for each kind of edge that is not in the graph."""
        return []


def _of_motion(manifold: Manifold, measured: Array, options: OdometryOptions) -> Array:
    """Return the covariance of each motion (m, p) by the odometry model, (m, d, d)."""
    rest = manifold.identity(len(measured))
    lengths, angles = manifold.motion(manifold.local(rest, measured))
    return np.array([diagonal_covariance(
        manifold, float(np.hypot(options.sigma_translation * metres, options.floor_translation)),
        float(np.hypot(options.sigma_rotation * radians, options.floor_rotation)))
        for metres, radians in zip(lengths.tolist(), angles.tolist(), strict=True)]).reshape(
            -1, manifold.TANGENT_SIZE, manifold.TANGENT_SIZE)
