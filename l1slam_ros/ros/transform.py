# SPDX-License-Identifier: Apache-2.0
"""map -> odom: on `map_to_odom` always, on /tf where tf2_msgs is installed."""

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node

from l1slam_ros.core.online.backend import Backend
from l1slam_ros.io.node_options import NodeOptions
from l1slam_ros.ros.publishing import transform_stamped

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the ROS wheels on PyPI have none
    TFMessage = None

_SECOND = 1_000_000_000


class MapToOdom:
    """
    Publishes where the odometry frame is in the map, stamped ahead of the newest odometry.

    A look-up at the time of the newest odometry succeeds so, as long as the next transform comes
    within the tolerance; with a stamp of its own it would fail until then.

    Parameters
    ----------
    node : to publish from
    backend : which knows where the robot is
    on_tf : publish on /tf, too

    """

    def __init__(self, node: Node, backend: Backend, on_tf: bool):
        self._backend = backend
        self._publisher = node.create_publisher(TransformStamped, 'map_to_odom', 10)
        self._tf = None
        if on_tf and TFMessage is not None:
            self._tf = node.create_publisher(TFMessage, '/tf', 100)
        self._newest = self._stamp = self._before = 0

    def forget(self) -> None:
        """Be silent until there is other odometry: its stamps so far are of another time."""
        self._before = self._newest

    def publish(self, options: NodeOptions) -> bool:
        """Publish the transform as it is now; return whether any odometry has come."""
        robot = self._backend.robot()
        if robot is None or robot.stamp == self._before:
            return False
        self._before = 0
        if robot.stamp < self._newest:
            self._stamp = 0  # time itself went back
        self._newest = robot.stamp
        # tf2 ignores a second transform of one time, and warns of it.
        self._stamp = max(robot.stamp + int(options.transform_tolerance * _SECOND),
                          self._stamp + 1)
        transform = transform_stamped(
            options.map_frame, options.odom_frame, self._stamp,
            self._backend.manifold.to_pose3(robot.map_to_odom)[0])
        self._publisher.publish(transform)
        if self._tf is not None:
            self._tf.publish(TFMessage(transforms=[transform]))
        return True
