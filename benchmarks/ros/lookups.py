# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How many tf2 look-ups fail that are made at once, at the stamp of the odometry that has just come.

    python benchmarks/ros/lookups.py [SECONDS [PATTERN,...]]

A PATTERN is a rate [Hz], and with `j` behind it the times from message to message vary by 50%
either way: 5, 10, 20, 50, 10j. For each, the node runs as a process with the parameters as
shipped, and hears of laps with a loop closure each second. Who looks up is another process, which
keeps transforms in a thread of its own, as tf2_ros does, and goes by the rule of tf2: there is an
answer between two transforms that it has; after the newest, or before the oldest, there is none.
"""

import bisect
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from typing import NoReturn

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from peer import Peer, arguments, spin
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile

from l1slam_ros.io.bags.topics import LOOP_TOPIC, ODOMETRY_TOPIC
from l1slam_ros.io.messages.conversion import reference_frame_id, stamp_of
from l1slam_ros.ros.shell.header import header

SECONDS, PATTERNS = 40.0, '5,10,20,50,10j'
_LISTENERS = 2  # the node, and who looks up
_JITTER = 0.5
_SPEED = 1.0  # [m/s]
_RADIUS = 3.0  # [m]
_LAP = 2 * math.pi * _RADIUS / _SPEED  # [s]


class Buffer:
    """The stamps of transforms [ns], and what tf2 says of a look-up."""

    def __init__(self) -> None:
        self._stamps: list[int] = []

    def put(self, stamp: int) -> None:
        """Keep a transform."""
        bisect.insort(self._stamps, stamp)

    def look_up(self, stamp: int) -> str:
        """Return `found`, or of what there is no transform: `none`, the `past`, the `future`."""
        if not self._stamps:
            return 'none'
        if stamp > self._stamps[-1]:
            return 'future'
        return 'past' if stamp < self._stamps[0] else 'found'


def _keep(executor: SingleThreadedExecutor) -> None:
    with suppress(ExternalShutdownException):
        executor.spin()


def _listen() -> NoReturn:
    """Look up until told to end; print how often there was what."""
    rclpy.init()
    buffer, found = Buffer(), {'found': 0, 'none': 0, 'past': 0, 'future': 0}
    keeper, node = rclpy.create_node('keeper'), rclpy.create_node('looker')
    keeper.create_subscription(TransformStamped, 'map_to_odom',
                               lambda m: buffer.put(stamp_of(m.header)), QoSProfile(depth=100))
    executor = SingleThreadedExecutor()
    executor.add_node(keeper)
    threading.Thread(target=_keep, args=(executor,), daemon=True).start()

    def look_up(message: Odometry) -> None:
        found[buffer.look_up(stamp_of(message.header))] += 1

    node.create_subscription(Odometry, ODOMETRY_TOPIC, look_up, QoSProfile(depth=100))
    spin(node)
    print(json.dumps(found), flush=True)
    os._exit(0)  # the other thread is within ROS


def _where(seconds: float) -> tuple[float, float, float]:
    """Return x, y and heading of the robot after so long on its circle."""
    angle = _SPEED * seconds / _RADIUS
    return _RADIUS * math.sin(angle), _RADIUS * (1 - math.cos(angle)), angle


def _odometry(stamp: int, seconds: float) -> Odometry:
    message = Odometry(header=header('odom', stamp), child_frame_id='base_link')
    x, y, angle = _where(seconds)
    message.pose.pose.position.x, message.pose.pose.position.y = 1.01 * x, y
    message.pose.pose.orientation.z = math.sin(angle / 2)
    message.pose.pose.orientation.w = math.cos(angle / 2)
    return message


def _loop(reference: int, stamp: int) -> PoseWithCovarianceStamped:
    """Return that the robot is where it was a lap ago."""
    message = PoseWithCovarianceStamped(
        header=header(reference_frame_id('base_link', reference), stamp))
    message.pose.pose.orientation.w = 1.0
    message.pose.covariance = (1e-4 * np.eye(6)).ravel()
    return message


def measure(pattern: str, seconds: float) -> dict[str, int]:
    """Drive for so long; return how often who looks up found what."""
    rate, jitter = float(pattern.removesuffix('j')), _JITTER * pattern.endswith('j')
    rng = np.random.default_rng(0)
    with Peer({}) as peer:
        looker = subprocess.Popen([sys.executable, __file__, 'listen'], stdout=subprocess.PIPE)
        try:
            odometry, loops = (peer.publishers[topic] for topic in (ODOMETRY_TOPIC, LOOP_TOPIC))
            peer.until(lambda: odometry.get_subscription_count() == _LISTENERS)
            peer.listen(1.0)  # until who looks up has found the node, too
            began = due = time.monotonic()
            clock, said = time.time_ns() - time.monotonic_ns(), 0
            while (passed := due - began) < seconds:
                while (left := due - time.monotonic()) > 0:
                    rclpy.spin_once(peer.node, timeout_sec=left)
                stamp = round(due * 1e9) + clock
                odometry.publish(_odometry(stamp, passed))
                if passed > _LAP + said:
                    said += 1
                    loops.publish(_loop(stamp - round(_LAP * 1e9), stamp))
                due += (1 + jitter * rng.uniform(-1, 1)) / rate
            peer.listen(0.5)
            looker.send_signal(signal.SIGINT)
            counts: dict[str, int] = json.loads(looker.communicate(timeout=60)[0])
        finally:
            looker.kill()
        peer.end()
    return counts


def main() -> int:
    """Measure and print."""
    if sys.argv[1:] == ['listen']:
        _listen()
    given = arguments(__doc__, seconds=SECONDS, patterns=PATTERNS)
    rclpy.init()
    for pattern in given.patterns.split(','):
        counts = measure(pattern, given.seconds)
        total = sum(counts.values())
        print(f'{pattern.replace("j", " Hz, 50% jitter") if "j" in pattern else pattern + " Hz"}: '
              f'{total} look-ups, {100 * counts["future"] / total:.1f}% fail as future '
              f'({counts["future"]}), {counts["past"]} as past, {counts["none"]} before the first',
              flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
