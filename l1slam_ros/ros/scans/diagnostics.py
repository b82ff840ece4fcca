# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The diagnostics of `scan_loops`, published once a second."""

from collections import Counter, deque
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from l1slam_ros.ros.diagnostics import array_of, status_of, traffic_values
from l1slam_ros.ros.scans.front_end_thread import FrontEndThread
from l1slam_ros.ros.scans.map_drawer import MapDrawer
from l1slam_ros.ros.threads.failures import Failures
from l1slam_ros.ros.threads.intake import Traffic

# Seconds, which are as many publications.
_MINUTE = 60
_SAID = {'left_out': 'left out, for want of time', 'expired': 'expired, for no odometry surrounds '
         'them', 'old_stamp': 'of an old stamp'}


class ScanDiagnostics:
    """
    Publishes the state of the front end.

    Parameters
    ----------
    node : to publish with
    topics : name -> the traffic on it
    front_end : whose state
    drawer : of the map
    failures : the failures that last

    """

    def __init__(self, node: Node, topics: Mapping[str, Traffic], front_end: FrontEndThread,
                 drawer: MapDrawer, failures: Failures):
        self._node = node
        self._topics = topics
        self._front_end = front_end
        self._drawer, self._failures = drawer, failures
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._minute = deque([Counter[str]()], maxlen=_MINUTE)

    def publish(self) -> None:
        """Publish one status."""
        front_end = self._front_end
        queue = self._front_end.queue
        lost = queue.counts.copy() + front_end.refused.copy()
        lately = lost - self._minute[0]
        self._minute.append(Counter(lost))
        values = traffic_values(self._topics) | {
            name: front_end.run.counts[name]
            for name in ('scans', 'keyframes', 'parts', 'loops', 'comparisons')}
        values['waiting'] = queue.waiting
        values |= {f'refused.{cause}': count for cause, count in sorted(lost.items())}
        median, most = front_end.run.cost()
        values |= {'scan_seconds.median': f'{median:.5f}', 'scan_seconds.p99': f'{most:.5f}',
                   'map.cells': self._drawer.cells}
        level, sentence = self._judgement(lately)
        name = self._node.get_fully_qualified_name()
        self._publisher.publish(array_of(self._node, [
            status_of(name, f'{name}: scans', level, sentence, values)]))

    def _judgement(self, lately: Counter[str]) -> tuple[bytes, str]:
        """Return the level, and a sentence with all that is wrong now."""
        if failing := self._failures.sentence:
            return DiagnosticStatus.ERROR, failing
        wrong = [*filter(None, (traffic.unheard() for traffic in self._topics.values()))]
        if lately:
            wrong.append('messages not used in the last minute: ' + ', '.join(
                f'{count} {_SAID.get(cause, cause)}' for cause, count in sorted(lately.items())))
        if (sources := self._topics['odom'].publishers()) > 1:
            wrong.append(f'odom has {sources} publishers; expected one')
        missing = [topic for topic in ('scan', 'odom', 'path')
                   if not self._topics[topic].publishers()]
        if missing:
            wrong.append(f'nobody publishes {", ".join(missing)}')
        return (DiagnosticStatus.WARN, '; '.join(wrong)) if wrong else (DiagnosticStatus.OK, 'ok')
