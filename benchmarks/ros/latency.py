# SPDX-License-Identifier: Apache-2.0
"""
How late poses come, and how many transforms are older than the newest odometry, at 50 Hz.

    python benchmarks/ros/latency.py [KEYFRAMES [SECONDS]]

The node goes on from a saved map of so many keyframes, with its solver at work; in turns without
and with somebody who looks at `graph`, which is a process of its own and takes bytes as they come.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

# Its own domain: nobody else's odometry is counted.
os.environ.setdefault('ROS_DOMAIN_ID', '94')
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import GraphRecord, write_graph_file
from l1slam_ros.io.messages.conversion import stamp_of
from l1slam_ros.ros.demo import executable
from l1slam_ros.ros.publishing import header

KEYFRAMES, SECONDS, TURNS = 10_000, 20.0, 3
_RATE, _STEP = 50.0, 0.05  # [1/s], [m]: five keyframes a second


class Probe:
    """Sends odometry and notes when its pose comes, and how old each transform is."""

    def __init__(self) -> None:
        self.node = rclpy.create_node('probe')
        self._odometry = self.node.create_publisher(Odometry, 'odom', QoSProfile(depth=1000))
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

    def drive(self, seconds: float) -> str:
        """Send odometry for some seconds; return what came of it."""
        self._late, self._old, began = [], [], time.monotonic()
        for k in range(int(seconds * _RATE)):
            while (left := began + k / _RATE - time.monotonic()) > 0:
                rclpy.spin_once(self.node, timeout_sec=left)
            self._newest = 10**13 + round(self._count / _RATE * 1e9)
            message = Odometry(header=header('odom', self._newest), child_frame_id='base_link')
            message.pose.pose.position.x = _STEP * self._count
            self._sent[self._newest] = time.monotonic()
            self._odometry.publish(message)
            self._count += 1
        p50, p99 = 1e3 * np.percentile(self._late, (50, 99))
        return (f'pose after {p50:.1f} ms, p99 {p99:.1f} ms; {sum(self._old)} of '
                f'{len(self._old)} transforms older than the newest odometry')


def main() -> int:
    """Measure and print."""
    if sys.argv[1:] == ['look']:
        return _look()
    n = int(sys.argv[1]) if len(sys.argv) > 1 else KEYFRAMES
    seconds = float(sys.argv[2]) if len(sys.argv) > 2 else SECONDS
    rclpy.init()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'map.g2o'
        world = simulate_world(n, 2 * n, WorldOptions(), np.random.default_rng(0))
        stamps = 10**9 + np.arange(n) * 10**8
        write_graph_file(path, GraphRecord(world.graph, world.truth, np.arange(n), stamps))
        backend = subprocess.Popen([executable('backend'), '--ros-args',
                                    '-p', f'save_path:={path}', '-p', 'autosave_period:=0.0'])
        try:
            probe = Probe()
            _load(probe.node)
            probe.drive(seconds / 4)
            for _ in range(TURNS):
                print('nobody looks:  ', probe.drive(seconds), flush=True)
                looker = subprocess.Popen([sys.executable, __file__, 'look'])
                probe.drive(2.0)  # it takes a while to begin
                print('somebody looks:', probe.drive(seconds), flush=True)
                looker.send_signal(signal.SIGINT)
                looker.wait()
        finally:
            backend.send_signal(signal.SIGINT)
            backend.wait()
    return 0


def _load(node: Any) -> None:
    client = node.create_client(Trigger, '/backend/load')
    client.wait_for_service()
    answer = client.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(node, answer)
    print(answer.result().message)


def _look() -> int:
    """Take markers until SIGINT; print how many bytes."""
    rclpy.init()
    node, sizes = rclpy.create_node('looker'), []
    node.create_subscription(MarkerArray, 'graph', lambda data: sizes.append(len(data)),
                             QoSProfile(depth=100), raw=True)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    print(f'{len(sizes)} messages of {sum(sizes) / 1e6:.1f} MB in all', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
