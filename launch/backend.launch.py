# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The back end: odometry and loop closures in, the optimised Path out.

    ros2 launch l1slam_ros backend.launch.py params_file:=my_robot.yaml rviz:=true
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

CONFIG = PathJoinSubstitution([FindPackageShare('l1slam_ros'), 'config'])
NAMESPACE = LaunchConfiguration('namespace')
SIM_TIME = {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}


def generate_launch_description() -> LaunchDescription:
    """Start `backend`, and RViz with `rviz:=true`."""
    return LaunchDescription([
        DeclareLaunchArgument(
            'params_file', default_value=[CONFIG, '/backend.yaml'],
            description='the file of parameters'),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false',
            description='true: the time is that of /clock, as of a simulator or `ros2 bag play '
                        '--clock`; goes before what params_file says'),
        DeclareLaunchArgument(
            'namespace', default_value='', description='namespace of the nodes and their topics'),
        DeclareLaunchArgument(
            'map', default_value='',
            description='a saved map, .g2o: loaded at start if it exists, and saved there; '
                        'empty: save_path and load_on_start of params_file'),
        DeclareLaunchArgument(
            'rviz', default_value='false', description='true: start RViz, too'),
        # Before the node: where RViz is not installed, nothing is left running.
        Node(package='rviz2', executable='rviz2', namespace=NAMESPACE,
             arguments=['-d', [CONFIG, '/l1slam.rviz']], parameters=[SIM_TIME],
             condition=IfCondition(LaunchConfiguration('rviz'))),
        OpaqueFunction(function=_backend),
    ])


def _backend(context: LaunchContext) -> list[Node]:
    """Return the node; only with `map` are two of its parameters not those of the file."""
    path = LaunchConfiguration('map').perform(context)
    saved = {'save_path': ParameterValue(path, value_type=str), 'load_on_start': True}
    return [Node(
        package='l1slam_ros', executable='backend', name='backend', namespace=NAMESPACE,
        output='screen', parameters=[SIM_TIME, saved] if path else [SIM_TIME],
        # Not among `parameters`: a file that is missing would be left out with a warning.
        ros_arguments=['--params-file', LaunchConfiguration('params_file')])]
