# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The node on a large map: its updates, its poses, `~/save`, and who comes late for the Path.

    python benchmarks/ros/large.py MAP [SECONDS [RATE [LOOPS]]]

MAP is a saved map, as `large_map.py --folder` leaves one. The node loads it at start; odometry and
loops come at so many a second. After a third of the time somebody subscribes to the Path, after
two thirds the map is saved. Said is how long both took, how long updates took as the diagnostics
have it once a second, how soon poses came, before and while it is saved, and the node's memory.
"""

import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from peer import Peer, UpdateTimes, arguments, cpu_seconds, heard
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from throughput import place, some_loop, some_odometry

from l1slam_ros.io.bags.topics import LOOP_TOPIC, ODOMETRY_TOPIC
from l1slam_ros.io.messages.conversion import reference_frame_id
from l1slam_ros.ros.shell.header import header

_LONGEST, _SPEED = 20.0, 1.0  # [s] that a loop goes back; [m/s]


def main() -> int:
    """Measure and print."""
    given = arguments(__doc__, map=Path, seconds=60.0, rate=50.0, loops=2.0)
    rclpy.init()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'map.g2o'
        shutil.copyfile(given.map, path)
        began = time.monotonic()
        with Peer({'save_path': path, 'autosave_period': 0.0, 'load_on_start': 'true'}) as peer:
            peer.until(lambda: bool(peer.maps))
            print(f'the first Path, of {len(peer.maps[-1]) / 1e6:.1f} MB, came '
                  f'{time.monotonic() - began:.1f} s after the start', flush=True)
            _measure(peer, given.seconds, given.rate, given.loops)
            peer.end()
    return 0


def _measure(peer: Peer, seconds: float, rate: float, loops: float) -> None:
    over, updates = threading.Event(), UpdateTimes()
    poses = heard(peer.node, PoseStamped, 'pose')
    driver = threading.Thread(target=_drive, args=(peer, over, rate, loops))
    driver.start()
    cpu, paths = cpu_seconds(peer.process.pid), len(peer.maps)

    def listen(span: float) -> None:
        end = time.monotonic() + span
        while time.monotonic() < end:
            peer.listen(0.2)
            updates.note(peer.said)

    listen(seconds / 3)
    print(f'who came late had the Path after {_late_joiner():.2f} s', flush=True)
    listen(seconds / 3)
    before = len(poses)
    took, sentence = peer.call('save')
    print(f'~/save answered after {took:.2f} s: {sentence}', flush=True)
    while_saved = len(poses)
    listen(seconds / 3)
    cpu = cpu_seconds(peer.process.pid) - cpu
    over.set()
    driver.join()
    print(f'{updates.sentence}; {len(peer.maps) - paths} Paths; {cpu:.0f} CPU s')
    parts = ('before', poses[:before]), ('while it was saved', poses[before:while_saved])
    for what, some in parts:
        ages = 1e-6 * np.array([came - sent for sent, came in some] or [np.nan])
        print(f'poses {what}: {len(some)}, late by {np.median(ages):.1f} ms in the median, p99 '
              f'{np.percentile(ages, 99):.1f}')
    with open(f'/proc/{peer.process.pid}/status') as file:
        print('; '.join(line.strip() for line in file if line.startswith(('VmHWM', 'VmRSS'))))
    print({name: peer.said[name] for name in (
        'keyframes', 'factors', 'suspect_loops', 'rejected_loops', 'message')})


def _drive(peer: Peer, over: threading.Event, rate: float, loops: float) -> None:
    """Send odometry of a straight drive, and loops that say the same."""
    odometry = some_odometry()
    loop = some_loop()
    rng = np.random.default_rng(0)
    began = time.monotonic_ns()
    count = 0
    closed = 0
    while not over.is_set():
        now = (time.monotonic_ns() - began) * 1e-9
        place(odometry, began, now, _SPEED)
        peer.publishers[ODOMETRY_TOPIC].publish(serialize_message(odometry))
        count += 1
        if now > 2 and closed < now * loops:
            closed += 1
            before = rng.uniform(max(now - _LONGEST, 0), now - 1)
            loop.header = header(reference_frame_id(
                'base_link', began + round(before * 1e9)), began + round(now * 1e9))
            loop.pose.pose.position.x = _SPEED * (now - before)
            peer.publishers[LOOP_TOPIC].publish(serialize_message(loop))
        over.wait(max(count / rate - (time.monotonic_ns() - began) * 1e-9, 1e-4))


def _late_joiner() -> float:
    """Return after what time somebody new has the Path [s]."""
    node = rclpy.create_node('late')
    came = list[bytes]()
    began = time.monotonic()
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(PathMessage, 'path', came.append, latched, raw=True)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not came and time.monotonic() < began + 60:
        executor.spin_once(timeout_sec=0.05)
    node.destroy_node()
    return time.monotonic() - began


if __name__ == '__main__':
    sys.exit(main())
