# SPDX-License-Identifier: Apache-2.0
"""What the node says of itself on /diagnostics, once a second."""

from collections import Counter
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from l1slam_ros.core.backend import Improvement


class Diagnosis:
    """
    Publishes the state of the back end.

    Parameters
    ----------
    node : whose name and clock it speaks with

    """

    def __init__(self, node: Node):
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._last: Improvement | None = None
        self._updates = 0

    def note(self, improvement: Improvement) -> None:
        """Remember the latest update; called by the worker."""
        self._last = improvement
        self._updates += 1

    def publish(self, counts: Mapping[str, int], refused: Counter[str]) -> None:
        """
        Publish one status.

        counts : sizes of the graph; refused : cause -> how many messages, since the start.
        """
        values: dict[str, object] = dict(counts)
        values['updates'] = self._updates
        if self._last is not None:
            values |= {'l1_cost': f'{self._last.cost:.6g}', 'gap': f'{self._last.gap:.3g}',
                       'update_seconds': f'{self._last.seconds:.4f}',
                       'update_status': self._last.status.value}
        values |= {f'refused.{cause}': count for cause, count in sorted(refused.items()) if count}
        name = self._node.get_fully_qualified_name()
        some_refused = any(refused.values())
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if some_refused else DiagnosticStatus.OK,
            name=f'{name}: map',
            message='some messages were refused' if some_refused else 'ok',
            hardware_id=name,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
