# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Publishing the graph for RViz and Foxglove: keyframes as points, factors as lines.

Each namespace is split into markers, and only those that changed are sent, because most of a large
map does not change. They are serialised from arrays, see `serialisation.path_bytes`.
"""

import struct
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from visualization_msgs.msg import Marker, MarkerArray

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import WORLD
from l1slam_ros.core.running.snapshot import ACCEPTED, REJECTED, SUSPECT, Snapshot
from l1slam_ros.io.messages.serialisation import cdr, header_bytes, string_bytes

# The colours of the pictures, by Okabe and Ito, with a redder red.
_BLUE, _GREY = (0.0, 0.447, 0.698), (0.5, 0.5, 0.5)
# Loops turn from green over yellow to red as their residual grows to these sigmas.
_SIGMAS = (0.0, 2.5, 5.0)
_WORST = 5.0
_LADDER = np.array([(0.0, 0.62, 0.451), (0.902, 0.624, 0.0), (0.835, 0.216, 0.055)])
_LOOPS = {'loops': ACCEPTED, 'suspect_loops': SUSPECT, 'rejected_loops': REJECTED}
_POINT, _LINE = 0.12, 0.05  # [m]
# Number of keyframes or factors of a marker; and the motion [m] below which it is not sent again.
_PIECE = 500
_STILL = 0.01
_EVERY = 1.0  # [s] shortest time between two publications
# Lifetime: for ever; not locked to the frame.
_FOR_EVER = struct.pack('<iI?', 0, 0, False)
# No texture, its header and format, coordinates on it, text, mesh, its file; no materials.
_NOTHING_ELSE = struct.pack('<IBxxxiIIBxxxIBxxxIIIBxxxIBxxxIBxxxI?', 1, 0, 0, 0, 1, 0, 1, 0, 0, 0,
                            1, 0, 1, 0, 1, 0, 0, False)


class GraphMarkers:
    """
    Publishes the graph on the topic `graph` while it has subscribers.

    Parameters
    ----------
    node : to publish from

    """

    def __init__(self, node: Node):
        self._sent: dict[tuple[str, int], bytes] = {}
        self._someone_new = self._waits = False
        self._last = 0.0
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = node.create_publisher(
            MarkerArray, 'graph', latched,
            event_callbacks=PublisherEventCallbacks(matched=self._on_match))

    def _on_match(self, change: Any) -> None:
        self._someone_new |= change.current_count_change > 0

    @property
    def behind(self) -> bool:
        """Whether a subscriber has not received the last map yet."""
        return self._someone_new or (self._waits and time.monotonic() - self._last >= _EVERY)

    def publish(self, frame: str, stamp: int, now: Snapshot) -> None:
        """Publish what has changed since the last call; called by one thread at a time."""
        if not self._publisher.get_subscription_count():
            return
        if not self._someone_new and time.monotonic() - self._last < _EVERY:
            self._waits = True
            return
        if self._someone_new:
            self._someone_new = False
            self._sent = {}
        self._waits = False
        self._last = time.monotonic()
        seen = {}
        news = []
        for name, kind, size, points, colours in _namespaces(now):
            per = _PIECE * (2 if kind == Marker.LINE_LIST else 1)
            for number, first in enumerate(range(0, len(points), per)):
                piece = points[first : first + per], colours[first : first + per]
                content = np.rint(piece[0] / _STILL).tobytes() + piece[1].tobytes()
                seen[name, number] = content
                if self._sent.get((name, number)) != content:
                    news.append((name, number, kind, Marker.ADD, size, *piece))
        gone = [(name, number, 0, Marker.DELETE, 0.0, np.zeros((0, 3)), np.zeros((0, 4), 'f4'))
                for name, number in self._sent.keys() - seen.keys()]
        self._sent = seen
        if news or gone:
            self._publisher.publish(_array_bytes(header_bytes(frame, stamp), news + gone))


def _namespaces(now: Snapshot) -> Iterator[tuple[str, int, float, Array, np.ndarray]]:
    """Yield name, type and size of what is drawn, its points (k, 3) and their colours (k, 4)."""
    manifold = now.graph.manifold
    factors = now.graph.between
    loops = now.loop_states()
    points = manifold.to_pose3(now.drawn)[:, :3]
    begin = points[np.maximum(factors.i, 0)]
    end = points[factors.j]
    world = factors.i == WORLD
    begin[world] = manifold.to_pose3(factors.measurement[world])[:, :3]
    lines = np.stack((begin, end), axis=1)
    odometry = lines[factors.is_odometry].reshape(-1, 3)
    yield 'keyframes', Marker.POINTS, _POINT, points, _colours(_BLUE, len(points))
    yield 'odometry', Marker.LINE_LIST, _LINE, odometry, _colours(_GREY, len(odometry))
    k = len(loops.rows)
    state = loops.state[:k]
    sigmas = np.nan_to_num(loops.sigmas[:k], nan=_WORST)
    ladder = np.stack([np.interp(sigmas, _SIGMAS, part) for part in _LADDER.T], axis=1)
    for name, kind in _LOOPS.items():
        chosen = state == kind
        yield (name, Marker.LINE_LIST, _LINE, lines[loops.rows[chosen]].reshape(-1, 3),
               _colours(np.repeat(ladder[chosen], 2, axis=0), 2 * int(np.count_nonzero(chosen))))


def _colours(rgb: Any, count: int) -> np.ndarray:
    """Return opaque colours, rounded to two digits, (count, 4)."""
    colours = np.ones((count, 4), np.float32)
    colours[:, :3] = np.round(rgb, 2)
    return colours


def _array_bytes(header: bytes, markers: list[tuple[Any, ...]]) -> bytes:
    """Return a serialised visualization_msgs/MarkerArray; all markers have one header."""
    parts = [(4, struct.pack('<I', len(markers)))]
    for name, number, kind, action, size, points, colours in markers:
        parts += ((4, header), (4, string_bytes(name)),
                  (4, struct.pack('<iii', number, kind, action)),
                  (8, struct.pack('<10d', 0, 0, 0, 0, 0, 0, 1, size, size, size)),
                  (4, struct.pack('<4f', 1, 1, 1, 1) + _FOR_EVER),
                  (4, struct.pack('<I', len(points))),
                  (8 if len(points) else 4, points.tobytes()),
                  (4, struct.pack('<I', len(colours)) + colours.tobytes()), (4, _NOTHING_ELSE))
    return cdr(*parts)
