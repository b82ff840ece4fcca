# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`backend` as a process of its own, and a peer that plays to it, hears it and calls it."""

import argparse
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np

from l1slam_ros.ros.shell.domain import go_where_nobody_is

# Its children share it: nobody else's messages are counted.
if 'ROS_DOMAIN_ID' not in os.environ:
    go_where_nobody_is()

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from std_srvs.srv import SetBool, Trigger

from l1slam_ros.io.bags.topics import LOOP_TOPIC, ODOMETRY_TOPIC
from l1slam_ros.io.messages.conversion import stamp_of
from l1slam_ros.ros.shell.installed import executable

KINDS = {ODOMETRY_TOPIC: Odometry, LOOP_TOPIC: PoseWithCovarianceStamped}
PATIENCE = 900.0  # [s]
AnyPeer = TypeVar('AnyPeer', bound='Peer')


class UpdateTimes:
    """How long updates took, as the diagnostics of the node say it once a second."""

    def __init__(self) -> None:
        self._seconds: list[float] = []
        self._updates = '0'

    def note(self, said: Mapping[str, str]) -> None:
        """Note what the diagnostics say, by name, if there was an update since the last ones."""
        updates = said.get('updates', '0')
        if updates not in ('0', self._updates):
            self._updates = updates
            self._seconds.append(float(said['update_seconds']))

    @property
    def sentence(self) -> str:
        """What is to be said of them."""
        took = 1e3 * np.array(self._seconds)
        return (f'{len(took)} updates looked at: median {np.median(took):.1f} ms, p99 '
                f'{np.percentile(took, 99):.1f}, worst {took.max():.1f}')


class Peer:
    """
    The node as a process, with some parameters, and who talks to it; a context manager.

    Attributes
    ----------
    maps : all Paths that came, as bytes: decoding one of 50,000 poses takes seconds, in which
    nothing else would be heard; said : by name, what the last diagnostics say, their sentence is
    `message`; publishers : of `KINDS`, by topic

    """

    def __init__(self, parameters: Mapping[str, object], within: Sequence[str] = (),
                 more: Sequence[str] = ()):
        self.process = subprocess.Popen([
            *within, executable('backend'), '--ros-args', '--log-level', 'error',
            *(part for name, value in parameters.items() for part in ('-p', f'{name}:={value}')),
            *more])
        self.node = rclpy.create_node('peer')
        self.maps: list[bytes] = []
        self.said: dict[str, str] = {}
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(PathMessage, 'path', self.maps.append, latched,
                                      raw=True)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._hear, 10)
        self.publishers = {topic: self.node.create_publisher(kind, topic, QoSProfile(depth=1000))
                           for topic, kind in KINDS.items()}
        self.until(lambda: 'message' in self.said and all(
            p.get_subscription_count() for p in self.publishers.values()))

    def __enter__(self: AnyPeer) -> AnyPeer:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    def _hear(self, message: DiagnosticArray) -> None:
        (status,) = message.status
        self.said = {value.key: value.value for value in status.values}
        self.said['message'] = status.message

    def newest(self) -> PathMessage:
        """Return the Path that came last."""
        return deserialize_message(self.maps[-1], PathMessage)

    def until(self, condition: Callable[[], bool]) -> None:
        """Listen until something holds."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert self.process.poll() is None, 'the node has ended'
            assert time.monotonic() < deadline, f'waited {PATIENCE} s in vain: {self.said}'
            rclpy.spin_once(self.node, timeout_sec=0.02)

    def listen(self, seconds: float) -> None:
        """Listen for some time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            rclpy.spin_once(self.node, timeout_sec=left)

    def until_calm(self, name: str, seconds: float = 2.5) -> None:
        """Listen until the diagnostics have said the same for some time."""
        seen = ''
        while seen != self.said[name]:
            seen = self.said[name]
            self.listen(seconds)

    def call(self, name: str, request: Any = None) -> tuple[float, str]:
        """Return how long a service took to answer [s], and its sentence."""
        kind = SetBool if name == 'pause' else Trigger
        client = self.node.create_client(kind, f'/backend/{name}')
        self.until(client.service_is_ready)
        began = time.monotonic()
        future = client.call_async(request or kind.Request())
        self.until(future.done)
        return time.monotonic() - began, future.result().message

    def end(self, number: int = signal.SIGINT) -> int:
        """End the node by a signal, and the peer; return the exit code."""
        self.process.send_signal(number)
        code = self.process.wait(PATIENCE)
        self.node.destroy_node()
        return code


def heard(node: Any, kind: Any, topic: str) -> list[tuple[int, int]]:
    """Return what will hold when each message was sent, or what it answers, and when it came."""
    notes: list[tuple[int, int]] = []
    node.create_subscription(
        kind, topic, lambda m: notes.append((stamp_of(m.header), time.monotonic_ns())),
        QoSProfile(depth=1000))
    return notes


def spin(node: Any) -> None:
    """Let a node work until a signal."""
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


def cpu_seconds(process: int) -> float:
    """Return the processor's time that a process has taken [s]."""
    with open(f'/proc/{process}/stat') as file:
        fields = file.read().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def arguments(text: str | None, **defaults: Any) -> argparse.Namespace:
    """
    Return the arguments of a command.

    text : what it does; defaults : of what may be left out, of the others what they are
    """
    parser = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in defaults.items():
        if isinstance(default, type):
            parser.add_argument(name, type=default)
        else:
            parser.add_argument(name, type=type(default), nargs='?', default=default)
    return parser.parse_args()
