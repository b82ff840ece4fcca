# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How late poses come, and how many transforms are older than the newest odometry, at 50 Hz.

    python benchmarks/ros/latency.py [KEYFRAMES [SECONDS [TURNS]]]

The node goes on from a saved map of so many keyframes, with its solver at work; in many short
turns without and with somebody who looks at `graph`, so that what else the machine does meets both
alike. Who looks is a process of its own and takes bytes as they come. Said is what all turns of a
kind gave together, and how much as noise alone: the turns in which nobody looked, every other one
against the rest.
"""

import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from peer import Peer, arguments
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from visualization_msgs.msg import MarkerArray

from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.bags.topics import ODOMETRY_TOPIC
from l1slam_ros.io.graphs.graph_file import GraphRecord, write_graph_file
from l1slam_ros.io.messages.conversion import stamp_of
from l1slam_ros.ros.shell.header import header

KEYFRAMES = 10_000
SECONDS = 5.0
TURNS = 12
_BETWEEN = 1.5  # [s] from one turn to the next: who begins to look is sent all of the graph
_RATE, _STEP = 50.0, 0.05  # [1/s], [m]: five keyframes a second


class Probe:
    """Sends odometry and notes when its pose comes, and how old each transform is."""

    def __init__(self, peer: Peer):
        self.node, self._odometry = peer.node, peer.publishers[ODOMETRY_TOPIC]
        self.node.create_subscription(PoseStamped, 'pose', self._on_pose, 1000)
        self.node.create_subscription(TransformStamped, 'map_to_odom', self._on_transform, 1000)
        self._sent: dict[int, float] = {}
        self._count = self._newest = 0
        self._late: list[float] = []
        self._old: list[bool] = []

    def _on_pose(self, message: PoseStamped) -> None:
        self._late.append(time.monotonic() - self._sent[stamp_of(message.header)])

    def _on_transform(self, message: TransformStamped) -> None:
        self._old.append(stamp_of(message.header) < self._newest)

    def drive(self, seconds: float) -> tuple[list[float], list[bool]]:
        """Send odometry; return how late each pose was [s], and which transforms were older."""
        self._late = []
        self._old = []
        began = time.monotonic()
        for k in range(int(seconds * _RATE)):
            while (left := began + k / _RATE - time.monotonic()) > 0:
                rclpy.spin_once(self.node, timeout_sec=left)
            self._newest = 10**13 + round(self._count / _RATE * 1e9)
            message = Odometry(header=header('odom', self._newest), child_frame_id='base_link')
            message.pose.pose.position.x = _STEP * self._count
            self._sent[self._newest] = time.monotonic()
            self._odometry.publish(message)
            self._count += 1
        return self._late, self._old


def main() -> int:
    """Measure and print."""
    if sys.argv[1:] == ['look']:
        return _look()
    given = arguments(__doc__, keyframes=KEYFRAMES, seconds=SECONDS, turns=TURNS)
    n = given.keyframes
    rclpy.init()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'map.g2o'
        world = simulate_world(n, 2 * n, WorldOptions(), np.random.default_rng(0))
        stamps = 10**9 + np.arange(n) * 10**8
        write_graph_file(path, GraphRecord(world.graph, world.truth, np.arange(n), stamps))
        looker = subprocess.Popen([sys.executable, __file__, 'look'], stdin=subprocess.PIPE,
                                  stdout=subprocess.PIPE, text=True)
        try:
            with Peer({'save_path': path, 'autosave_period': 0.0}) as peer:
                probe = Probe(peer)
                print(peer.call('load')[1])
                probe.drive(4 * _BETWEEN)
                _tell(*_measure(probe, looker, given.seconds, given.turns))
                print(looker.communicate('end\n')[0].strip())
                peer.end()
        finally:
            looker.kill()
    return 0


def _measure(probe: Probe, looker: 'subprocess.Popen[str]', seconds: float, turns: int
             ) -> tuple[list[list[float]], list[bool]]:
    """Return how late poses were in each turn, nobody looks in those that are even [s]."""
    late, old = [], []
    assert looker.stdin is not None
    for turn in range(2 * turns):
        looker.stdin.write('look\n' if turn % 2 else 'away\n')
        looker.stdin.flush()
        probe.drive(_BETWEEN)
        found = probe.drive(seconds)
        late.append(found[0])
        old += found[1]
    return late, old


def _tell(late: list[list[float]], old: list[bool]) -> None:
    p99 = {}
    for name, first, step in (('nobody looks', 0, 2), ('somebody looks', 1, 2),
                              ('one half', 0, 4), ('the other', 2, 4)):
        p50, p95, p99[name] = 1e3 * np.percentile(
            [one for turn in late[first::step] for one in turn], (50, 95, 99))
        print(f'{name + ":":16}pose after {p50:.2f} ms, p95 {p95:.2f}, p99 {p99[name]:.2f} ms')
    print(f'p99 {p99["somebody looks"] / p99["nobody looks"]:.2f} times that without; noise alone '
          f'{p99["one half"] / p99["the other"]:.2f}')
    print(f'{sum(old)} of {len(old)} transforms older than the newest odometry')


def _look() -> int:
    """Take markers while told to look; print how many bytes."""
    rclpy.init()
    node = rclpy.create_node('looker')
    sizes = [0]
    subscription = None
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    for line in sys.stdin:
        if subscription is not None:
            node.destroy_subscription(subscription)
            subscription = None
        if line == 'look\n':
            subscription = node.create_subscription(
                MarkerArray, 'graph', lambda data: sizes.append(len(data)), QoSProfile(depth=100),
                raw=True)
        if line == 'end\n':
            break
    print(f'{len(sizes) - 1} messages on graph of {sum(sizes) / 1e6:.1f} MB in all', flush=True)
    os._exit(0)


if __name__ == '__main__':
    sys.exit(main())
