# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The command lines of the executables: their own and ROS's arguments, and the nodes' --help."""

from textwrap import wrap
from typing import NamedTuple

from l1slam_ros.core.options import Meaning, Options, Scalar, flatten

_WIDTH = 98
_Rows = tuple[tuple[str, str, str], ...]


class _Node(NamedTuple):
    """What `--help` of a node shows: topics and services are rows (name, type, meaning)."""

    what: str
    example: str
    inputs: _Rows
    outputs: _Rows
    services: _Rows


_BACKEND = _Node(
    'Pose-graph SLAM back end: odometry and loop closures in, the optimised map out.',
    'backend --ros-args --params-file config/backend.yaml -r odom:=/robot/odometry', (
    ('odom', 'nav_msgs/Odometry', 'pose of the robot in the odometry frame'),
    ('loop_closures', 'geometry_msgs/PoseWithCovarianceStamped',
     'pose of the robot at header.stamp, seen from the robot at an earlier time; header.frame_id '
     '= BASE_FRAME@SEC.NANOSEC names that time'),
    ('trusted_loop_closures', 'the same', 'loops that are never rejected'),
    ('false_loop_closures', 'the same',
     'strikes out the loop between these two times: it is never used again'),
    ('absolute_poses', 'geometry_msgs/PoseWithCovarianceStamped',
     'pose of the robot in the map frame, from GPS, a marker or a person'),
    ('map_graph', 'rtabmap_msgs/MapGraph', 'its loops, if that package is installed'),
    ('pose_graph', 'pose_graph_tools_msgs/PoseGraph',
     'its loops, if that package is installed'),
    ('slam_toolbox/pose_graph', 'slam_toolbox/PoseGraph',
     'its loops, if that package is installed'),
    ('slam_toolbox/new_node_event', 'slam_toolbox/NewNodeEvent',
     'the stamps of the nodes of that graph'),
    ('cslam/keyframe_odom', 'cslam_common_interfaces/KeyframeOdom',
     'the stamps of the keyframes of Swarm-SLAM, if that package is installed'),
    ('cslam/intra_robot_loop_closure', 'cslam_common_interfaces/IntraRobotLoopClosure',
     'loops within this robot'),
    ('cslam/inter_robot_loop_closure', 'cslam_common_interfaces/InterRobotLoopClosure',
     'loops between robots: counted, not used'),
), (
    ('path', 'nav_msgs/Path', 'all keyframes, optimised'),
    ('pose', 'geometry_msgs/PoseStamped', 'the robot in the map, at the rate of the odometry'),
    ('pose_with_covariance', 'geometry_msgs/PoseWithCovarianceStamped',
     'the newest keyframe after each update'),
    ('map_to_odom', 'geometry_msgs/TransformStamped', 'map -> odom'),
    ('/tf', 'tf2_msgs/TFMessage', 'map -> odom, if that package is installed'),
    ('graph', 'visualization_msgs/MarkerArray', 'keyframes and factors, for RViz and Foxglove'),
    ('loop_status', 'diagnostic_msgs/DiagnosticArray',
     'state of each loop, when it comes and when its state changes'),
    ('/diagnostics', 'diagnostic_msgs/DiagnosticArray', 'state of the node, once a second'),
), (
    ('~/optimize', 'std_srvs/Trigger', 'judge all loops and solve to the optimum'),
    ('~/reset', 'std_srvs/Trigger', 'empty the map'),
    ('~/save', 'std_srvs/Trigger', 'write the map to save_path'),
    ('~/load', 'std_srvs/Trigger', 'read the map from save_path'),
    ('~/pause', 'std_srvs/SetBool', 'true: pause the updates; false: go on'),
))
_SCAN_LOOPS = _Node(
    'Front end for a 2D lidar: scans and odometry in; loops, scan-matched odometry and an '
    'occupancy grid out.',
    'scan_loops --ros-args --params-file config/scan_loops.yaml -r scan:=/robot/scan', (
    ('scan', 'sensor_msgs/LaserScan', 'the scans; reliable or best effort'),
    ('odom', 'nav_msgs/Odometry',
     "pose of the robot by its wheels; its frame must differ from scan_odom's"),
    ('path', 'nav_msgs/Path', 'the optimised keyframes, from backend'),
    ('pose_with_covariance', 'geometry_msgs/PoseWithCovarianceStamped',
     'covariance of the newest keyframe, from backend'),
    ('/tf_static', 'tf2_msgs/TFMessage',
     'pose of the laser on the robot, if that package is installed'),
), (
    ('loop_closures', 'geometry_msgs/PoseWithCovarianceStamped', 'loops, for backend'),
    ('scan_odom', 'nav_msgs/Odometry',
     'scan-matched odometry, one message for each scan, for backend with -r odom:=scan_odom -p '
     'odometry.covariance_source:=increment; pose.covariance is that of the motion since the '
     'message before'),
    ('map', 'nav_msgs/OccupancyGrid', 'the scans, drawn at the optimised keyframes'),
    ('/tf', 'tf2_msgs/TFMessage',
     'scan_odom -> the frame of odom, if that package is installed'),
    ('/diagnostics', 'diagnostic_msgs/DiagnosticArray', 'state of the node, once a second'),
), (
    ('~/save_map', 'std_srvs/Trigger', 'write the occupancy grid to map_path, and its .yaml'),
))
_NODES = {'backend': _BACKEND, 'scan_loops': _SCAN_LOOPS}


def split(arguments: list[str]) -> tuple[list[str], list[str]]:
    """
    Split a command line into the executable's own arguments and those of ROS.

    Those of ROS begin at each `--ros-args` and end at `--`. rclpy's own function cannot be used:
    it also takes the old:=new of `replay --remap` for an argument of ROS.
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
    """Return what `--help` of a node prints; options : the node's, at their defaults."""
    node = _NODES[name]
    parts = [f'usage: {name} [-h] [--ros-args ...]\n\n{node.what}\n\n  {node.example}\n']
    for title, rows in (('subscribes to', node.inputs), ('publishes', node.outputs),
                        ('services', node.services)):
        parts.append(f'{title}:\n' + ''.join(
            _entry(f'{topic} ({kind})', meaning) for topic, kind, meaning in rows))
    parts.append('parameters, with their defaults:\n' + ''.join(
        _entry(f'{field}: {_shown(value)}', _said(meaning))
        for field, (value, meaning) in flatten(options).items()))
    parts.append('SIGINT and SIGTERM end the node with exit code 0. An unknown argument ends it '
                 'with 2.')
    return '\n'.join(parts)


def _entry(name: str, meaning: str) -> str:
    lines = wrap(meaning, _WIDTH - 6)
    return f'  {name}\n' + ''.join(f'      {line}\n' for line in lines)


def _shown(value: Scalar) -> str:
    """Return a value as it is written after `-p name:=`."""
    if isinstance(value, tuple):
        return repr(list(value))
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _said(meaning: Meaning) -> str:
    unit = f' [{meaning.unit}]' if meaning.unit else ''
    limits = f'; {meaning.expected()}' if meaning.choices or meaning.low is not None else ''
    return f'{meaning.doc}{unit}{limits}{"; at start only" if meaning.fixed else ""}'
