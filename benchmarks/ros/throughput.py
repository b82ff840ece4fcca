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

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

# Its own domain: nobody else's messages are counted.
os.environ.setdefault('ROS_DOMAIN_ID', '93')
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message

from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import GraphRecord, write_graph_file
from l1slam_ros.io.messages.conversion import reference_frame_id, stamp_of
from l1slam_ros.ros.demo import executable
from l1slam_ros.ros.publishing import header

SECONDS, RATE, LOOPS, KEYFRAMES = 60.0, 1_000, 100, 10_000
_SPEED = 5.0  # [m/s] ten keyframes a second
_SIGMA = 0.02  # [m] of loops
_LONGEST = 20.0  # [s] that a loop goes back
_MILLISECOND = 1_000_000  # [ns]
_PATIENCE = 300.0  # [s] the solver may have to be compiled


def main() -> int:
    """Measure and print."""
    if sys.argv[1:] in (['count'], ['listen']):
        return _count() if sys.argv[1] == 'count' else _listen()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('seconds', type=float, nargs='?', default=SECONDS)
    parser.add_argument('rate', type=float, nargs='?', default=RATE)
    parser.add_argument('loops', type=float, nargs='?', default=LOOPS)
    parser.add_argument('keyframes', type=int, nargs='?', default=KEYFRAMES)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'map.g2o'
        _write_map(path, given.keyframes)
        bare, ear = (subprocess.Popen([sys.executable, __file__, what], stdout=subprocess.PIPE,
                                      text=True) for what in ('count', 'listen'))
        backend = subprocess.Popen([
            executable('backend'), '--ros-args', '--log-level', 'error',
            '-p', f'save_path:={path}', '-p', 'autosave_period:=0.0', '-p', 'load_on_start:=true'])
        try:
            said, sent, cpu = _measure(given.seconds, given.rate, given.loops, backend.pid)
        finally:
            for process in (bare, ear, backend):
                process.send_signal(signal.SIGINT)
            counted, heard = (process.communicate()[0] for process in (bare, ear))
            backend.wait()
    counts, bare_late = counted.splitlines()
    for topic, received in zip(('odom', 'loop_closures'), map(int, counts.split()), strict=True):
        if sent[topic]:
            node = int(said[f'{topic}.received'])
            print(f'{topic}: {sent[topic]} sent; bare subscriber lost '
                  f'{1 - received / sent[topic]:.3%}, node {1 - node / sent[topic]:.3%}; it says '
                  f'{said[f"{topic}.lost"]} lost')
    print(f'{bare_late}\n{heard.strip()}\n{said["keyframes"]} keyframes and {said["factors"]} '
          f'factors in the end, {cpu:.0f} % of a core')
    return 0


def _write_map(path: Path, keyframes: int) -> None:
    """Write a map whose keyframes are older than all that comes."""
    world = simulate_world(keyframes, 2 * keyframes, WorldOptions(), np.random.default_rng(0))
    stamps = 1 + np.arange(keyframes)
    write_graph_file(path, GraphRecord(world.graph, world.truth, np.arange(keyframes), stamps))


def _measure(seconds: float, rate: float, loops: float, backend: int
             ) -> tuple[dict[str, str], dict[str, int], float]:
    """Publish; return what the node last says, how much was sent, and the node's CPU [%]."""
    rclpy.init()
    node, qos = rclpy.create_node('robot'), QoSProfile(depth=1000)
    publishers = {'odom': node.create_publisher(Odometry, 'odom', qos),
                  'loop_closures': node.create_publisher(
                      PoseWithCovarianceStamped, 'loop_closures', qos)}
    said: dict[str, str] = {}
    node.create_subscription(
        DiagnosticArray, '/diagnostics',
        lambda m: said.update({v.key: v.value for s in m.status for v in s.values},
                              message=m.status[0].message), 10)
    _until(node, lambda: all(p.get_subscription_count() == 2 for p in publishers.values())
           and 'odom.received' in said and 'compiling' not in said['message'])
    sent, cpu = dict.fromkeys(publishers, 0), cpu_seconds(backend)
    rng, began = np.random.default_rng(0), time.monotonic_ns()
    odometry, loop = _odometry(), _loop()
    while (now := (time.monotonic_ns() - began) * 1e-9) < seconds:
        if sent['odom'] < now * rate:
            _place(odometry, began, now)
            publishers['odom'].publish(serialize_message(odometry))
            sent['odom'] += 1
        if sent['loop_closures'] < now * loops and now > 1:
            before = rng.uniform(max(now - _LONGEST, 0), now - 0.5)
            loop.header = header(reference_frame_id(
                'base_link', began + round(before * 1e9)), began + round(now * 1e9))
            loop.pose.pose.position.x = _SPEED * (now - before) + rng.normal(0, _SIGMA)
            publishers['loop_closures'].publish(serialize_message(loop))
            sent['loop_closures'] += 1
        time.sleep(max((min((sent['odom']) / rate, (sent['loop_closures'] + 1) / max(loops, 1e-9))
                        - now), 1e-4))
    cpu = (cpu_seconds(backend) - cpu) / seconds * 100
    # Until two reports in a row say the same.
    seen = ''
    while seen != said['odom.received']:
        seen, until = said['odom.received'], time.monotonic() + 2.5
        _until(node, lambda until=until: time.monotonic() > until)  # type: ignore[misc]
    return said, sent, cpu


def _odometry() -> Odometry:
    return Odometry(child_frame_id='base_link')


def _place(message: Odometry, began: int, now: float) -> None:
    """Let odometry be that of a straight drive, its stamp the clock of this machine."""
    message.header = header('odom', began + round(now * 1e9))
    message.pose.pose.position.x = _SPEED * now


def _loop() -> PoseWithCovarianceStamped:
    message = PoseWithCovarianceStamped()
    message.pose.pose.orientation.w = 1.0
    message.pose.covariance = (_SIGMA**2 * np.eye(6)).ravel()
    return message


def _until(node: Any, condition: Any) -> None:
    deadline = time.monotonic() + _PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f'waited {_PATIENCE} s in vain'
        rclpy.spin_once(node, timeout_sec=0.1)


def cpu_seconds(process: int) -> float:
    """Return the processor's time that a process has taken [s]."""
    with open(f'/proc/{process}/stat') as file:
        fields = file.read().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def _count() -> int:
    """Take messages until SIGINT; print how many, and how old they were."""
    rclpy.init()
    node = rclpy.create_node('bare')
    odometry, loops = (_heard(node, kind, topic) for kind, topic in (
        (Odometry, 'odom'), (PoseWithCovarianceStamped, 'loop_closures')))
    _spin(node)
    print(len(odometry), len(loops))
    print(f'bare subscriber: {_late(odometry)}')
    return 0


def _listen() -> int:
    """Note until SIGINT when poses come; print it."""
    rclpy.init()
    node = rclpy.create_node('ear')
    poses = _heard(node, PoseStamped, 'pose')
    _spin(node)
    print(f'pose: {_late(poses)}')
    return 0


def _heard(node: Any, kind: Any, topic: str) -> list[tuple[int, int]]:
    """Return what will hold when each message was sent, or what it answers, and when it came."""
    heard: list[tuple[int, int]] = []
    node.create_subscription(
        kind, topic, lambda m: heard.append((stamp_of(m.header), time.monotonic_ns())),
        QoSProfile(depth=1000))
    return heard


def _spin(node: Any) -> None:
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


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
