# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Messages with the pose graphs of RTAB-Map and of pose_graph_tools, and bags of them."""

import numpy as np
from front_ends import Messages, Recording
from worlds import between

SECOND = 10**9
MAP_GRAPH, POSE_GRAPH = 'rtabmap_msgs/msg/MapGraph', 'pose_graph_tools_msgs/msg/PoseGraph'
# The fields of the public interfaces, as their packages for Jazzy have them.
DEFINITIONS = {
    'rtabmap_msgs/msg/Link': 'int32 from_id\nint32 to_id\nint32 type\n'
        'geometry_msgs/Transform transform\nfloat64[36] information\n',
    MAP_GRAPH: 'std_msgs/Header header\ngeometry_msgs/Transform map_to_odom\n'
        'int32[] poses_id\ngeometry_msgs/Pose[] poses\nLink[] links\n',
    'pose_graph_tools_msgs/msg/PoseGraphNode': 'std_msgs/Header header\nint32 robot_id\n'
        'uint64 key\ngeometry_msgs/Pose pose\n',
    'pose_graph_tools_msgs/msg/PoseGraphEdge': 'std_msgs/Header header\nuint64 key_from\n'
        'uint64 key_to\nint32 robot_from\nint32 robot_to\nint32 type\n'
        'geometry_msgs/Pose pose\nfloat64[36] covariance\n',
    POSE_GRAPH: 'std_msgs/Header header\nPoseGraphNode[] nodes\nPoseGraphEdge[] edges\n',
}
M = Messages(DEFINITIONS)
NEIGHBOUR = 0
GLOBAL = 1
VIRTUAL = 5
PRIOR = 7
LANDMARK = 8
ODOM = 0
LOOPCLOSE = 1
REJECTED = 3
SIGMA = np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
COVARIANCE = np.diag(SIGMA**2)


def seen(truth, i, j):
    """Return the pose (3,) of keyframe j seen from i, numbers from 1."""
    return between(truth[i - 1], truth[j - 1])


def link(i, j, kind, truth, covariance=COVARIANCE):
    return M.new('rtabmap_msgs/msg/Link', from_id=i, to_id=j, type=kind,
                 transform=M.transform(seen(truth, i, j)),
                 information=np.linalg.inv(covariance).ravel())


def map_graph(seconds, ids, links):
    origin = np.zeros(3)
    return M.new(MAP_GRAPH, header=M.header(seconds), map_to_odom=M.transform(origin),
                 poses_id=np.array(ids, np.int32), poses=[M.pose(origin)] * len(ids), links=links)


def edge(i, j, kind, truth, covariance=COVARIANCE, robots=(0, 0)):
    return M.new('pose_graph_tools_msgs/msg/PoseGraphEdge', header=M.header(0), key_from=i,
                 key_to=j, robot_from=robots[0], robot_to=robots[1], type=kind,
                 pose=M.pose(seen(truth, i, j)), covariance=covariance.ravel())


def pose_graph(seconds, keys, edges, robot=0):
    nodes = [M.new('pose_graph_tools_msgs/msg/PoseGraphNode', header=M.header(time),
                   robot_id=robot, key=key, pose=M.pose(np.zeros(3))) for key, time in keys]
    return M.new(POSE_GRAPH, header=M.header(seconds), nodes=nodes, edges=edges)


def growing(truth, closing):
    """Return the graphs of a robot whose keyframe k + 1 is of 10 + k s, with links at the end."""
    links, messages = [], []
    for k in range(1, 7):
        links = links + ([link(k - 1, k, NEIGHBOUR, truth)] if k > 1 else [])
        messages.append(map_graph(9 + k, range(1, k + 1), links + (closing if k == 6 else [])))
    return messages


def write(path, messages):
    """Write (topic, seconds, message) as a bag by rosbags; return the path."""
    bag = Recording(path, DEFINITIONS)
    with bag.writer:
        for message in messages:
            bag.write(*message)
    return path


def driven(truth, first=10.0):
    """Yield the odometry of a robot whose keyframe k + 1 is of 10 + k s, as (n, 3) has it."""
    for k, pose in enumerate(truth):
        yield '/odom', first + k, M.odometry(first + k, between(truth[0], pose))
