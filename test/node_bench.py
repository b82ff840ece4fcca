# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The node under test in this process, and a peer that talks to it over real DDS."""

import os
import sysconfig
import time
from collections import Counter
from pathlib import Path as File

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from bags import recording_of

# What the executables start.
from l1slam_ros.ros.node import BackendNode
from l1slam_ros.ros.scans.node import ScanLoopsNode as ScanLoopsNode

DEADLINE = 120.0
SHIPPED = File(__file__).parents[1] / 'config' / 'scan_loops.yaml'
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
OF_LOOPS = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SECOND = 10**8  # [ns] a second of the node's diagnostics
TYPES = {'/odom': Odometry, **dict.fromkeys(
    ('/loop_closures', '/trusted_loop_closures', '/false_loop_closures', '/absolute_poses'),
    PoseWithCovarianceStamped)}
EVERY_MESSAGE = {'keyframe.translation': 0.0, 'keyframe.rotation': 0.0,
                 'odometry.covariance_source': 'increment'}


def executable(name):
    """Return where an executable of ours is: where `ros2 run` looks, or beside Python."""
    folders = [File(prefix) / 'lib' / 'l1slam_ros'
               for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if prefix]
    beside = File(sysconfig.get_path('scripts'))
    return str(next(path / name for path in (*folders, beside)
                    if path is beside or (path / name).exists()))


class Peer:
    """Sends what robots say and hears what nodes answer; nodes of this process it spins, too."""

    def __init__(self, rclpy, *nodes, robots=()):
        self.nodes = list(nodes)
        for timer in (timer for node in nodes for timer in node.timers):
            # What they say of themselves once a second would be waited for.
            if timer.timer_period_ns == 10**9:
                timer.timer_period_ns = SECOND
                timer.reset()
        self.peer = rclpy.create_node('peer')
        self.executor = SingleThreadedExecutor()
        for node in (*nodes, self.peer):
            self.executor.add_node(node)
        # Of several robots, below their names.
        names = [f'{name}/' for name in robots] or ['']
        self.publishers = {
            topic: self.peer.create_publisher(kind, topic, QoSProfile(depth=1000))
            for topic, kind in ((f'/{name}{topic[1:]}', kind) for name in names
                                for topic, kind in TYPES.items())}
        self.received = {}
        for name in names:
            self.listen(Path, f'{name}path', LATCHED)
            self.listen(PoseStamped, f'{name}pose', 1000)
            self.listen(TransformStamped, f'{name}map_to_odom', 1000)
        self.listen(DiagnosticArray, '/diagnostics', 100)
        self.listen(DiagnosticArray, 'loop_status', OF_LOOPS)

    def listen(self, kind, topic, qos):
        self.received[topic] = []
        self.peer.create_subscription(kind, topic, self.received[topic].append, qos)
        return self.received[topic]

    def until(self, condition, what):
        deadline = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < deadline, f'waited {DEADLINE} s in vain until {what}'
            self.executor.spin_once(timeout_sec=0.05)

    def until_heard(self):
        """Wait until the nodes subscribe to all that is sent."""
        self.until(lambda: all(p.get_subscription_count() for p in self.publishers.values()),
                   'the node subscribes')

    def send(self, topic, message):
        self.publishers[topic].publish(message)
        self.executor.spin_once(timeout_sec=0.0)

    def drive(self, first, last):
        """Drive along x, a metre and a keyframe a second."""
        for k in range(first, last):
            self.send('/odom', odometry((k + 1) * 10**9, 1.0 * k))

    def map_of(self, count):
        """Wait for a map of so many keyframes, and return its Path."""
        self.until(lambda: len(self.path().poses) == count, f'a map of {count} keyframes')
        return self.path()

    def play(self, bag):
        """Play a bag as fast as it is used: a burst is more than DDS holds on a busy machine."""
        sent = 0
        for topic, _, stamp, data in recording_of(bag):
            self.send(topic, data)
            sent += topic == '/odom'
            if topic == '/odom' and sent % 20 == 0:
                self.until(lambda stamp=stamp: self.newest() >= stamp, 'they are used')

    def newest(self, name=''):
        """Return the stamp [ns] of the newest odometry of a robot that was answered, or 0."""
        poses = self.received[f'{name}pose']
        return stamp_of(poses[-1].header) if poses else 0

    def path(self, name=''):
        paths = self.received[f'{name}path']
        return paths[-1] if paths else Path()

    def status(self, name='map'):
        """Return the last level, sentence and values that were said of the map, or a robot."""
        for message in reversed(self.received['/diagnostics']):
            for status in message.status:
                if status.name.endswith(f': {name}'):
                    return status.level, status.message, {v.key: v.value for v in status.values}
        return None, '', {}

    def count(self, key):
        """Return a number that diagnostics last gave, 0: none."""
        return int(self.status()[2].get(key, 0))

    def refused(self, name='map'):
        """Return how many messages were refused, by cause, as diagnostics last gave it."""
        values = self.status(name)[2]
        return {key.removeprefix('refused.'): int(value) for key, value in values.items()
                if key.startswith('refused.') and not key.endswith('.last_minute')}

    def anew(self):
        """Wait until diagnostics have come that were made after this."""
        self.received['/diagnostics'].clear()
        self.until(lambda: len(self.received['/diagnostics']) > 1, 'diagnostics')

    def rest(self):
        """Wait until nothing is left to do."""
        self.anew()
        self.until(lambda: self.status()[2]['behind.at_rest'] == '1', 'it is at rest')

    def loops(self):
        """
        Return the state of each loop and its sigmas, NaN: none.

        By the stamps of its ends; where robots have names, by these and the stamps.
        """
        found = {}
        for message in self.received['loop_status']:
            for one in message.status:
                values = {v.key: v.value for v in one.values}
                names = [values[key] for key in ('reference_robot', 'robot') if key in values]
                ends = [nanoseconds(values[key]) for key in ('reference_stamp', 'stamp')]
                found[(*names, *ends)] = values['state'], float(values['sigmas'] or 'nan')
        return found

    def states(self):
        """Return how many loops are in each state."""
        return Counter(state for state, _ in self.loops().values())

    def close(self):
        """End what is still there; return whether the nodes ended."""
        self.executor.shutdown()
        ended = [node.close() for node in self.nodes]
        self.nodes.clear()
        self.peer.destroy_node()
        return all(ended)


class Bench(Peer):
    """The node under test, of some parameters, and its peer."""

    def __init__(self, rclpy, parameters):
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        self.backend = BackendNode(parameter_overrides=overrides)
        super().__init__(rclpy, self.backend, robots=parameters.get('robots', ()))
        self.until_heard()


class ScanBench(Peer):
    """The scan front end, and the back end behind it, and a peer that sends what a robot would."""

    def __init__(self, rclpy, backend=False, **parameters):
        files = ['--ros-args', '--params-file', str(SHIPPED)]
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        nodes = [ScanLoopsNode(parameter_overrides=overrides, cli_args=files)]
        if backend:
            nodes.append(BackendNode(cli_args=[*files, '-r', 'odom:=scan_odom']))
        super().__init__(rclpy, *nodes)
        self.scans = self.peer.create_publisher(LaserScan, 'scan', qos_profile_sensor_data)
        for kind, topic, qos in ((OccupancyGrid, 'map', LATCHED), (Odometry, 'scan_odom', 1000),
                                 (PoseWithCovarianceStamped, 'loop_closures', 1000)):
            self.listen(kind, topic, qos)
        self.until(lambda: self.scans.get_subscription_count()
                   and self.publishers['/odom'].get_subscription_count(), 'the node subscribes')
        self.until(lambda: self.scan_status()[1], 'it says how it is')

    def scan_status(self):
        return self.status('scans')

    @property
    def odometry(self):
        """What came on scan_odom, a message for each scan that was used."""
        return self.received['scan_odom']

    def wheels_at(self, stamp, pose):
        """Publish odometry at a stamp [ns] and a pose x, y, yaw."""
        message = Odometry(header=header('odom', stamp), child_frame_id='base_link')
        x, y, yaw = pose
        put(message.pose.pose, (x, y, 0.0), (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)))
        self.send('/odom', message)

    def scan_at(self, stamp, ranges, **changes):
        """Publish a scan of a whole turn that begins behind the robot."""
        message = LaserScan(
            header=header('laser', stamp), angle_min=-np.pi,
            angle_increment=2 * np.pi / len(ranges), range_min=0.05, range_max=8.0)
        message.ranges = np.where(ranges < 8.0, ranges, np.inf).tolist()
        for name, value in changes.items():
            setattr(message, name, value)
        self.scans.publish(message)
        self.executor.spin_once(timeout_sec=0.0)

    def follow(self, ranges, wheels, ahead=2):
        """Send scans (n, rays) and wheels (n, 3), ten a second, as fast as they are used."""
        used = len(self.odometry)
        for k, (seen, pose) in enumerate(zip(ranges, wheels, strict=True)):
            self.scan_at((k + 10) * 10**8, seen)
            self.wheels_at((k + 10) * 10**8, pose)
            self.until(lambda n=k: len(self.odometry) - used >= n - ahead, 'scans are used')


def header(frame, stamp):
    """Return a header; stamp [ns]."""
    seconds, rest = divmod(int(stamp), 10**9)
    return Header(frame_id=frame, stamp=Time(sec=seconds, nanosec=rest))


def stamp_of(header):
    """Return the stamp of a header [ns]."""
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def nanoseconds(text):
    """Return a time [ns] written in seconds with nine digits."""
    return int(text.replace('.', ''))


def odometry(stamp, x, frame='base_link'):
    message = Odometry(header=header('odom', stamp), child_frame_id=frame)
    message.pose.pose.position.x = x
    return message


def loop(stamp, x=0.0, frame='base_link@1.000000000', variance=0.0):
    message = PoseWithCovarianceStamped(header=header(frame, stamp))
    message.pose.pose.position.x, message.pose.pose.orientation.w = x, 1.0
    message.pose.covariance = (variance * np.eye(6)).ravel()
    return message


def poses_of(path):
    """Return the poses of a Path in the plane, x y yaw, (n, 3)."""
    p = np.array([(p.pose.position.x, p.pose.position.y, p.pose.orientation.z,
                   p.pose.orientation.w) for p in path.poses]).reshape(-1, 4)
    yaw = 2 * np.arctan2(p[:, 2], p[:, 3])
    return np.column_stack((p[:, :2], yaw - 2 * np.pi * np.rint(yaw / (2 * np.pi))))


def put(pose, position, quaternion):
    """Set a Pose."""
    pose.position.x, pose.position.y, pose.position.z = map(float, position)
    (pose.orientation.x, pose.orientation.y, pose.orientation.z,
     pose.orientation.w) = map(float, quaternion)


def begin(b, name, request=None, kind=None):
    """Call a service of a node, `backend` if none is named; return the future of its answer."""
    kind = kind or (SetBool if name == 'pause' else Trigger)
    client = b.peer.create_client(kind, name if '/' in name else f'/backend/{name}')
    b.until(client.service_is_ready, f'{name} is offered')
    return client.call_async(request or kind.Request())


def call(b, name, request=None, kind=None):
    """Call a service of a node and return its answer."""
    future = begin(b, name, request, kind)
    b.until(future.done, f'{name} answers')
    return future.result()


def pause(b, paused):
    """Let updates pause, or go on."""
    assert call(b, 'pause', SetBool.Request(data=paused)).success


def set_parameter(b, name, value):
    """Set a parameter of the node; return why it is refused, empty: it is not."""
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    (result,) = call(b, 'set_parameters', request, SetParameters).results
    assert result.successful == (not result.reason)
    return result.reason


def parameters_of(b, *names):
    """Return the values of parameters of the node."""
    answer = call(b, 'get_parameters', GetParameters.Request(names=names), GetParameters)
    return [parameter_value_to_python(value) for value in answer.values]


def warnings(capfd):
    """Return the lines of warnings that were logged since the last call."""
    return [line for line in capfd.readouterr().err.splitlines() if 'WARN' in line]
