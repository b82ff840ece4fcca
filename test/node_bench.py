# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The node under test in this process, and a peer that talks to it over real DDS."""

import time

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry, Path
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import SetBool, Trigger

from l1slam_ros.core.geometry import se2
from l1slam_ros.io.bags.reader import read_raw
from l1slam_ros.ros.node import BackendNode
from l1slam_ros.ros.shell.header import header

DEADLINE = 60.0
SECOND = 10**8  # [ns] a second of the node's diagnostics
TYPES = {'/odom': Odometry, **dict.fromkeys(
    ('/loop_closures', '/trusted_loop_closures', '/false_loop_closures', '/absolute_poses'),
    PoseWithCovarianceStamped)}
EVERY_MESSAGE = {'keyframe.translation': 0.0, 'keyframe.rotation': 0.0,
                 'odometry.covariance_source': 'increment'}


class Bench:
    """The node under test and a peer that talks to it, spun by one executor."""

    def __init__(self, rclpy, parameters):
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        self.backend = BackendNode(parameter_overrides=overrides)
        # What it says of itself once a second, and what is done then, would be waited for.
        (second,) = self.backend.timers
        second.timer_period_ns = SECOND
        second.reset()
        self.peer = rclpy.create_node('peer')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.backend)
        self.executor.add_node(self.peer)
        # Of several robots, below their names.
        names = [f'{name}/' for name in parameters.get('robots', ())] or ['']
        self.publishers = {
            topic: self.peer.create_publisher(kind, topic, QoSProfile(depth=1000))
            for topic, kind in ((f'/{name}{topic[1:]}', kind) for name in names
                                for topic, kind in TYPES.items())}
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.received = {f'{name}{topic}': [] for name in names
                         for topic in ('path', 'pose', 'map_to_odom')} | {'/diagnostics': []}
        for name in names:
            self.listen(Path, f'{name}path', latched)
            self.listen(PoseStamped, f'{name}pose', 1000)
            self.listen(TransformStamped, f'{name}map_to_odom', 1000)
        self.listen(DiagnosticArray, '/diagnostics', 100)
        self.until(lambda: all(p.get_subscription_count() for p in self.publishers.values()),
                   'the node subscribes')

    def listen(self, kind, topic, qos):
        self.peer.create_subscription(kind, topic, self.received[topic].append, qos)

    def until(self, condition, what):
        deadline = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < deadline, f'waited {DEADLINE} s in vain until {what}'
            self.executor.spin_once(timeout_sec=0.05)

    def send(self, topic, message):
        self.publishers[topic].publish(message)
        self.executor.spin_once(timeout_sec=0.0)

    def drive(self, first, last):
        """Drive along x, a metre and a keyframe a second."""
        for k in range(first, last):
            self.send('/odom', odometry((k + 1) * 10**9, 1.0 * k))

    def play(self, bag):
        """Play a bag as fast as it is used: a burst is more than DDS holds on a busy machine."""
        sent, heard = 0, self.backend._inputs.traffic['odom']
        for message in read_raw(bag):
            self.send(message.topic, message.data)
            sent += message.topic == '/odom'
            if sent % 20 == 0:
                self.until(lambda n=sent: heard.received >= n, 'they are used')

    def path(self):
        return self.received['path'][-1] if self.received['path'] else Path()

    def status(self):
        """Return the last level, sentence and values that the node said of itself."""
        if not self.received['/diagnostics']:
            return None, '', {}
        (status,) = self.received['/diagnostics'][-1].status
        return status.level, status.message, {v.key: v.value for v in status.values}

    def close(self):
        self.executor.shutdown()
        self.backend.close()
        self.peer.destroy_node()


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
    return se2.from_pose3(np.array([
        (p.pose.position.x, p.pose.position.y, p.pose.position.z, p.pose.orientation.x,
         p.pose.orientation.y, p.pose.orientation.z, p.pose.orientation.w)
        for p in path.poses]).reshape(-1, 7))


def begin(b, name, request=None, kind=None):
    """Call a service of the node; return the future of its answer."""
    kind = kind or (SetBool if name == 'pause' else Trigger)
    client = b.peer.create_client(kind, f'/backend/{name}')
    b.until(client.service_is_ready, f'{name} is offered')
    return client.call_async(request or kind.Request())


def call(b, name, request=None, kind=None):
    """Call a service of the node and return its answer."""
    future = begin(b, name, request, kind)
    b.until(future.done, f'{name} answers')
    return future.result()
