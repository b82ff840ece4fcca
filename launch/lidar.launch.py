# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A robot with a 2D lidar: the front end `scan_loops`, and the back end behind it.

    ros2 launch l1slam_ros lidar.launch.py rviz:=true
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, SetRemap
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

CONFIG = PathJoinSubstitution([FindPackageShare('l1slam_ros'), 'config'])
BACKEND = str(Path(__file__).with_name('backend.launch.py'))
SIM_TIME = {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}


def generate_launch_description() -> LaunchDescription:
    """Start `scan_loops` and what backend.launch.py starts; its arguments are those here."""
    return LaunchDescription([
        DeclareLaunchArgument(
            'params_file', default_value=[CONFIG, '/scan_loops.yaml'],
            description='the file of parameters of both nodes'),
        GroupAction([
            # By the name of the node: `scan_loops` receives the odometry of the wheels.
            SetRemap('backend:odom', 'scan_odom'),
            IncludeLaunchDescription(PythonLaunchDescriptionSource(BACKEND)),
            Node(package='l1slam_ros', executable='scan_loops', name='scan_loops',
                 namespace=LaunchConfiguration('namespace'), output='screen',
                 parameters=[SIM_TIME],
                 ros_arguments=['--params-file', LaunchConfiguration('params_file')]),
        ]),
    ])
