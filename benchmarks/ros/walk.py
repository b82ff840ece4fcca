# SPDX-License-Identifier: Apache-2.0
"""
Which files one odometry message and one loop enter, from the callback to the published Path.

    python benchmarks/ros/walk.py

The real node runs in this process, a hook in each of its threads; a peer sends it a little map,
and, once that is at rest, a message that makes a keyframe and a loop that ends there. Said are the
files of the package in the order in which each thread enters them, and what it calls there.
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
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

import l1slam_ros
from l1slam_ros.io.compilation import STEPS, compile_now
from l1slam_ros.io.messages.conversion import reference_frame_id
from l1slam_ros.ros.node import BackendNode
from l1slam_ros.ros.publishing import header
from l1slam_ros.ros.shell.domain import go_where_nobody_is

PACKAGE = Path(l1slam_ros.__file__).parent
KEYFRAMES, SECOND = 10, 10**9
_CALM = 3.0  # [s] without a Path: the map is at rest
# What judges and factors the map behind the update is another walk.
THREADS = 'intake', 'solver'


class Walk:
    """The files that each thread enters while it is on, and the functions there."""

    def __init__(self) -> None:
        self.on = False
        self.entered: dict[str, dict[Path, dict[str, None]]] = defaultdict(dict)
        threading.setprofile(self._note)

    def _note(self, frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if self.on and event == 'call' and code.co_filename.startswith(f'{PACKAGE}{os.sep}'):
            files = self.entered[threading.current_thread().name]
            file = Path(code.co_filename).relative_to(PACKAGE)
            if not code.co_name.startswith('<'):
                files.setdefault(file, {})[code.co_name] = None


class Peer:
    """Sends odometry, a metre and a second each, and loops back to the first of it."""

    def __init__(self, executor: SingleThreadedExecutor):
        node = rclpy.create_node('peer')
        executor.add_node(node)
        self._executor, self._sent, self.paths = executor, 0, list[PathMessage]()
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


def main() -> int:
    """Walk and print."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    compile_now(STEPS)
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
    walk.on = False
    files = {thread: walk.entered[thread] for thread in THREADS}
    for thread, entered in files.items():
        print(f'{thread}: {len(entered)} files')
        for file, functions in entered.items():
            print(f'  {str(file):42}{", ".join(functions)}')
    print(f'{len(set().union(*files.values()))} files in all')
    node.close()
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
