# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The node `scan_loops`: scans and wheel odometry in; scan-matched odometry, loops and a grid out.

One thread receives messages, one does all the work, scans first, and one writes the grid when the
service asks for it.
"""

from functools import partial
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Trigger

from l1slam_ros.core.errors import OptionError
from l1slam_ros.ros.parameters import NodeParameters
from l1slam_ros.ros.scans.diagnostics import ScanDiagnostics
from l1slam_ros.ros.scans.front_end_thread import FrontEndThread
from l1slam_ros.ros.scans.map_drawer import MapDrawer
from l1slam_ros.ros.scans.options import ScanLoopsOptions
from l1slam_ros.ros.scans.publishing import ScanPublisher
from l1slam_ros.ros.threads.failures import Failures, reason
from l1slam_ros.ros.threads.intake import Traffic, unheard_by
from l1slam_ros.ros.threads.job_queue import JobQueue

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the ROS wheels on PyPI have none
    TFMessage = None

# As sensors publish, with room for a moment in which nothing is taken over.
_SENSOR = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
_RELIABLE = QoSProfile(depth=1000)
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_STATIC = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Read once, by the front end; the rest may change.
_AT_START = ('keyframe.', 'loop.')


class ScanLoopsNode(Node):
    """
    The ROS node around `core.scans.front_end.ScanFrontEnd`.

    Parameters
    ----------
    keywords : passed to `rclpy.node.Node`, e.g. parameter_overrides, context

    Attributes
    ----------
    failures : what fails now

    Raises
    ------
    OptionError : a parameter given at start is refused.

    """

    def __init__(self, **keywords: Any):
        super().__init__('scan_loops', **keywords)
        self._declared = NodeParameters(self, ScanLoopsOptions(), lambda _: None)
        self.failures = Failures(self.get_logger(), self.context.ok)
        self._drawer = MapDrawer(self, lambda: self.options)
        self._front_end = FrontEndThread(
            self, lambda: self.options, ScanPublisher(self, self.options), self._drawer,
            self.failures, TFMessage is not None and not self.options.laser_pose)
        self._traffic: dict[str, Traffic] = {}
        self._hear(LaserScan, 'scan', _SENSOR)
        self._hear(Odometry, 'odom', _RELIABLE)
        self._hear(Path, 'path', _LATCHED)
        self._hear(PoseWithCovarianceStamped, 'pose_with_covariance', _RELIABLE)
        if TFMessage is not None:
            self._hear(TFMessage, '/tf_static', _STATIC)
        self._jobs = JobQueue(self, self.failures, lambda: None)
        # A callback group of its own: a service that awaits its result blocks its group.
        self.create_service(Trigger, '~/save_map', self._save_map,
                            callback_group=ReentrantCallbackGroup())
        self._diagnostics = ScanDiagnostics(
            self, self._traffic, self._front_end, self._drawer, self.failures)
        for sentence in self._declared.unknown():
            self.get_logger().warning(sentence)
        self.add_on_set_parameters_callback(self._on_set)
        self.create_timer(
            1.0, self.failures.guarded('diagnostics', self._diagnostics.publish),
            clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._jobs.start()
        self._front_end.start()

    @property
    def options(self) -> ScanLoopsOptions:
        """The current options."""
        return self._declared.options

    def close(self, seconds: float = 60.0) -> bool:
        """End the threads and the node; return whether they ended within some seconds."""
        ended = self._front_end.close(seconds)
        ended &= self._jobs.close(seconds)
        if ended:
            self.destroy_node()
        return ended

    def is_saving(self) -> bool:
        """Return whether the end of the node has to wait for a save: never."""
        return False

    def _hear(self, kind: Any, topic: str, qos: QoSProfile) -> None:
        """Subscribe to a topic, and give its messages to the front end, serialised."""
        def take(data: bytes, information: Any) -> None:
            traffic.note(information)
            self._front_end.put(topic, data)

        try:
            subscription = self.create_subscription(
                kind, topic, take, qos, raw=True,
                qos_overriding_options=QoSOverridingOptions.with_default_policies())
        except Exception as error:  # by what is said of its QoS, rclpy raises anything
            raise OptionError(f'{topic} cannot be subscribed to: {reason(error)}') from error
        traffic = self._traffic[topic] = Traffic(
            subscription.get_publisher_count, partial(unheard_by, self, subscription))

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        wrong = [parameter.name for parameter in parameters
                 if parameter.name.startswith(_AT_START)]
        return SetParametersResult(
            successful=not wrong, reason=f'{wrong[0]} is read at start only' if wrong else '')

    async def _save_map(self, _: Trigger.Request, __: Trigger.Response) -> Trigger.Response:
        return await self._jobs.put('~/save_map', self._drawer.save)
