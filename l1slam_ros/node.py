# SPDX-License-Identifier: Apache-2.0
"""
`backend`: the node. Odometry and loop closures in, the optimised Path out; no arithmetic.

Callbacks convert a message and append it to the back end. A timer wakes one worker thread, which
improves the map and publishes it; see `shared_backend` for why neither waits for the other.
"""

import sys
import threading
import time
from collections import Counter
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry, Path
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from visualization_msgs.msg import MarkerArray

from l1slam_ros.core import se2
from l1slam_ros.core.backend import Improvement
from l1slam_ros.core.errors import L1SlamError, MessageError
from l1slam_ros.core.measurements import OdometrySample
from l1slam_ros.core.warm_up import warm_up
from l1slam_ros.diagnosis import Diagnosis
from l1slam_ros.io.base_frame import BaseFrame
from l1slam_ros.io.messages import loop_closure, odometry_sample
from l1slam_ros.loop_status import LoopStatus
from l1slam_ros.markers import graph_markers
from l1slam_ros.node_options import NodeOptions
from l1slam_ros.orders import Orders
from l1slam_ros.params import NodeParameters
from l1slam_ros.publishing import path_bytes, pose_stamped, transform_stamped
from l1slam_ros.services import MapServices
from l1slam_ros.shared_backend import SharedBackend

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the ROS wheels on PyPI have none
    TFMessage = None

_DEPTH = 1000
_REPEAT_WARNING = 5.0  # [s]


class BackendNode(Node):
    """
    The ROS face of `shared_backend.SharedBackend`.

    Parameters
    ----------
    keywords : passed to `rclpy.node.Node`, e.g. parameter_overrides, context

    Raises
    ------
    OptionError : a parameter given at start is refused.

    """

    def __init__(self, **keywords: Any):
        super().__init__('backend', **keywords)
        self._declared = NodeParameters(self, NodeOptions(), self._on_options)
        self._make_ready()
        options = self.options
        self._manifold = se2
        self._backend = SharedBackend(self._manifold, options)
        self._base_frame = BaseFrame(options.base_frame)
        self._refused: Counter[str] = Counter()
        self._last_stamp = 0
        self._map_to_odom = self._manifold.identity(1)
        self._wake = threading.Event()
        self._paused = self._closing = False
        self._make_publishers()
        self._make_subscriptions()
        self._orders = Orders(self, self._wake)
        self._map_services = MapServices(
            self, self._backend, self._orders, lambda: self.options.save_path, self._set_paused)
        self._jumps = self.get_clock().create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1),
                          on_clock_change=False),
            post_callback=self._on_time_jump)
        self.create_timer(options.update.period, self._on_timer)
        self.create_timer(1.0, self._on_second)
        self._worker = threading.Thread(target=self._work, name='solver', daemon=True)
        self._worker.start()

    @property
    def options(self) -> NodeOptions:
        """The options as they are now."""
        return self._declared.options

    def close(self) -> None:
        """End the worker and the node."""
        self._closing = True
        self._wake.set()
        self._worker.join()
        self.destroy_node()

    def _make_ready(self) -> None:
        """Compile the solver's loops before messages come: it would hold up their callbacks."""
        self.get_logger().info('getting the solver ready; the first time on a machine it is '
                               'compiled, which takes up to half a minute')
        began = time.monotonic()
        warm_up()
        self.get_logger().info(f'solver ready after {time.monotonic() - began:.1f} s')

    def _make_publishers(self) -> None:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._path = self.create_publisher(Path, 'path', latched)
        self._pose = self.create_publisher(PoseStamped, 'pose', 10)
        self._transform = self.create_publisher(TransformStamped, 'map_to_odom', 10)
        self._graph = self.create_publisher(MarkerArray, 'graph', latched)
        self._tf = None
        if TFMessage is not None and self.options.publish_tf:
            self._tf = self.create_publisher(TFMessage, '/tf', 100)
        self._diagnosis = Diagnosis(self)
        self._loop_status = LoopStatus(self)

    def _make_subscriptions(self) -> None:
        reliable = QoSProfile(depth=_DEPTH)
        overridable = QoSOverridingOptions.with_default_policies()
        for kind, topic, callback in (
            (Odometry, 'odom', self._on_odometry),
            (PoseWithCovarianceStamped, 'loop_closures', self._on_loop),
            (PoseWithCovarianceStamped, 'trusted_loop_closures', self._on_trusted_loop),
        ):
            self.create_subscription(kind, topic, callback, reliable,
                                     qos_overriding_options=overridable)

    def _on_options(self, options: NodeOptions) -> None:
        self._backend.set_options(options)

    def _set_paused(self, paused: bool) -> None:
        self._paused = paused

    def _on_time_jump(self, _: TimeJump) -> None:
        if self.options.on_time_jump == 'reset':
            self.get_logger().warning('the clock jumped back: the map begins anew')
            self._orders.place(self._map_services.reset)

    def _on_odometry(self, message: Odometry) -> None:
        try:
            found = self._base_frame.take(message.child_frame_id, odometry_sample(message))
        except L1SlamError as error:
            self._refuse(error)
            return
        if found.anew:
            self._backend.begin_anew()
        for other in found.others:
            self._refuse(other)
        for sample in found.ours:
            self._add_odometry(sample)

    def _add_odometry(self, sample: OdometrySample) -> None:
        try:
            if not self._backend.add_odometry(sample):
                return
        except L1SlamError as error:
            self._refuse(error)
            return
        self._last_stamp = sample.stamp
        pose = self._manifold.compose(self._map_to_odom,
                                      self._manifold.from_pose3(sample.pose3[None]))
        self._pose.publish(pose_stamped(self.options.map_frame, sample.stamp,
                                        self._manifold.to_pose3(pose)[0]))

    def _on_loop(self, message: PoseWithCovarianceStamped) -> None:
        self._add_loop(message, trusted=False)

    def _on_trusted_loop(self, message: PoseWithCovarianceStamped) -> None:
        self._add_loop(message, trusted=True)

    def _add_loop(self, message: PoseWithCovarianceStamped, trusted: bool) -> None:
        try:
            loop = loop_closure(message, self._base_frame.name, trusted)
        except L1SlamError as error:
            self._refuse(error)
            return
        self._backend.add_loop(loop)

    def _refuse(self, error: L1SlamError) -> None:
        self._refused[error.cause if isinstance(error, MessageError) else 'unusable'] += 1
        self.get_logger().warning(f'refused: {error}', throttle_duration_sec=_REPEAT_WARNING)

    def _on_timer(self) -> None:
        self._wake.set()
        if self._last_stamp:
            self._publish_transform()

    def _on_second(self) -> None:
        for sentence in self._backend.news():
            self.get_logger().warning(sentence)
        counts, refused = self._backend.counts()
        self._diagnosis.publish(counts, self._refused + Counter(refused))

    def _work(self) -> None:
        while self._wake.wait() and not self._closing:
            self._wake.clear()
            try:
                if self._orders.carry_out():
                    self._publish_map()
                if not self._paused:
                    self._update()
            except (L1SlamError, ArithmeticError, np.linalg.LinAlgError) as error:
                # The last good map stays; the next update tries again.
                self.get_logger().error(f'update failed: {error}',
                                        throttle_duration_sec=_REPEAT_WARNING)

    def _update(self) -> None:
        improvement = self._backend.update(self.options.update.budget)
        if improvement is not None:
            self._publish_map()
            self._report(improvement)
        else:  # nothing new in the map, but a loop can have come for later, or expired
            self._loop_status.publish(self._backend.loop_states())

    def _publish_map(self) -> None:
        state = self._backend.state()
        self._map_to_odom = state.map_to_odom
        frame, stamp = self.options.map_frame, self._last_stamp
        pose3 = self._manifold.to_pose3(state.poses)
        self._path.publish(path_bytes(frame, stamp, state.stamps, pose3))
        self._publish_transform()
        self._loop_status.publish(state.loops)
        # Markers are slow to make: not unless somebody looks.
        if self._graph.get_subscription_count():
            self._graph.publish(graph_markers(frame, stamp, pose3, state.factors, state.loops))

    def _publish_transform(self) -> None:
        options = self.options
        transform = transform_stamped(options.map_frame, options.odom_frame, self._last_stamp,
                                      self._manifold.to_pose3(self._map_to_odom)[0])
        self._transform.publish(transform)
        if self._tf is not None:
            self._tf.publish(TFMessage(transforms=[transform]))

    def _report(self, improvement: Improvement) -> None:
        self._diagnosis.note(improvement)
        self.get_logger().debug(
            f'update: cost {improvement.cost_before:.6g} -> {improvement.cost:.6g}, '
            f'{improvement.reweighted_steps} reweighted steps, {improvement.outer_iterations} '
            f'outer and {improvement.inner_iterations} inner iterations, '
            f'{improvement.seconds * 1e3:.0f} ms, {improvement.status.value}')


def main() -> int:
    """Run the node until SIGINT or SIGTERM; return the exit code."""
    rclpy.init()
    node = None
    try:
        node = BackendNode()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.get_logger().info('ready: waiting for odometry')
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except L1SlamError as error:
        print(f'backend: {error}', file=sys.stderr)
        return 1
    except Exception:
        # A signal can shut ROS down under any call; what that call then raises is no failure.
        if rclpy.ok():
            raise
    finally:
        if node is not None:
            node.close()
        rclpy.try_shutdown()
    return 0
