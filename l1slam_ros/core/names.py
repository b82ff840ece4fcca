# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The names that people choose by. Imports nothing, so that a command line offers them at once."""

# The first of each is the default.
STARTS = ('seed', 'file', 'odometry')
NORMS = ('l1', 'group-l1', 'l2', 'huber')
# Of loops and absolute poses: that of the odometry.
SAME = 'same'
SOLVERS = ('auto', 'primal-dual', 'interior-point')
WORLDS = ('streets', 'building', 'sphere', 'torus')
KINDS_OF_FALSE_LOOPS = ('random', 'identity', 'grouped')
# What the rotation block of the information in a g2o file of poses in space is of.
ROTATION_INFORMATION = QUATERNION, ANGLE = ('quaternion', 'angle')
# What a parameter file may say besides, dotted names by their first part: to every node of ROS,
# and to the one around a back end.
OF_ROS = frozenset(('use_sim_time', 'start_type_description_service', 'qos_overrides'))
OF_THE_NODE = OF_ROS | {
    'autostart', 'dimension', 'map_frame', 'odom_frame', 'publish_tf',
    'transform_period', 'transform_tolerance', 'save_path', 'autosave_period', 'load_on_start',
    'robots', 'update'}
