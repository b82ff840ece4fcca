# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Publishing the state of each loop on `loop_status`, when it comes and at each change."""

import struct
from collections.abc import Sequence

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.running.snapshot import ACCEPTED, EXPIRED, LOOP_STATES, WAITING, LoopStates
from l1slam_ros.io.files import stamp_text
from l1slam_ros.io.messages.serialisation import cdr, header_bytes, string_bytes

# Number of messages that a late subscriber still receives.
_DEPTH = 1000


class LoopStatus:
    """
    Publishes the states of loops as they change.

    Parameters
    ----------
    node : to publish with
    robots : names by number; empty for a single robot without a name

    """

    def __init__(self, node: Node, robots: Sequence[str] = ()):
        self._node, self._robots = node, robots
        latched = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = node.create_publisher(DiagnosticArray, 'loop_status', latched)
        # States of those in the graph; robots and stamps of those that have expired, many, in
        # order, and of those that wait.
        self._in_graph: Indices = np.zeros(0, np.int64)
        self._expired: Indices = np.zeros((0, 4), np.int64)
        self._waiting: set[tuple[int, ...]] = set()

    def publish(self, states: LoopStates) -> None:
        """Publish the loops whose state has changed since the last call."""
        known, count = len(self._in_graph), len(states.rows)
        if count < known:  # the map began anew
            known = 0
            self._waiting = set()
        now = states.state[:count]
        changed = np.ones(len(states.state), bool)
        changed[:known] = now[:known] != self._in_graph[:known]
        (expired,) = np.nonzero(states.state == EXPIRED)
        named = np.hstack((states.robots, states.stamps))
        gone = named[expired]
        before = len(self._expired)
        changed[expired[:before]] = not np.array_equal(gone[:before], self._expired)
        (waits,) = np.nonzero(states.state == WAITING)
        waiting = [tuple(one) for one in named[waits].tolist()]
        changed[waits] = [one not in self._waiting for one in waiting]
        rows = np.flatnonzero(changed).tolist()
        self._in_graph = now.copy()
        self._expired = gone
        self._waiting = set(waiting)
        if rows:
            name, clock = self._node.get_fully_qualified_name(), self._node.get_clock()
            self._publisher.publish(states_bytes(
                name, clock.now().nanoseconds, states, rows, self._robots))


def states_bytes(name: str, stamp: int, states: LoopStates, rows: list[int],
                 robots: Sequence[str] = ()) -> bytes:
    """
    Return a serialised diagnostic_msgs/DiagnosticArray: loops come and change by the hundred.

    name : of the node; stamp : of the message [ns]; rows : of the states; robots : see
    `LoopStatus`
    """
    parts = [(4, header_bytes('', stamp)), (4, struct.pack('<I', len(rows)))]
    for row in rows:
        reference, end = (stamp_text(int(value)) for value in states.stamps[row])
        state, sigmas = int(states.state[row]), float(states.sigmas[row])
        level = DiagnosticStatus.OK if state in (ACCEPTED, WAITING) else DiagnosticStatus.WARN
        values = ['reference_stamp', reference, 'stamp', end, 'state', LOOP_STATES[state],
                  'sigmas', '' if np.isnan(sigmas) else f'{sigmas:.2f}']
        if robots:
            # Of a loaded map there may be robots that the node has no name for.
            one, other = (robots[number] if number < len(robots) else str(number)
                          for number in states.robots[row].tolist())
            values += 'reference_robot', one, 'robot', other
            reference, end = f'{one} {reference}', f'{other} {end}'
        texts = f'{name}: loop {reference} - {end}', LOOP_STATES[state], name
        parts += ((1, level), *((4, string_bytes(text)) for text in texts),
                  (4, struct.pack('<I', len(values) // 2)),
                  *((4, string_bytes(text)) for text in values))
    return cdr(*parts)
