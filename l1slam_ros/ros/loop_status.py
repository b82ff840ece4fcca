# SPDX-License-Identifier: Apache-2.0
"""What has become of each loop, on `loop_status`: a status when one comes, and on each change."""

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.online.loop_states import ACCEPTED, LOOP_STATES, WAITING, LoopStates
from l1slam_ros.io.files import stamp_text

# Who comes late still gets the last changes.
_DEPTH = 1000


class LoopStatus:
    """
    Publishes the states of loops as they change.

    Parameters
    ----------
    node : whose name and clock it speaks with

    """

    def __init__(self, node: Node):
        self._node = node
        latched = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = node.create_publisher(DiagnosticArray, 'loop_status', latched)
        self._in_graph: Indices = np.zeros(0, np.int64)
        self._outside: set[tuple[int, int, int]] = set()

    def publish(self, states: LoopStates) -> None:
        """Publish the loops whose state is another than at the last call; called by the worker."""
        known, count = len(self._in_graph), len(states.rows)
        if count < known:  # the map began anew
            known, self._outside = 0, set()
        now = states.state[:count]
        changed = np.ones(count, bool)
        changed[:known] = now[:known] != self._in_graph[:known]
        rows = np.flatnonzero(changed).tolist()
        outside = {(*stamps, state): count + k for k, (stamps, state) in enumerate(zip(
            states.stamps[count:].tolist(), states.state[count:].tolist(), strict=True))}
        rows += [row for key, row in outside.items() if key not in self._outside]
        self._in_graph, self._outside = now.copy(), set(outside)
        if rows:
            self._send(states, rows)

    def _send(self, states: LoopStates, rows: list[int]) -> None:
        name = self._node.get_fully_qualified_name()
        message = DiagnosticArray(status=[_status(name, states, row) for row in rows])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


def _status(name: str, states: LoopStates, row: int) -> DiagnosticStatus:
    reference, stamp = (stamp_text(int(value)) for value in states.stamps[row])
    state, sigmas = int(states.state[row]), float(states.sigmas[row])
    values = {'reference_stamp': reference, 'stamp': stamp, 'state': LOOP_STATES[state],
              'sigmas': '' if np.isnan(sigmas) else f'{sigmas:.2f}'}
    fine = state in (ACCEPTED, WAITING)
    return DiagnosticStatus(
        level=DiagnosticStatus.OK if fine else DiagnosticStatus.WARN,
        name=f'{name}: loop {reference} - {stamp}', message=LOOP_STATES[state], hardware_id=name,
        values=[KeyValue(key=key, value=value) for key, value in values.items()])
