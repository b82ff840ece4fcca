# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Where the odometry frame is in the map: what the last keyframe of the map says."""

from typing import NamedTuple

import numpy as np

from l1slam_ros.core.bordered.front import Front
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.online.graph_builder import GraphBuilder


class Newest(NamedTuple):
    """The last keyframe of the map, which keyframes to come follow, -1: none; its pose (1, p)."""

    keyframe: int
    pose: Array

    @staticmethod
    def of(poses: Array, front: Front | None) -> 'Newest':
        """Return that of a map, poses (n, p), or of its front where there is one."""
        return (Newest(front.keyframes - 1, front.newest) if front
                else Newest(len(poses) - 1, poses[-1:]))


class MapToOdom:
    """The transform map -> odom (1, p), and how it has moved; its owner holds a lock."""

    def __init__(self, newest: Newest):
        self.begin(newest)
        # Before the first map and after the last that nobody asked for yet.
        self._moved: tuple[Array, Array] | None = None

    def begin(self, newest: Newest) -> None:
        """Begin where another map ends."""
        self._newest = newest
        # Asked for with every sample: worked out when an update or a new offset changes it.
        self._known: tuple[Array, Array] | None = None

    def move(self, builder: GraphBuilder, newest: Newest) -> None:
        """Go on where the map ends by now."""
        before = self.now(builder)
        self.begin(newest)
        self._moved = (self._moved or (before,))[0], self.now(builder)

    def now(self, builder: GraphBuilder) -> Array:
        """Return the transform; builder : of the graph."""
        offset, manifold = builder.offset, builder.graph.manifold
        if self._newest.keyframe < 0:
            return manifold.identity(1)
        if self._known is None or self._known[0] is not offset:
            odometry = builder.track.poses_of(np.array([self._newest.keyframe]))
            to_kept = manifold.compose(self._newest.pose, manifold.inverse(odometry))
            self._known = offset, manifold.compose(to_kept, offset)
        return self._known[1]

    def moved(self, builder: GraphBuilder) -> tuple[Array, Array]:
        """Return the transform as it was when this was asked before, and as it is now."""
        (before, after), self._moved = self._moved or 2 * (self.now(builder),), None
        return before, after
