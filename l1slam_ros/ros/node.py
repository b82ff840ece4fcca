# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The node `backend`: odometry and loop closures in, the optimised Path out.

One thread receives messages and publishes poses, one improves and publishes the map, one carries
out services, and one saves the map. None waits for another that computes, see
doc/how_a_message_becomes_a_map.md.
"""

import time
from collections import Counter
from functools import partial
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter

from l1slam_ros.core.memory import measure_by
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.io.free_memory import free_memory
from l1slam_ros.io.graphs.map_file import MapFile, unusable_path
from l1slam_ros.io.node_options import NodeOptions
from l1slam_ros.ros.diagnostics import Diagnostics, RobotLine
from l1slam_ros.ros.parameters import NodeParameters
from l1slam_ros.ros.publishing import MapPublisher
from l1slam_ros.ros.robot import RobotPublisher
from l1slam_ros.ros.services import MapServices
from l1slam_ros.ros.threads.failures import Failures
from l1slam_ros.ros.threads.inputs import Inputs
from l1slam_ros.ros.threads.job_queue import JobQueue
from l1slam_ros.ros.threads.solver_thread import SolverThread

_REPEAT_WARNING = 5.0  # [s]
# [s] By how much longer the node waits at its end for a map that is being saved.
_SAVING = 4.0


class BackendNode(LifecycleNode):
    """
    The ROS node around `core.running.backend.Backend`.

    A managed node: it uses messages and publishes map -> odom while it is active, which it is at
    once unless `autostart` is false. The transition `cleanup` empties the map.

    Parameters
    ----------
    keywords : passed to `rclpy.node.Node`, e.g. parameter_overrides, context

    Attributes
    ----------
    failures : the failures that last

    Raises
    ------
    OptionError : a parameter given at start is refused.

    """

    def __init__(self, **keywords: Any):
        super().__init__('backend', **keywords)
        self._declared = NodeParameters(self, NodeOptions(), self._on_change)
        options = self.options
        measure_by(free_memory)
        self._backend = Backend(options, options.dimension)
        self.failures = Failures(self.get_logger(), self.context.ok)
        self._solver = SolverThread(self._backend, self.failures, self._declared)
        self._jobs = JobQueue(self, self.failures, self._solver.hurry)
        self._map_file = MapFile(self._backend, lambda: self.options, self.get_logger().warning)
        if options.load_on_start:
            self._map_file.load_at_start(self.get_logger().info)
        self._robots = [RobotPublisher(self, self._backend, self._declared, number, name)
                        for number, name in enumerate(options.robots)]
        self._inputs = Inputs(self, self._backend, options, self.failures, self._robots)
        self._diagnostics = Diagnostics(self, self._inputs.traffic, self._solver, self.failures)
        self._map = MapPublisher(
            self, self._backend, self._declared, self._diagnostics, self._robots, self.failures)
        self._map_services = MapServices(
            self, self._backend, self._jobs, self._map_file, self.failures,
            self._solver.pause, self._solver.is_closing)
        for sentence in *self._declared.unknown(), unusable_path(options.save_path):
            if sentence:
                self.get_logger().warning(sentence)
        self._connect_callbacks()
        if options.autostart:
            self.trigger_configure()
            self.trigger_activate()
        # Activate first: a subscriber that receives a loaded map may send odometry at once.
        self._map.tell()
        self._jobs.start()
        self._map_services.start()
        self._solver.start(self._map.tell)
        self._inputs.intake.start()

    def _connect_callbacks(self) -> None:
        """Register the callbacks of parameters, transitions, clock jumps and the timer."""
        guarded = self.failures.guarded
        self.add_on_set_parameters_callback(self._on_set)
        change = self._service_change_state
        change.callback = partial(self._on_change_state, change.callback)
        self._jumps = self.get_clock().create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1),
                          on_clock_change=False),
            post_callback=guarded('time jump', self._on_time_jump))
        # A steady clock, which also runs when simulated time stands still or a bag has ended.
        self.create_timer(1.0, guarded('diagnostics', self._on_second),
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_activate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Use messages from now on."""
        self._inputs.intake.active = True
        self._inputs.intake.wake()
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Ignore messages from now on; the map stays as it is."""
        self._inputs.intake.active = False
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Empty the map, not its file."""
        self._map_services.begin_anew('clean up')
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Ignore messages for good; the map is saved when the process ends."""
        return self.on_deactivate(state)

    def _on_change_state(self, change: Any, request: Any, response: Any) -> Any:
        """Answer a request for a transition that does not exist, for which rclpy raises."""
        try:
            return change(request, response)
        except rclpy_implementation.RCLError:
            self.get_logger().warning(
                f'there is no transition {request.transition.id} from '
                f'{self._state_machine.current_state[1]!r}; expected another, or, where a manager '
                'configures and activates the node, autostart: false')
            return response

    @property
    def options(self) -> NodeOptions:
        """The current options."""
        return self._declared.options

    def close(self, seconds: float = 60.0) -> bool:
        """End the threads and the node; return whether they ended within some seconds."""
        deadline = time.monotonic() + seconds
        self._solver.close(0.0)  # what it works at for a job stops
        ended = self._inputs.intake.close(seconds)
        self._map_services.close()
        ended &= self._jobs.close(seconds)
        ended &= self._map_services.is_closed(max(deadline - time.monotonic(), 0.0) + _SAVING)
        ended &= self._solver.close(max(deadline - time.monotonic(), 0.0))
        ended &= self._map.close(max(deadline - time.monotonic(), 0.0))
        if ended:
            self.destroy_node()
            # rclpy does not destroy it, and it keeps the node in the graph of ROS.
            self._state_machine: Any = None
        return ended

    def is_saving(self) -> bool:
        """Return whether the map is being saved."""
        return self._map_services.is_saving()

    def _on_change(self, options: NodeOptions) -> None:
        """Take new options; the next update, for which it may have been long, is now."""
        self._backend.set_options(options)
        self._solver.hurry()

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        """Refuse a `save_path` that cannot be written; at start its folder may be missing."""
        wrong = ''.join(unusable_path(str(parameter.value)) for parameter in parameters
                        if parameter.name == 'save_path')
        return SetParametersResult(successful=not wrong, reason=wrong)

    def _on_time_jump(self, _: TimeJump) -> None:
        for robot in self._robots:
            robot.forget()
        if self.options.on_time_jump == 'reset':
            self.get_logger().warning('the clock jumped back: the map begins anew')
            self._map_services.begin_anew('time jump')

    def _on_second(self) -> None:
        self._inputs.intake.look_at_events()
        for sentence in self._backend.news():
            self.get_logger().warning(sentence)
        counts = self._backend.counts()
        self._diagnostics.publish(
            counts, self._backend.behind(), self._inputs.refused + Counter(counts.refused),
            self._twins(), self._lines())

    def _lines(self) -> list[RobotLine]:
        """Return the diagnostics of each robot that has a name."""
        return [RobotLine(one.name, self._backend.robot(one.number), one.map_frame)
                for one in self._robots if one.name]

    def _twins(self) -> str:
        """Return a sentence if another node has the same name, else an empty one."""
        own = self.get_name(), self.get_namespace()
        count = self.get_node_names_and_namespaces().count(own)
        if count < 2:
            return ''
        wrong = f'{count} nodes are called {self.get_fully_qualified_name()}; expected one'
        self.get_logger().warning(wrong, throttle_duration_sec=_REPEAT_WARNING)
        return wrong
