# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The scan front end beside the back end, over DDS, in rooms that are known."""

import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')

from corridors import RAYS, by_wheels, laps, ranges_from
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.msg import Path as PathMessage
from node_bench import (
    LATCHED,
    SECOND,
    BackendNode,
    ScanLoopsNode,
    executable,
    header,
    poses_of,
    put,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Trigger
from worlds import position_error

DEADLINE = 60.0
PERIOD = 10**8
SHIPPED = Path(__file__).parents[2] / 'config' / 'scan_loops.yaml'


class Robot:
    """Both nodes in this process, and a peer that sends what a robot would."""

    def __init__(self, rclpy, **parameters):
        files = ['--ros-args', '--params-file', str(SHIPPED)]
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        self.front_end = ScanLoopsNode(parameter_overrides=overrides, cli_args=files)
        self.backend = BackendNode(cli_args=[*files, '-r', 'odom:=scan_odom'])
        for timer in self.front_end.timers:
            if timer.timer_period_ns == 10**9:  # of its diagnostics, which would be waited for
                timer.timer_period_ns = SECOND
                timer.reset()
        self.peer = rclpy.create_node('peer')
        self.executor = SingleThreadedExecutor()
        for node in (self.front_end, self.backend, self.peer):
            self.executor.add_node(node)
        self.scans = self.peer.create_publisher(LaserScan, 'scan', qos_profile_sensor_data)
        self.wheels = self.peer.create_publisher(Odometry, 'odom', QoSProfile(depth=100))
        self.received = {}
        self.rays = np.arange(RAYS)
        for kind, topic, qos in ((PathMessage, 'path', LATCHED), (OccupancyGrid, 'map', LATCHED),
                                 (Odometry, 'scan_odom', 1000), (PoseStamped, 'pose', 1000),
                                 (PoseWithCovarianceStamped, 'loop_closures', 1000),
                                 (DiagnosticArray, '/diagnostics', 100)):
            self.received[topic] = []
            self.peer.create_subscription(kind, topic, self.received[topic].append, qos)
        self.until(lambda: self.scans.get_subscription_count()
                   and self.wheels.get_subscription_count(), 'the node subscribes')
        self.until(self.is_ready, 'its loops are compiled')

    def is_ready(self):
        _, sentence, _ = self.status()
        return sentence and 'compiling' not in sentence

    @property
    def used(self):
        return len(self.received['scan_odom'])

    def until(self, condition, what):
        deadline = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < deadline, f'waited {DEADLINE} s in vain until {what}'
            self.executor.spin_once(timeout_sec=0.02)

    def wheels_at(self, k, pose):
        message = Odometry(header=header('odom', (k + 10) * PERIOD), child_frame_id='base_link')
        x, y, yaw = pose
        put(message.pose.pose, (x, y, 0.0), (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)))
        self.wheels.publish(message)

    def scan_at(self, k, pose, **changes):
        message = LaserScan(
            header=header('laser', (k + 10) * PERIOD), angle_min=-np.pi,
            angle_increment=2 * np.pi / RAYS, range_min=0.05, range_max=8.0)
        seen = ranges_from(pose)[self.rays] + np.random.default_rng(k).normal(0, 0.01, RAYS)
        message.ranges = np.where(seen < 8.0, seen, np.inf).tolist()
        for name, value in changes.items():
            setattr(message, name, value)
        self.scans.publish(message)

    def drive(self, truth, wheels, first=0, ahead=2):
        """Send scans and wheels, no more than a few before they are used."""
        used = self.used
        for k in range(len(truth)):
            self.scan_at(first + k, truth[k])
            self.wheels_at(first + k, wheels[k])
            self.until(lambda n=k: self.used - used >= n - ahead, 'scans are used')

    def status(self, name='scans'):
        """Return level, sentence and values that the front end last said of itself."""
        for message in reversed(self.received['/diagnostics']):
            for status in message.status:
                if status.name.endswith(name):
                    return status.level, status.message, {
                        v.key: v.value for v in status.values}
        return None, '', {}

    def call(self, service):
        client = self.peer.create_client(Trigger, service)
        self.until(client.service_is_ready, f'{service} is offered')
        future = client.call_async(Trigger.Request())
        self.until(future.done, f'{service} answers')
        return future.result()

    def close(self):
        self.executor.shutdown()
        assert self.front_end.close(), 'its threads end'
        self.backend.close()
        self.peer.destroy_node()


@pytest.fixture
def robot(ros):
    """Return what makes the two nodes with their peer; all are closed after the test."""
    robots = []

    def make(**parameters):
        robots.append(Robot(ros, **parameters))
        return robots[-1]

    yield make
    for made in robots:
        made.close()


@pytest.mark.parametrize('pose', ['', '0, 0, 0, 3.1416'], ids=['upright', 'upside down'])
def test_two_laps_make_a_map(robot, tmp_path, rng, pose):
    truth = laps(2)
    wheels = by_wheels(truth, rng)
    r = robot(map_path=str(tmp_path / 'corridors.pgm'), laser_pose=pose, map_period=0.5)
    # The rays of a laser that hangs upside down go clockwise.
    r.rays = -np.arange(RAYS) % RAYS if pose else np.arange(RAYS)
    r.drive(truth, wheels)

    def is_whole():
        counts = r.status()[2]
        return int(counts['scans']) == r.used >= len(truth) - 2 and r.received['path'] and len(
            r.received['path'][-1].poses) == int(counts['keyframes'])

    r.until(is_whole, 'the path has every keyframe')
    assert r.call('/backend/optimize').success
    path = r.received['path'][-1]
    stamps = np.array([p.header.stamp.sec * 10**9 + p.header.stamp.nanosec for p in path.poses])
    rows = stamps // PERIOD - 10
    wrong = position_error(poses_of(path)[:, :2], truth[rows, :2])
    assert wrong < 0.1 < position_error(wheels[rows, :2], truth[rows, :2])
    assert r.received['loop_closures']
    assert r.status()[2]['parts'] == '1'
    saved = r.call('/scan_loops/save_map')
    assert saved.success and 'corridors.pgm' in saved.message
    assert r.call('/scan_loops/save_map').success, 'this one is ours'
    mine = tmp_path / 'corridors.yaml'
    mine.write_text(mine.read_text().split('\n', 1)[1].replace('0.65', '0.7'))
    kept = mine.read_bytes(), (tmp_path / 'corridors.pgm').read_bytes()
    refused = r.call('/scan_loops/save_map')
    assert not refused.success and f'{mine}: was not written by l1slam_ros' in refused.message
    assert kept == (mine.read_bytes(), (tmp_path / 'corridors.pgm').read_bytes())


def test_help_lists_topics_services_and_parameters():
    helped = subprocess.run([executable('scan_loops'), '--help'], capture_output=True, text=True)
    assert helped.returncode == 0 and not helped.stderr
    for word in ('scan_odom', '~/save_map', 'laser_pose', 'map_resolution: 0.05', 'covariance'):
        assert word in helped.stdout


def test_an_unknown_argument_starts_nothing():
    ran = subprocess.run([executable('scan_loops'), '--loops'], capture_output=True, text=True)
    assert ran.returncode == 2
    assert ran.stderr.startswith("scan_loops: '--loops' is not an argument of scan_loops")
