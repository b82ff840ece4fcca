# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The command lines of the executables: what is ROS's of them, and what a node's help says."""

from textwrap import wrap
from typing import NamedTuple

from l1slam_ros.core.options import Meaning, Options, Scalar, flatten

_WIDTH = 98
_Rows = tuple[tuple[str, str, str], ...]


class _Node(NamedTuple):
    """What a node is for, an example, and its topics and services: (name, type, meaning) each."""

    what: str
    example: str
    inputs: _Rows
    outputs: _Rows
    services: _Rows


_BACKEND = _Node(
    'Pose-graph SLAM back end: odometry and loop closures in, the optimised map out.',
    'backend --ros-args --params-file config/backend.yaml -r odom:=/robot/odometry', (
    ('odom', 'nav_msgs/Odometry', "the robot's pose in the odometry frame"),
    ('loop_closures', 'geometry_msgs/PoseWithCovarianceStamped',
     'the robot at header.stamp, in its frame at the time that header.frame_id = '
     'BASE_FRAME@SEC.NANOSEC names'),
    ('trusted_loop_closures', 'the same', 'never rejected'),
    ('false_loop_closures', 'the same', 'the loop of these two stamps is never used again'),
    ('absolute_poses', 'geometry_msgs/PoseWithCovarianceStamped',
     'the robot in the map frame: GPS, markers, a person'),
    ('map_graph', 'rtabmap_msgs/MapGraph', 'where that package is installed'),
    ('pose_graph', 'pose_graph_tools_msgs/PoseGraph', 'where that package is installed'),
    ('slam_toolbox/pose_graph', 'slam_toolbox/PoseGraph', 'where that package is installed'),
    ('slam_toolbox/new_node_event', 'slam_toolbox/NewNodeEvent', 'when its nodes were'),
    ('cslam/keyframe_odom', 'cslam_common_interfaces/KeyframeOdom',
     'where that package is installed'),
    ('cslam/intra_robot_loop_closure', 'cslam_common_interfaces/IntraRobotLoopClosure',
     'loops of this robot'),
    ('cslam/inter_robot_loop_closure', 'cslam_common_interfaces/InterRobotLoopClosure',
     'counted: loops of others'),
), (
    ('path', 'nav_msgs/Path', 'the optimised keyframes'),
    ('pose', 'geometry_msgs/PoseStamped', 'the robot now, with its odometry'),
    ('pose_with_covariance', 'geometry_msgs/PoseWithCovarianceStamped',
     'the newest keyframe after each update'),
    ('map_to_odom', 'geometry_msgs/TransformStamped', 'map -> odom'),
    ('/tf', 'tf2_msgs/TFMessage', 'the same, where that package is installed'),
    ('graph', 'visualization_msgs/MarkerArray', 'keyframes and factors, for RViz and Foxglove'),
    ('loop_status', 'diagnostic_msgs/DiagnosticArray', 'what has become of each loop'),
    ('/diagnostics', 'diagnostic_msgs/DiagnosticArray', 'how the node is, each second'),
), (
    ('~/optimize', 'std_srvs/Trigger', 'solve to the end'),
    ('~/reset', 'std_srvs/Trigger', 'empty the map'),
    ('~/save', 'std_srvs/Trigger', 'write the map to save_path'),
    ('~/load', 'std_srvs/Trigger', 'read it from there'),
    ('~/pause', 'std_srvs/SetBool', 'let no update begin, or go on'),
))
_SCAN_LOOPS = _Node(
    'Front end for a 2D lidar: scans and odometry in, loops, better odometry and the map out.',
    'scan_loops --ros-args --params-file config/scan_loops.yaml -r scan:=/robot/scan', (
    ('scan', 'sensor_msgs/LaserScan', 'what the laser sees; best effort will do'),
    ('odom', 'nav_msgs/Odometry', "the robot's pose by its wheels; another frame than scan_odom"),
    ('path', 'nav_msgs/Path', 'the optimised keyframes, of backend'),
    ('pose_with_covariance', 'geometry_msgs/PoseWithCovarianceStamped',
     'how well the newest one is known, of backend'),
    ('/tf_static', 'tf2_msgs/TFMessage', 'where the laser is, where that package is installed'),
), (
    ('loop_closures', 'geometry_msgs/PoseWithCovarianceStamped', 'for backend'),
    ('scan_odom', 'nav_msgs/Odometry',
     'for backend, with -r odom:=scan_odom -p odometry.covariance_source:=increment: one message '
     'a scan; pose.covariance is that of the motion since the message before'),
    ('map', 'nav_msgs/OccupancyGrid', 'what the scans have seen, where the path has them'),
    ('/tf', 'tf2_msgs/TFMessage',
     'where the frame of odom is in that of scan_odom, where that package is installed'),
    ('/diagnostics', 'diagnostic_msgs/DiagnosticArray', 'how the node is, each second'),
), (
    ('~/save_map', 'std_srvs/Trigger', 'write the map to map_path, a .pgm, and its .yaml'),
))
_NODES = {'backend': _BACKEND, 'scan_loops': _SCAN_LOOPS}


def split(arguments: list[str]) -> tuple[list[str], list[str]]:
    """
    Split a command line in what is not ROS's, and what is.

    ROS's begins at each `--ros-args` and ends at `--`. rclpy's own splitting, too, takes the
    old:=new of `replay --remap` for its.
    """
    own: list[str] = []
    ros: list[str] = []
    within = False
    for argument in arguments:
        begins = argument == '--ros-args'
        (ros if within or begins else own).append(argument)
        within = (within or begins) and argument != '--'
    return own, ros


def help_of(name: str, options: Options) -> str:
    """Return what `--help` of a node prints; options : of the node, with their defaults."""
    node = _NODES[name]
    parts = [f'usage: {name} [-h] [--ros-args ...]\n\n{node.what}\n\n  {node.example}\n']
    for title, rows in (('subscribes to', node.inputs), ('publishes', node.outputs),
                        ('services', node.services)):
        parts.append(f'{title}:\n' + ''.join(
            _entry(f'{topic} ({kind})', meaning) for topic, kind, meaning in rows))
    parts.append('parameters, with their defaults:\n' + ''.join(
        _entry(f'{field}: {_shown(value)}', _said(meaning))
        for field, (value, meaning) in flatten(options).items()))
    parts.append('ended by SIGINT or SIGTERM with exit code 0; by an unknown argument with 2')
    return '\n'.join(parts)


def _entry(name: str, meaning: str) -> str:
    lines = wrap(meaning, _WIDTH - 6)
    return f'  {name}\n' + ''.join(f'      {line}\n' for line in lines)


def _shown(value: Scalar) -> str:
    """Return a value as it is written after `-p name:=`."""
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _said(meaning: Meaning) -> str:
    unit = f' [{meaning.unit}]' if meaning.unit else ''
    limits = f'; {meaning.expected()}' if meaning.choices or meaning.low is not None else ''
    return f'{meaning.doc}{unit}{limits}{"; at start only" if meaning.fixed else ""}'
