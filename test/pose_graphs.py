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
from front_ends import pose3
from messages import odometry, of_rosbags
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

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
FIELDS = {name: fields for key, text in DEFINITIONS.items()
          for name, fields in get_types_from_msg(text, key).items()}
TYPES = get_typestore(Stores.ROS2_JAZZY)
TYPES.register(FIELDS)
M = TYPES.types
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


def between(a, b):
    """Return poses (m, 3) seen from others."""
    c, s, d = np.cos(a[:, 2]), np.sin(a[:, 2]), b - a
    turn = (d[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return np.stack((c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], turn), axis=1)


def header(seconds):
    stamp = M['builtin_interfaces/msg/Time'](int(seconds), round(seconds % 1 * SECOND))
    return M['std_msgs/msg/Header'](stamp, 'map')


def parts(pose):
    """Return position and orientation of a pose (1, 3) in the plane."""
    numbers = pose3(pose[0])
    return numbers[:3], M['geometry_msgs/msg/Quaternion'](*numbers[3:])


def pose_message(pose):
    position, orientation = parts(pose)
    return M['geometry_msgs/msg/Pose'](M['geometry_msgs/msg/Point'](*position), orientation)


def transform(pose):
    position, orientation = parts(pose)
    return M['geometry_msgs/msg/Transform'](
        M['geometry_msgs/msg/Vector3'](*position), orientation)


def link(i, j, kind, truth, covariance=COVARIANCE):
    return M['rtabmap_msgs/msg/Link'](
        i, j, kind, transform(between(truth[i - 1][None], truth[j - 1][None])),
        np.linalg.inv(covariance).ravel())


def map_graph(seconds, ids, links):
    return M[MAP_GRAPH](header(seconds), transform(np.zeros((1, 3))), np.array(ids, np.int32),
                        [pose_message(np.zeros((1, 3)))] * len(ids), links)


def edge(i, j, kind, truth, covariance=COVARIANCE, robots=(0, 0)):
    return M['pose_graph_tools_msgs/msg/PoseGraphEdge'](
        header(0), i, j, *robots, kind,
        pose_message(between(truth[i - 1][None], truth[j - 1][None])), covariance.ravel())


def pose_graph(seconds, keys, edges, robot=0):
    nodes = [M['pose_graph_tools_msgs/msg/PoseGraphNode'](
        header(time), robot, key, pose_message(np.zeros((1, 3)))) for key, time in keys]
    return M[POSE_GRAPH](header(seconds), nodes, edges)


def growing(truth, closing):
    """Return the graphs of a robot whose keyframe k + 1 is of 10 + k s, with links at the end."""
    links, messages = [], []
    for k in range(1, 7):
        links = links + ([link(k - 1, k, NEIGHBOUR, truth)] if k > 1 else [])
        messages.append(map_graph(9 + k, range(1, k + 1), links + (closing if k == 6 else [])))
    return messages


def write(path, messages):
    """Write (topic, seconds, message) as a bag by rosbags; return the path."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {}
        for topic, seconds, message in messages:
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(topics[topic], round(seconds * SECOND),
                         TYPES.serialize_cdr(message, kind))
    return path


def driven(truth, first=10.0):
    """Yield the odometry of a robot whose keyframe k + 1 is of 10 + k s, as (n, 3) has it."""
    for k in range(len(truth)):
        numbers = pose3(between(truth[:1], truth[k : k + 1])[0])
        yield '/odom', first + k, odometry(
            of_rosbags, header(first + k), position=numbers[:3], quaternion=numbers[3:],
            covariance=np.zeros(36))
