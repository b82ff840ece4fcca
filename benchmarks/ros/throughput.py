# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How many messages the node takes in, beside a bare rclpy subscriber, and how soon poses come.

    python benchmarks/ros/throughput.py [SECONDS [RATE [LOOPS [KEYFRAMES]]]]

Odometry and loop closures come at so many a second, to a map that begins with so many keyframes.
Processes: this one publishes, paced; a bare subscriber of both only counts; one listens to `pose`,
whose stamp says when the odometry was sent; the node runs as shipped. Prints what each received,
what the node says that it lost, how late odometry came to the bare subscriber and poses to the
other, and how old the last was that they had, over all the time: the node does not answer each
message of a backlog.
"""

import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from peer import KINDS, Peer, arguments, cpu_seconds, heard, spin
from rclpy.serialization import serialize_message

from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.bags.topics import LOOP_TOPIC, ODOMETRY_TOPIC
from l1slam_ros.io.graphs.graph_file import GraphRecord, write_graph_file
from l1slam_ros.io.messages.conversion import reference_frame_id
from l1slam_ros.ros.shell.header import header

SECONDS = 60.0
RATE = 1_000.0
LOOPS = 100.0
KEYFRAMES = 10_000
_SPEED = 5.0  # [m/s] ten keyframes a second
_SIGMA = 0.02  # [m] of loops
_LONGEST = 20.0  # [s] that a loop goes back
_MILLISECOND = 1_000_000  # [ns]


def main() -> int:
    """Measure and print."""
    if sys.argv[1:] in (['count'], ['listen']):
        return _count() if sys.argv[1] == 'count' else _listen()
    given = arguments(__doc__, seconds=SECONDS, rate=RATE, loops=LOOPS, keyframes=KEYFRAMES)
    rclpy.init()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'map.g2o'
        _write_map(path, given.keyframes)
        bare, ear = (subprocess.Popen([sys.executable, __file__, what], stdout=subprocess.PIPE,
                                      text=True) for what in ('count', 'listen'))
        try:
            with Peer({'save_path': path, 'autosave_period': 0.0,
                       'load_on_start': 'true'}) as peer:
                sent, cpu = _measure(peer, given.seconds, given.rate, given.loops)
                peer.end()
        finally:
            for process in (bare, ear):
                process.send_signal(signal.SIGINT)
            counted, heard = (process.communicate()[0] for process in (bare, ear))
    counts, bare_late = counted.splitlines()
    said = peer.said
    for topic, received in zip(KINDS, map(int, counts.split()), strict=True):
        if sent[topic]:
            node = int(said[f'{topic[1:]}.received'])
            print(f'{topic}: {sent[topic]} sent; bare subscriber lost '
                  f'{1 - received / sent[topic]:.3%}, node {1 - node / sent[topic]:.3%}; it says '
                  f'{said[f"{topic[1:]}.lost"]} lost')
    print(f'{bare_late}\n{heard.strip()}\n{said["keyframes"]} keyframes and {said["factors"]} '
          f'factors in the end, {cpu:.0f} % of a core')
    return 0


def _write_map(path: Path, keyframes: int) -> None:
    """Write a map whose keyframes are older than all that comes."""
    world = simulate_world(keyframes, 2 * keyframes, WorldOptions(), np.random.default_rng(0))
    stamps = 1 + np.arange(keyframes)
    write_graph_file(path, GraphRecord(world.graph, world.truth, np.arange(keyframes), stamps))


def _measure(peer: Peer, seconds: float, rate: float, loops: float
             ) -> tuple[dict[str, int], float]:
    """Publish; return how much was sent, and the node's CPU [%]."""
    publishers, process = peer.publishers, peer.process.pid
    # The node, and who only counts.
    peer.until(lambda: all(p.get_subscription_count() == 2 for p in publishers.values()))
    sent, cpu = dict.fromkeys(publishers, 0), cpu_seconds(process)
    rng, began = np.random.default_rng(0), time.monotonic_ns()
    odometry, loop = some_odometry(), some_loop()
    while (now := (time.monotonic_ns() - began) * 1e-9) < seconds:
        if sent[ODOMETRY_TOPIC] < now * rate:
            place(odometry, began, now, _SPEED)
            publishers[ODOMETRY_TOPIC].publish(serialize_message(odometry))
            sent[ODOMETRY_TOPIC] += 1
        if sent[LOOP_TOPIC] < now * loops and now > 1:
            before = rng.uniform(max(now - _LONGEST, 0), now - 0.5)
            loop.header = header(reference_frame_id(
                'base_link', began + round(before * 1e9)), began + round(now * 1e9))
            loop.pose.pose.position.x = _SPEED * (now - before) + rng.normal(0, _SIGMA)
            publishers[LOOP_TOPIC].publish(serialize_message(loop))
            sent[LOOP_TOPIC] += 1
        due = min(sent[ODOMETRY_TOPIC] / rate, (sent[LOOP_TOPIC] + 1) / max(loops, 1e-9))
        time.sleep(max(due - now, 1e-4))
    cpu = (cpu_seconds(process) - cpu) / seconds * 100
    peer.until_calm('odom.received')
    return sent, cpu


def some_odometry() -> Odometry:
    """Return odometry that is to be placed."""
    return Odometry(child_frame_id='base_link')


def place(message: Odometry, began: int, now: float, speed: float) -> None:
    """Let odometry be that of a straight drive, its stamp the clock of this machine."""
    message.header = header('odom', began + round(now * 1e9))
    message.pose.pose.position.x = speed * now


def some_loop() -> PoseWithCovarianceStamped:
    """Return a loop that is to be stamped and placed."""
    message = PoseWithCovarianceStamped()
    message.pose.pose.orientation.w = 1.0
    message.pose.covariance = (_SIGMA**2 * np.eye(6)).ravel()
    return message


def _count() -> int:
    """Take messages until SIGINT; print how many, and how old they were."""
    rclpy.init()
    node = rclpy.create_node('bare')
    odometry, loops = (heard(node, kind, topic) for topic, kind in KINDS.items())
    spin(node)
    print(len(odometry), len(loops))
    print(f'bare subscriber: {_late(odometry)}')
    return 0


def _listen() -> int:
    """Note until SIGINT when poses come; print it."""
    rclpy.init()
    node = rclpy.create_node('ear')
    poses = heard(node, PoseStamped, 'pose')
    spin(node)
    print(f'pose: {_late(poses)}')
    return 0


def _late(heard: list[tuple[int, int]]) -> str:
    """Return how late messages came, and how old the last one was at any time."""
    sent, came = np.array(heard).T
    times = np.arange(came[0], came[-1], _MILLISECOND)
    said = []
    for ages in came - sent, times - sent[np.searchsorted(came, times, side='right') - 1]:
        p50, p95, p99 = np.percentile(ages / _MILLISECOND, (50, 95, 99))
        said.append(f'{p50:.1f} ms in the median, p95 {p95:.1f}, p99 {p99:.1f}')
    return f'{len(heard)} messages, late by {said[0]}; the last one was old by {said[1]}'


if __name__ == '__main__':
    sys.exit(main())
