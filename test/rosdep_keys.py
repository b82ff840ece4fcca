# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The keys that package.xml may use, with the Debian package of each on Ubuntu 24.04."""

# Where each key of package.xml was looked up: `rosdep/python.yaml` of ros/rosdistro, in a stored
# copy (commit 000730d) and, argcomplete excepted, in one of 2025 that knows Noble (commit 30d139d
# of a fork). The package is the one for each release of Ubuntu: no key has an exception for Noble.
# A key that ends with -pip has a rule for pip alone, which bloom refuses.
OF_ROSDEP = {
    'python3-argcomplete': 'python3-argcomplete',
    # Looked up in the older copy alone, where it is the same for all releases.
    'python3-dev': 'python3-dev',
    'python3-hypothesis': 'python3-hypothesis',
    'python3-matplotlib': 'python3-matplotlib',
    'python3-numpy': 'python3-numpy',
    'python3-packaging': 'python3-packaging',
    'python3-pytest': 'python3-pytest',
    'python3-scipy': 'python3-scipy',
    'python3-tqdm': 'python3-tqdm',
    'python3-yaml': 'python3-yaml',
}
# Packages of ROS itself: ros/rosdistro, `jazzy/distribution.yaml`, a stored copy (commit 0006cda),
# by the repository that holds them; each is released as ros-jazzy-<name>.
OF_JAZZY = {
    'builtin_interfaces': 'rcl_interfaces', 'diagnostic_msgs': 'common_interfaces',
    'geometry_msgs': 'common_interfaces', 'launch': 'launch', 'launch_ros': 'launch_ros',
    'lifecycle_msgs': 'rcl_interfaces',
    'nav_msgs': 'common_interfaces', 'rcl_interfaces': 'rcl_interfaces', 'rclpy': 'rclpy',
    'rosgraph_msgs': 'rcl_interfaces', 'sensor_msgs': 'common_interfaces',
    'std_msgs': 'common_interfaces', 'std_srvs': 'common_interfaces', 'tf2_msgs': 'geometry2',
    'visualization_msgs': 'common_interfaces',
}
