# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The suffixes of bags and their default topics; this module is quick to import."""

from dataclasses import dataclass

BAG_SUFFIXES = ('.mcap', '.db3', '.bag')
ODOMETRY_TOPIC = '/odom'
LOOP_TOPIC = '/loop_closures'
TRUSTED_LOOP_TOPIC = '/trusted_loop_closures'
FALSE_LOOP_TOPIC = '/false_loop_closures'
# Loops that the map does not use; only this program reads them.
REJECTED_LOOP_TOPIC = '/rejected_loop_closures'
ABSOLUTE_TOPIC = '/absolute_poses'
TRUTH_TOPIC = '/ground_truth'
SCAN_TOPIC = '/scan'

ODOMETRY_TYPE = 'nav_msgs/msg/Odometry'
POSE_TYPE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
SCAN_TYPE = 'sensor_msgs/msg/LaserScan'


@dataclass(frozen=True)
class Topics:
    """
    The topics of a bag's odometry and loop closures; its other topics have fixed names.

    with_loops : whether it is an error that another topic than the default is named for the loops
    and has none while another one has; else that is damage of the bag, and the rest is read
    """

    odometry: str = ODOMETRY_TOPIC
    loops: str = LOOP_TOPIC
    with_loops: bool = True

    def types(self) -> dict[str, str]:
        """Return the topics with the types of their messages."""
        return {self.loops: POSE_TYPE, TRUSTED_LOOP_TOPIC: POSE_TYPE,
                FALSE_LOOP_TOPIC: POSE_TYPE, REJECTED_LOOP_TOPIC: POSE_TYPE,
                ABSOLUTE_TOPIC: POSE_TYPE, self.odometry: ODOMETRY_TYPE}


DEFAULT_TOPICS = Topics()
