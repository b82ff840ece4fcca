# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The messages of other front ends that are read: their types, and their topics in the node."""

from typing import NamedTuple

from l1slam_ros.io.messages.edge_graph import EdgeGraph
from l1slam_ros.io.messages.pose_graphs import MAP_GRAPH, POSE_GRAPH, PoseGraphs
from l1slam_ros.io.messages.slam_toolbox import GRAPH, NEW_NODE, SlamToolbox
from l1slam_ros.io.messages.swarm_slam import BETWEEN, KEYFRAME, WITHIN, SwarmSlam


class FrontEnd(NamedTuple):
    """
    A front end: the class of its graph, its topics with their types, the type of its loops.

    is_found : its graph is read from a bag that has no odometry topic.
    """

    graph: type[EdgeGraph]
    topics: dict[str, str]
    loops: str
    is_found: bool = False

    def loops_or_keyframes(self) -> set[str]:
        """Return the types of the messages with loops and with keyframes."""
        return {self.loops, next(iter(self.topics.values()))}


FRONT_ENDS = (
    FrontEnd(PoseGraphs, {'map_graph': MAP_GRAPH}, MAP_GRAPH),
    FrontEnd(PoseGraphs, {'pose_graph': POSE_GRAPH}, POSE_GRAPH),
    FrontEnd(SlamToolbox, {'slam_toolbox/new_node_event': NEW_NODE,
                           'slam_toolbox/pose_graph': GRAPH}, GRAPH, True),
    FrontEnd(SwarmSlam, {'cslam/keyframe_odom': KEYFRAME,
                         'cslam/intra_robot_loop_closure': WITHIN,
                         'cslam/inter_robot_loop_closure': BETWEEN}, WITHIN, True))
LOOP_TYPES = tuple(one.loops for one in FRONT_ENDS)


def front_end_of(msgtype: str) -> FrontEnd | None:
    """Return the front end that sends messages of this type, if any."""
    return next((one for one in FRONT_ENDS if msgtype in one.topics.values()), None)
