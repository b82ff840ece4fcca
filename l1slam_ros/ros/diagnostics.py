# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The diagnostics of the back end, published once a second."""

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.running.improve import Improvement
from l1slam_ros.core.running.snapshot import Behind, Counts, Robot
from l1slam_ros.io.sentences import doubt_sentence
from l1slam_ros.ros.threads.failures import Failures
from l1slam_ros.ros.threads.intake import Traffic
from l1slam_ros.ros.threads.solver_thread import SolverThread

# [s], and the number of publications, which come once a second.
_MINUTE = 60
# [s] Loops that wait longer than this for their judgement are reported.
_BEHIND = 10.0
# Least number of judged loops for the warning that most are rejected.
_FEW = 5
# [m], [rad] A map that moves the robot by less is not reported as a jump.
_STILL = 1e-3


class RobotLine(NamedTuple):
    """
    The diagnostics of a robot.

    robot : its pose, None: no odometry yet; map_frame : returns the frame of its map, given
    whether it is joined to the first robot
    """

    name: str
    robot: Robot | None
    map_frame: Callable[[bool], str]

    def status(self, node: str, topics: Mapping[str, Traffic]) -> DiagnosticStatus:
        """Return its status; node : name of the node; topics : see `Diagnostics`."""
        level, robot = DiagnosticStatus.OK, self.robot
        frame = self.map_frame(robot is not None and robot.joined)
        sentence = f'in {frame}'
        if robot is None:
            level = DiagnosticStatus.STALE
            sentence = 'no odometry has come'
        elif not robot.joined:
            sentence += ': nothing that is believed joins it to the first robot'
        values = {'map_frame': frame, 'joined': robot is not None and robot.joined} | {
            name.removeprefix(f'{self.name}/') + f'.{key}': value
            for name, traffic in topics.items() if name.startswith(f'{self.name}/')
            for key, value in traffic.last.items()}
        return status_of(self.name, f'{node}: {self.name}', level, sentence, values)


def traffic_values(topics: Mapping[str, Traffic]) -> dict[str, object]:
    """Return the counts and rates of all topics, as `topic.value`."""
    return {f'{topic}.{name}': value for topic, traffic in topics.items()
            for name, value in traffic.values().items()}


def status_of(hardware: str, name: str, level: bytes, sentence: str,
              values: Mapping[str, object]) -> DiagnosticStatus:
    """Return a status with values as text."""
    return DiagnosticStatus(
        level=level, name=name, message=sentence, hardware_id=hardware,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])


def array_of(node: Node, statuses: list[DiagnosticStatus]) -> DiagnosticArray:
    """Return a message of statuses, stamped with the time of a node."""
    message = DiagnosticArray(status=statuses)
    message.header.stamp = node.get_clock().now().to_msg()
    return message


class Diagnostics:
    """
    Publishes the state of the back end.

    Parameters
    ----------
    node : whose name and clock it speaks with
    topics : name -> the traffic on it
    solver : its thread, which may be behind
    failures : the failures that last

    """

    def __init__(self, node: Node, topics: Mapping[str, Traffic], solver: SolverThread,
                 failures: Failures):
        self._node = node
        self._topics = topics
        self._solver = solver
        self._failures = failures
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._last: Improvement | None = None
        self._updates = 0
        self._jump: dict[str, str] = {}
        # Refused messages and jumps of the odometry, by causes.
        self._minute = deque([(Counter[str](), Counter[str]())], maxlen=_MINUTE)

    def note(self, improvement: Improvement) -> None:
        """Store the latest update."""
        self._last = improvement
        self._updates += 1

    def note_jump(self, manifold: Manifold, before: Array, after: Array, prefix: str) -> None:
        """
        Store how far a new map moved a robot, from a pose (1, p) before to one after.

        prefix : of its names
        """
        metres, radians = (float(way[0]) for way in manifold.motion(manifold.local(before, after)))
        if max(metres, radians) > _STILL:
            self._jump |= {f'{prefix}jump.translation': f'{metres:.4f}',
                           f'{prefix}jump.rotation': f'{radians:.5f}'}

    def publish(self, counts: Counts, behind: Behind, refused: Counter[str], twins: str,
                robots: Sequence[RobotLine] = ()) -> None:
        """
        Publish one status, and one of each robot.

        counts : of the back end; behind : its background work; refused : cause -> number of
        messages, since the start; twins : a sentence if the node's name is not unique, else
        empty; robots : those that have names.
        """
        told, judgement = Counter(counts.told), counts.verdict
        lately, broken = refused - self._minute[0][0], told - self._minute[0][1]
        self._minute.append((refused, told))
        values = traffic_values(self._topics) | dict(counts.sizes)
        values['updates'] = self._updates
        if self._last is not None:
            values |= {'l1_cost': f'{self._last.cost:.6g}', 'gap': f'{self._last.gap:.3g}',
                       'update_seconds': f'{self._last.seconds:.4f}',
                       'update_status': self._last.status.value}
        values |= {'odometry.drift': f'{judgement.drift:.4g}',
                   'judgement.confidence': f'{judgement.confidence:.3g}',
                   'judgement.doubts': '; '.join(doubt.kind for doubt in judgement.doubts)}
        values |= {f'behind.{name}': f'{value:.6g}' for name, value in asdict(behind).items()}
        values |= self._jump
        for cause, count in sorted((+refused).items()):
            values |= {f'refused.{cause}': count,
                       f'refused.{cause}.last_minute': lately[cause]}
        values |= {f'odometry.{cause}': count for cause, count in sorted(told.items())}
        level, sentence = self._judgement(counts, lately, broken, twins)
        name = self._node.get_fully_qualified_name()
        status = status_of(name, f'{name}: map', level, sentence, values)
        lines = [one.status(name, self._topics) for one in robots]
        self._publisher.publish(array_of(self._node, [status, *lines]))

    def _judgement(self, counts: Counts, lately: Counter[str], broken: Counter[str],
                   twins: str) -> tuple[bytes, str]:
        """Return the level, and a sentence with all that is wrong now."""
        if failing := self._failures.sentence:
            return DiagnosticStatus.ERROR, failing
        stamps = counts.stamps
        doubts = doubt_sentence(counts.verdict.doubts, np.arange(len(stamps)), stamps)
        wrong = [one for one in (twins, doubts) if one]
        wrong += filter(None, (traffic.unheard() for traffic in self._topics.values()))
        for name, traffic in self._topics.items():
            if name.endswith('odom') and (sources := traffic.publishers()) > 1:
                wrong.append(f'{name} has {sources} publishers; expected one')
        if lately:
            wrong.append('refused in the last minute: ' + ', '.join(
                f'{count} {cause}' for cause, count in sorted(lately.items())))
        if broken:
            causes = ', '.join(f'{count} {cause}' for cause, count in sorted(broken.items()))
            wrong.append(f'jumps of the odometry in the last minute: {causes}')
        sizes = counts.sizes
        rejected = sizes['rejected_loops']
        judged = rejected + sizes['accepted_loops'] + sizes['suspect_loops']
        if judged >= _FEW and rejected > judged / 2:
            wrong.append(f'{rejected} of {judged} loops are rejected')
        if self._solver.behind > _BEHIND:
            wrong.append(f'loops have not been judged for {self._solver.behind:.0f} s')
        return (DiagnosticStatus.WARN, '; '.join(wrong)) if wrong else (DiagnosticStatus.OK, 'ok')
