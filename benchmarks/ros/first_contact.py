# SPDX-License-Identifier: Apache-2.0
"""
What the node costs when it has nothing to do, and how soon it answers when it has much.

    python benchmarks/ros/first_contact.py GRAPH [POSES [EDGES]]

A saved map of GRAPH is loaded and settles: processor's time then, in % of a core, without
odometry and with that of a robot that stands, at 50 Hz; the same after 20,000 loops have expired,
and what a bare rclpy node takes that answers each message with an empty pose. Then a
simulated world (50,000 poses, 80,000 edges) is loaded, services are called while it is judged, and
SIGTERM ends the node amid an update. The node is a process, run as shipped.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

# Its own domain: nobody else's messages are counted.
os.environ.setdefault('ROS_DOMAIN_ID', '94')
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool, Trigger
from throughput import cpu_seconds

from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file, write_graph_file
from l1slam_ros.io.messages.conversion import reference_frame_id
from l1slam_ros.ros.demo import executable
from l1slam_ros.ros.publishing import header

LOOPS, POSES, EDGES = 20_000, 50_000, 80_000
_SECOND = 10**9  # [ns]
_PATIENCE = 900.0  # [s]
_QUIET = 10.0  # [s] without an update: the map has settled
_WATCHED = 15.0  # [s] over which processor's time is taken
_PACE = 1e-3  # [s] from loop to loop
_STANDING = 0.02  # [s] from odometry to odometry
_WAIT = 11  # [s] longer than loops wait
# [s] after the last moment, which begins with the load
_MOMENTS = (0.0, 1.0, 4.0, 15.0, 30.0)


class Running:
    """The node as a process, with the file of `~/load` and `~/save`, and a peer to talk to it."""

    def __init__(self, node: Any, path: Path, process: 'subprocess.Popen[bytes]'):
        self.node, self.path, self.process = node, path, process
        self.said: dict[str, str] = {}
        self.message = ''
        qos = QoSProfile(depth=1000)
        self.odometry = node.create_publisher(Odometry, 'odom', qos)
        self.loops = node.create_publisher(PoseWithCovarianceStamped, 'loop_closures', qos)
        node.create_subscription(DiagnosticArray, '/diagnostics', self._hear, 10)
        self.until(lambda: bool(self.said) and self.loops.get_subscription_count() == 1
                   and 'compiling' not in self.message)

    def _hear(self, message: DiagnosticArray) -> None:
        (status,) = message.status
        self.message = status.message
        self.said = {value.key: value.value for value in status.values}

    def until(self, condition: Callable[[], bool]) -> None:
        """Listen until something holds."""
        deadline = time.monotonic() + _PATIENCE
        while not condition():
            assert time.monotonic() < deadline, f'waited {_PATIENCE} s in vain: {self.said}'
            rclpy.spin_once(self.node, timeout_sec=0.1)

    def listen(self, seconds: float) -> None:
        """Listen for some time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            rclpy.spin_once(self.node, timeout_sec=left)

    def call(self, name: str, request: Any = None) -> tuple[float, str]:
        """Return how long a service took to answer [s], and its sentence."""
        kind = SetBool if name == 'pause' else Trigger
        client = self.node.create_client(kind, f'/backend/{name}')
        self.until(client.service_is_ready)
        began = time.monotonic()
        future = client.call_async(request or kind.Request())
        self.until(future.done)
        return time.monotonic() - began, future.result().message

    def send_odometry(self, stamp: int) -> None:
        """Tell, at a time [ns], that the robot stands."""
        self.odometry.publish(Odometry(header=header('odom', stamp), child_frame_id='base_link'))

    def busy(self, seconds: float, work: Callable[[], None] = lambda: None,
             every: float = 0.1) -> float:
        """Return the processor's time [% of a core] while listening, and doing some work."""
        cpu, began = cpu_seconds(self.process.pid), time.monotonic()
        while time.monotonic() < began + seconds:
            work()
            self.listen(every)
        spent = time.monotonic() - began
        return (cpu_seconds(self.process.pid) - cpu) / spent * 100


@contextmanager
def running(path: Path) -> Iterator[Running]:
    """Run the node on a saved map; it may be ended within."""
    process = subprocess.Popen([executable('backend'), '--ros-args', '--log-level', 'warn',
                                '-p', f'save_path:={path}'])
    node = rclpy.create_node('robot')
    try:
        yield Running(node, path, process)
        process.send_signal(signal.SIGINT)
        process.wait(_QUIET)
    finally:
        process.kill()
        process.wait()
        node.destroy_node()


def main() -> None:
    """Measure, and print."""
    if sys.argv[1:] == ['bare']:
        _answer()
        return
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('graph', type=Path)
    parser.add_argument('poses', type=int, nargs='?', default=POSES)
    parser.add_argument('edges', type=int, nargs='?', default=EDGES)
    given = parser.parse_args()
    rclpy.init()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'map.g2o'
        record = read_graph_file(given.graph)
        write_graph_file(path, replace(record, stamps=_stamps(len(record.ids))))
        with running(path) as backend:
            _at_rest(backend, len(record.ids))
        _bare()
        world = simulate_world(
            given.poses, given.edges, WorldOptions(), np.random.default_rng(0))
        write_graph_file(path, GraphRecord(
            world.graph, world.odometry, np.arange(given.poses), _stamps(given.poses)))
        with running(path) as backend:
            _at_work(backend)


def _stamps(count: int) -> np.ndarray:
    return 1000 * _SECOND + np.arange(count, dtype=np.int64) * (_SECOND // 10)


def _at_rest(backend: Running, count: int) -> None:
    """Print the processor's time of a settled map, before and after loops have expired."""
    began = time.monotonic()
    _tell('load', *backend.call('load'))
    _settle(backend)
    said = ', '.join(f'{backend.said[name]} {name}' for name in (
        'keyframes', 'accepted_loops', 'rejected_loops', 'suspect_loops', 'updates'))
    print(f'settled within {time.monotonic() - began - _QUIET:.0f} s: {said}', flush=True)
    now = [int(_stamps(count)[-1]) + _SECOND]

    def stand() -> None:
        now[0] += round(_STANDING * _SECOND)
        backend.send_odometry(now[0])

    def measured(what: str) -> None:
        print(f'{what:28}{backend.busy(_WATCHED):7.2f} % of a core; '
              f'{backend.busy(_WATCHED, stand, _STANDING):7.2f} % with odometry', flush=True)

    measured('at rest')
    stand()
    far = now[0] + 1000 * _SECOND
    for k in range(LOOPS):
        # Each says something else: none repeats another.
        loop = PoseWithCovarianceStamped(
            header=header(reference_frame_id('base_link', 1000 * _SECOND), far))
        loop.pose.pose.position.x = 1.0 + k / LOOPS
        loop.pose.pose.orientation.w = 1.0
        backend.loops.publish(loop)
        backend.listen(_PACE)
    backend.until(lambda: int(backend.said['waiting_loops']) == LOOPS)
    now[0] += _WAIT * _SECOND
    # A time far ahead is believed once another follows it.
    stand()
    stand()
    backend.until(lambda: int(backend.said['expired_loops']) == LOOPS)
    _settle(backend)
    measured(f'{LOOPS} loops expired')


def _bare() -> None:
    """Print the processor's time of a node that answers odometry, and does nothing else."""
    process = subprocess.Popen([sys.executable, __file__, 'bare'])
    node = rclpy.create_node('robot')
    try:
        publisher = node.create_publisher(Odometry, 'odom', QoSProfile(depth=1000))
        while not publisher.get_subscription_count():
            time.sleep(_STANDING)
        time.sleep(1.0)
        cpu, began, count = cpu_seconds(process.pid), time.monotonic(), 0
        while (spent := time.monotonic() - began) < _WATCHED:
            publisher.publish(Odometry(header=header('odom', 1 + count)))
            count += 1
            time.sleep(max(count * _STANDING - spent, 0.0))
        busy = (cpu_seconds(process.pid) - cpu) / spent * 100
        print(f'{"a bare node":28}{"":20}{busy:7.2f} % with odometry', flush=True)
    finally:
        process.kill()
        process.wait()
        node.destroy_node()


def _answer() -> None:
    rclpy.init()
    node = rclpy.create_node('bare')
    publisher, pose = node.create_publisher(PoseStamped, 'pose', 10), PoseStamped()
    node.create_subscription(Odometry, 'odom', lambda _: publisher.publish(pose),
                             QoSProfile(depth=1000))
    rclpy.spin(node)


def _settle(backend: Running) -> None:
    """Wait until there has been no update for some time."""
    seen = ''
    while seen != backend.said['updates']:
        seen = backend.said['updates']
        backend.listen(_QUIET)


def _at_work(backend: Running) -> None:
    """Print how soon services answer while a large map is judged, and how soon SIGTERM ends it."""
    _tell('load', *backend.call('load'))
    for wait in _MOMENTS:
        print(f'after {wait:g} s more, with {backend.busy(wait):.0f} % of a core at work')
        _tell('save', *backend.call('save'))
        _tell('pause', *backend.call('pause', SetBool.Request(data=True)))
        _tell('pause', *backend.call('pause', SetBool.Request(data=False)))
    backend.listen(2.0)
    _tell('reset', *backend.call('reset'))
    _tell('load', *backend.call('load'))
    print(f'SIGTERM, with {backend.busy(4.0):.0f} % of a core at work')
    began = time.monotonic()
    backend.process.send_signal(signal.SIGTERM)
    code = backend.process.wait(_PATIENCE)
    print(f'ended after {time.monotonic() - began:.2f} s with exit code {code}')


def _tell(name: str, seconds: float, sentence: str) -> None:
    print(f'~/{name:8}{seconds:7.2f} s  {sentence}', flush=True)


if __name__ == '__main__':
    main()
