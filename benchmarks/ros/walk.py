# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Which files one odometry message and one loop enter, from the callback to the published Path.

    python benchmarks/ros/walk.py [--files]

The real node runs in this process, a hook in each of its threads; a peer sends it a little map,
and, once that is at rest, a message that makes a keyframe and a loop that ends there. Said is of
each step of doc/how_a_message_becomes_a_map.md whether its thread came there, after the step
before; with --files also all files of the package that each thread enters. It ends with 1 where
the walk leaves the page.
"""

import argparse
import os
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from page import Part, parts
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

import l1slam_ros
from l1slam_ros.io.messages.conversion import reference_frame_id
from l1slam_ros.ros.node import BackendNode
from l1slam_ros.ros.shell.domain import go_where_nobody_is
from l1slam_ros.ros.shell.header import header

PACKAGE = f'{Path(l1slam_ros.__file__).parent}{os.sep}'
KEYFRAMES, SECOND = 10, 10**9
_CALM = 3.0  # [s] without a Path: the map is at rest


class Walk:
    """What each thread calls in the package while it is on, in order."""

    def __init__(self) -> None:
        self.on = False
        self.calls: dict[str, list[tuple[str, str]]] = defaultdict(list)
        threading.setprofile(self._note)

    def _note(self, frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        ours = code.co_filename.startswith(PACKAGE) and not code.co_name.startswith('<')
        if self.on and event == 'call' and ours:
            file = code.co_filename.removeprefix(PACKAGE)
            self.calls[threading.current_thread().name].append((file, code.co_name))

    def met(self, part: Part) -> list[bool]:
        """Return of each step whether its thread came there after the one before."""
        calls = self.calls[part.thread]
        begin = 0
        met = []
        for step in part.steps:
            wanted = step.file, step.call.split('.')[-1]
            found = wanted in calls[begin:]
            met.append(found)
            begin = calls.index(wanted, begin) if found else begin
        return met

    def print_files(self) -> None:
        """Print the files that each thread entered, and what it called there."""
        for thread, calls in self.calls.items():
            files: dict[str, dict[str, None]] = {}
            for file, name in calls:
                files.setdefault(file, {})[name] = None
            print(f'{thread}: {len(files)} files')
            for file, names in files.items():
                print(f'  {file:42}{", ".join(names)}')


class Peer:
    """Sends odometry, a metre and a second each, and loops back to the first of it."""

    def __init__(self, executor: SingleThreadedExecutor):
        node = rclpy.create_node('peer')
        executor.add_node(node)
        self._executor = executor
        self._sent = 0
        self.paths = list[PathMessage]()
        node.create_subscription(PathMessage, 'path', self.paths.append, 10)
        self._odometry = node.create_publisher(Odometry, 'odom', QoSProfile(depth=1000))
        self._loops = node.create_publisher(PoseWithCovarianceStamped, 'loop_closures', 10)
        self.until(lambda: bool(self._odometry.get_subscription_count()
                                and self._loops.get_subscription_count()))

    def until(self, condition: Callable[[], bool]) -> None:
        """Listen until something is so."""
        while not condition():
            self._executor.spin_once(timeout_sec=0.05)

    def drive(self) -> None:
        """Send the next message, which makes a keyframe; wait for it in the Path."""
        message = Odometry(header=header('odom', (self._sent + 1) * SECOND))
        message.child_frame_id, message.pose.pose.position.x = 'base_link', float(self._sent)
        self._odometry.publish(message)
        self._sent += 1
        self.until(lambda: bool(self.paths and len(self.paths[-1].poses) == self._sent))

    def close(self) -> None:
        """Send a loop from the last message to the first."""
        message = PoseWithCovarianceStamped(header=header(
            reference_frame_id('base_link', SECOND), self._sent * SECOND))
        message.pose.pose.position.x = self._sent - 1.0
        message.pose.pose.orientation.w = 1.0
        count = len(self.paths)
        self._loops.publish(message)
        self.until(lambda: len(self.paths) > count)

    def rest(self) -> None:
        """Listen until there is nothing new any more."""
        count, end = len(self.paths), time.monotonic() + _CALM
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.05)
            if len(self.paths) > count:
                count, end = len(self.paths), time.monotonic() + _CALM


def walked() -> Walk:
    """Return the walk of a message and a loop through the node."""
    go_where_nobody_is()  # nobody else's odometry is counted
    rclpy.init()
    walk, executor = Walk(), SingleThreadedExecutor()
    node = BackendNode(parameter_overrides=[Parameter('keyframe.translation', value=0.5)])
    executor.add_node(node)
    peer = Peer(executor)
    for _ in range(KEYFRAMES):
        peer.drive()
    peer.close()
    peer.rest()
    walk.on = True
    peer.drive()
    peer.close()
    peer.rest()
    walk.on = False
    node.close()
    rclpy.try_shutdown()
    return walk


def main() -> int:
    """Walk and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--files', action='store_true', help='print all files, too')
    arguments = parser.parse_args()
    walk, left = walked(), 0
    for part in parts():
        print(f'{part.title} ({part.thread})')
        for step, met in zip(part.steps, walk.met(part), strict=True):
            left += not met
            print(f'  {step.number:2} {step.file:44}{step.call:34}{"" if met else "NOT MET"}')
    if arguments.files:
        walk.print_files()
    print(f'{left} steps of the page were not met' if left else 'the walk is that of the page')
    return min(left, 1)


if __name__ == '__main__':
    sys.exit(main())
