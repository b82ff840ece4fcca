# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
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

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from peer import Peer, arguments, cpu_seconds
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool

from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.bags.topics import LOOP_TOPIC, ODOMETRY_TOPIC
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file, write_graph_file
from l1slam_ros.io.messages.conversion import reference_frame_id
from l1slam_ros.ros.shell.header import header

LOOPS = 20_000
POSES = 50_000
EDGES = 80_000
_SECOND = 10**9  # [ns]
_QUIET = 10.0  # [s] without an update: the map has settled
_WATCHED = 15.0  # [s] over which processor's time is taken
_PACE = 1e-3  # [s] from loop to loop
_STANDING = 0.02  # [s] from odometry to odometry
_WAIT = 11  # [s] longer than loops wait
# [s] after the last moment, which begins with the load
_MOMENTS = (0.0, 1.0, 4.0, 15.0, 30.0)


class Running(Peer):
    """A peer of a node with a saved map, and how busy that is."""

    def send_odometry(self, stamp: int) -> None:
        """Tell, at a time [ns], that the robot stands."""
        self.publishers[ODOMETRY_TOPIC].publish(
            Odometry(header=header('odom', stamp), child_frame_id='base_link'))

    def busy(self, seconds: float, work: Callable[[], None] = lambda: None,
             every: float = 0.1) -> float:
        """Return the processor's time [% of a core] while listening, and doing some work."""
        cpu, began = cpu_seconds(self.process.pid), time.monotonic()
        while time.monotonic() < began + seconds:
            work()
            self.listen(every)
        spent = time.monotonic() - began
        return (cpu_seconds(self.process.pid) - cpu) / spent * 100


def main() -> None:
    """Measure, and print."""
    if sys.argv[1:] == ['bare']:
        _answer()
        return
    given = arguments(__doc__, graph=Path, poses=POSES, edges=EDGES)
    rclpy.init()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'map.g2o'
        record = read_graph_file(given.graph)
        write_graph_file(path, replace(record, stamps=_stamps(len(record.ids))))
        with Running({'save_path': path}) as backend:
            _at_rest(backend, len(record.ids))
            backend.end()
        _bare()
        world = simulate_world(
            given.poses, given.edges, WorldOptions(), np.random.default_rng(0))
        write_graph_file(path, GraphRecord(
            world.graph, world.odometry, np.arange(given.poses), _stamps(given.poses)))
        with Running({'save_path': path}) as backend:
            _at_work(backend)


def _stamps(count: int) -> np.ndarray:
    return 1000 * _SECOND + np.arange(count, dtype=np.int64) * (_SECOND // 10)


def _at_rest(backend: Running, count: int) -> None:
    """Print the processor's time of a settled map, before and after loops have expired."""
    began = time.monotonic()
    _tell('load', *backend.call('load'))
    backend.until_calm('updates', _QUIET)
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
        backend.publishers[LOOP_TOPIC].publish(loop)
        backend.listen(_PACE)
    backend.until(lambda: int(backend.said['waiting_loops']) == LOOPS)
    now[0] += _WAIT * _SECOND
    # A time far ahead is believed once another follows it.
    stand()
    stand()
    backend.until(lambda: int(backend.said['expired_loops']) == LOOPS)
    backend.until_calm('updates', _QUIET)
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
        cpu = cpu_seconds(process.pid)
        began = time.monotonic()
        count = 0
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
    code = backend.end(signal.SIGTERM)
    print(f'ended after {time.monotonic() - began:.2f} s with exit code {code}')


def _tell(name: str, seconds: float, sentence: str) -> None:
    print(f'~/{name:8}{seconds:7.2f} s  {sentence}', flush=True)


if __name__ == '__main__':
    main()
