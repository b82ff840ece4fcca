# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A laser log over DDS, faster than it was driven: the map of `scan_loops` and `backend`.

    python benchmarks/ros/scans.py LOG TRUTH [RATE [GROUPS]]

LOG is a CARMEN log, TRUTH a table of `stamp,x,y,theta`. Both nodes run as shipped, each a process
of its own; the log is sent as LaserScan and Odometry, so many scans a second. Said is what each
process took of a core for a scan, its memory, how long updates of the map took, what the front end
says of itself, and the error of the map, measured as `solve --reference` measures the map of the
recording: see `path_error`. With GROUPS, see `small.py`, the two nodes share the first core
within these control groups, and what plays to them runs elsewhere.
"""

import os
import subprocess
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from path_error import path_error
from peer import UpdateTimes, arguments, cpu_seconds
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import LaserScan
from small import groups_most

from l1slam_ros.core.geometry import se2
from l1slam_ros.io.messages.conversion import stamp_of
from l1slam_ros.io.scans.carmen import read_carmen
from l1slam_ros.ros.shell.header import header
from l1slam_ros.ros.shell.installed import executable

RATE = 40.0
# Both nodes' parameters.
_SHIPPED = Path(__file__).parents[2] / 'config' / 'scan_loops.yaml'
_BEGIN, _END = 10.0, 30.0  # [s] nothing is sent before; the map may change after the last


def main() -> None:
    """Measure and print."""
    given = arguments(__doc__, log=Path, truth=Path, rate=RATE, groups='')
    log = read_carmen(given.log)
    rclpy.init()
    node = rclpy.create_node('laser')
    # As bytes, and the newest alone: those of a long drive are a gigabyte.
    paths: deque[bytes] = deque(maxlen=1)
    way: list[Odometry] = []
    said: dict[str, str] = {}
    updates = UpdateTimes()

    def hear(message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            updates.note(values)
            if status.name.endswith('scans'):
                said.update(values)

    node.create_subscription(PathMessage, 'path', lambda data: paths.append(data), QoSProfile(
        depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL), raw=True)
    node.create_subscription(Odometry, 'scan_odom', way.append, QoSProfile(depth=1000))
    node.create_subscription(DiagnosticArray, '/diagnostics', hear, 10)
    scans = node.create_publisher(LaserScan, 'scan', qos_profile_sensor_data)
    wheels = node.create_publisher(Odometry, 'odom', QoSProfile(depth=1000))
    files = ['--ros-args', '--params-file', str(_SHIPPED), '--log-level', 'error']
    within = []
    if given.groups:
        os.sched_setaffinity(0, set(range(1, os.cpu_count() or 2)))
        within = [sys.executable, str(Path(__file__).with_name('small.py')), 'join', given.groups]
    mount = ','.join(f'{v:g}' for v in (log.mount.x, log.mount.y, log.mount.yaw))
    nodes = [subprocess.Popen([*within, executable(name), *files, *more]) for name, more in (
        ('scan_loops', ['-p', f"laser_pose:='{mount}'"]), ('backend', ['-r', 'odom:=scan_odom']))]
    try:
        _listen(node, _BEGIN)
        before = [cpu_seconds(process.pid) for process in nodes]
        due = time.monotonic()
        for scan, pose in zip(log.scans, log.wheels, strict=True):
            scans.publish(_scan(scan))
            wheels.publish(_wheels(scan.stamp, pose))
            due += 1 / given.rate
            _listen(node, due - time.monotonic())
        _listen(node, _END)
        assert all(process.poll() is None for process in nodes), 'a node was killed'
        spent = [cpu_seconds(process.pid) - first
                 for process, first in zip(nodes, before, strict=True)]
        for name, seconds, process in zip(('scan_loops', 'backend'), spent, nodes, strict=True):
            print(f'{name}: {1e3 * seconds / len(log.scans):.2f} ms of a core for a scan, '
                  f'{_memory(process.pid):.0f} MiB')
        print(f'backend: {updates.sentence}')
        print(', '.join(f'{name} {said[name]}' for name in said
                        if name.startswith(('refused', 'scan', 'loops', 'parts'))))
        if given.groups:
            print(f'the groups had at most {groups_most(given.groups):.0f} MiB')
        path = deserialize_message(paths[-1], PathMessage)
        print(f'{len(log.scans)} scans, {len(path.poses)} keyframes, '
              f'{_error(path, way, given.truth):.3f} m from the truth')
    finally:
        for process in nodes:
            process.terminate()
            process.wait()


def _listen(node: object, seconds: float) -> None:
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        rclpy.spin_once(node, timeout_sec=left)


def _scan(scan: object) -> LaserScan:
    return LaserScan(
        header=header('laser', scan.stamp), angle_min=scan.angle_min,
        angle_increment=scan.angle_increment, time_increment=scan.time_increment,
        angle_max=scan.angle_min + scan.angle_increment * (len(scan.ranges) - 1),
        range_min=scan.range_min, range_max=min(scan.range_max, 1e3), ranges=scan.ranges.tolist())


def _wheels(stamp: int, pose: np.ndarray) -> Odometry:
    message = Odometry(header=header('odom', stamp), child_frame_id='base_link')
    x, y, z, *q = se2.to_pose3(pose[None])[0].tolist()
    position, turn = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, position.z, (turn.x, turn.y, turn.z, turn.w) = x, y, z, q
    return message


def _memory(process: int) -> float:
    with open(f'/proc/{process}/status') as file:
        (line,) = (line for line in file if line.startswith('VmHWM'))
    return int(line.split()[1]) / 1024


def _error(path: PathMessage, way: list[Odometry], truth: Path) -> float:
    """Return the RMSE of positions [m], as `solve --reference` does."""
    keyframes, poses = _stamped([(p.header, p.pose) for p in path.poses])
    return path_error(keyframes, poses, *_stamped([(m.header, m.pose.pose) for m in way]), truth)


def _stamped(messages: list[tuple[Any, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """Return the stamps (n,) [ns] and poses (n, 3) of headers and poses."""
    poses = np.array([[p.position.x, p.position.y, p.position.z, p.orientation.x, p.orientation.y,
                       p.orientation.z, p.orientation.w] for _, p in messages])
    return np.array([stamp_of(head) for head, _ in messages]), se2.from_pose3(poses)


if __name__ == '__main__':
    sys.exit(main())
