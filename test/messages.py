# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""ROS messages, made by `new` of a type's name and fields: of rosbags' classes, or rclpy's."""

import numpy as np
from rosbags.typesys import Stores, get_typestore

TYPES = get_typestore(Stores.ROS2_JAZZY)


def of_rosbags(name, **fields):
    return TYPES.types[name](**fields)


def header(new, sec=12, nanosec=5, frame='odom'):
    return new('std_msgs/msg/Header', frame_id=frame,
               stamp=new('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec))


def numbers(new, kind, values):
    """Return a Point, Vector3 or Quaternion."""
    return new(f'geometry_msgs/msg/{kind}', **dict(zip('xyzw', values, strict=False)))


def pose(new, position=(1.0, 2.0, 0.0), quaternion=(0.0, 0.0, 0.0, 1.0)):
    return new('geometry_msgs/msg/Pose', position=numbers(new, 'Point', position),
               orientation=numbers(new, 'Quaternion', quaternion))


def pose_with_covariance(new, *numbers_of_pose, covariance=None, **fields):
    return new('geometry_msgs/msg/PoseWithCovariance', pose=pose(new, *numbers_of_pose, **fields),
               covariance=np.arange(36.0) if covariance is None else covariance)


def odometry(new, head=None, **fields):
    still = numbers(new, 'Vector3', (0.0, 0.0, 0.0))
    return new('nav_msgs/msg/Odometry', header=head or header(new), child_frame_id='base_link',
               pose=pose_with_covariance(new, **fields),
               twist=new('geometry_msgs/msg/TwistWithCovariance', covariance=-np.arange(36.0),
                         twist=new('geometry_msgs/msg/Twist', linear=still, angular=still)))
