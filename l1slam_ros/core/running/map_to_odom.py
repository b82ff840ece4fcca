# SPDX-License-Identifier: Apache-2.0
"""Where the odometry frame is in the map: what the last keyframe of the map says."""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.running.map_state import Newest


class MapToOdom:
    """The transform map -> odom (1, p), and how it has moved; its owner holds a lock."""

    def __init__(self) -> None:
        # Asked for with every sample: worked out when an update or a new offset changes it.
        self._known: tuple[Newest, Array, Array] | None = None
        # Before the first map and after the last that nobody asked for yet.
        self._moved: tuple[Array, Array] | None = None

    def now(self, builder: GraphBuilder, newest: Newest) -> Array:
        """Return the transform where the map ends with a keyframe."""
        offset, manifold = builder.offset, builder.graph.manifold
        if newest.keyframe < 0:
            return manifold.identity(1)
        if self._known is None or self._known[0] is not newest or self._known[1] is not offset:
            odometry = builder.track.poses_of(np.array([newest.keyframe]))
            to_kept = manifold.compose(newest.pose, manifold.inverse(odometry))
            self._known = newest, offset, manifold.compose(to_kept, offset)
        return self._known[2]

    def note(self, before: Array, after: Array) -> None:
        """Note that the map has moved."""
        self._moved = (self._moved or (before,))[0], after

    def moved(self, now: Array) -> tuple[Array, Array]:
        """Return the transform as it was when this was asked before, and as it is now."""
        moved, self._moved = self._moved, None
        return moved or (now, now)
