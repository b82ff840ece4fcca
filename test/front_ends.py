# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Recordings with the messages of other front ends, written by rosbags alone."""

import numpy as np
from heard import pose3
from messages import header, odometry, pose
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SECOND = 10**9
GRAPH, NEW_NODE = 'slam_toolbox/msg/PoseGraph', 'slam_toolbox/msg/NewNodeEvent'
KEYFRAME, WITHIN, BETWEEN = (f'cslam_common_interfaces/msg/{name}' for name in (
    'KeyframeOdom', 'IntraRobotLoopClosure', 'InterRobotLoopClosure'))
EDGE, NODE = 'slam_toolbox/msg/GraphEdge', 'slam_toolbox/msg/GraphNode'
CLOSED = 'slam_toolbox/msg/LoopClosureEvent'
# The fields of the public interfaces; two versions of each.
POSE2D = {
    EDGE: 'int32 source_id\nint32 target_id\ngeometry_msgs/Pose2D relative_pose\n'
        'float64[9] covariance\n',
    NODE: 'int32 node_id\ngeometry_msgs/Pose pose\n',
    GRAPH: 'std_msgs/Header header\nGraphNode[] nodes\nGraphEdge[] edges\n',
    NEW_NODE: 'int32 new_node_id\nbuiltin_interfaces/Time stamp\ngeometry_msgs/Pose pose\n'
        'GraphEdge edge\n',
    CLOSED: 'builtin_interfaces/Time stamp\n',
}
POSE = POSE2D | {
    EDGE: POSE2D[EDGE].replace('Pose2D', 'Pose'),
    NEW_NODE: POSE2D[NEW_NODE].replace('GraphEdge edge', 'GraphEdge[] edges')}
BARE = {
    KEYFRAME: 'uint32 id\nnav_msgs/Odometry odom\n',
    WITHIN: 'uint32 keyframe0_id\nuint32 keyframe1_id\nbool success\n'
        'geometry_msgs/Transform transform\n',
    BETWEEN: 'uint32 robot0_keyframe_id\nuint32 robot0_id\nuint32 robot1_keyframe_id\n'
        'uint32 robot1_id\nbool success\ngeometry_msgs/Transform transform\n',
}
FORK = {KEYFRAME: BARE[KEYFRAME] + 'bool tracking_reset\n', **{
    name: BARE[name].replace('Transform transform', 'PoseWithCovariance pose')
    for name in (WITHIN, BETWEEN)}}


class Messages:
    """Messages of ROS and of some definitions more, by rosbags alone."""

    def __init__(self, definitions):
        self.types = get_typestore(Stores.ROS2_JAZZY)
        self.types.register({name: fields for key, text in definitions.items()
                             for name, fields in get_types_from_msg(text, key).items()})

    def new(self, name, **fields):
        return self.types.types[name](**fields)

    def time(self, seconds):
        return self.header(seconds).stamp

    def header(self, seconds):
        sec, part = divmod(float(seconds), 1)
        return header(self.new, int(sec), round(part * SECOND), 'map')

    def pose(self, at):
        numbers = pose3(at)
        return pose(self.new, numbers[:3], numbers[3:])

    def transform(self, at):
        there = self.pose(at)
        return self.new('geometry_msgs/msg/Transform', rotation=there.orientation,
                        translation=self.new('geometry_msgs/msg/Vector3', **vars(there.position)))

    def odometry(self, seconds, at):
        numbers = pose3(at)
        return odometry(self.new, self.header(seconds), position=numbers[:3],
                        quaternion=numbers[3:], covariance=np.zeros(36))


class Recording(Messages):
    """A bag under way, written by rosbags alone."""

    def __init__(self, path, definitions):
        super().__init__(definitions)
        self._connections = {}
        self.writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)

    def write(self, topic, seconds, message):
        if topic not in self._connections:
            self._connections[topic] = self.writer.add_connection(
                topic, message.__msgtype__, typestore=self.types)
        self.writer.write(self._connections[topic], round(seconds * SECOND),
                          self.types.serialize_cdr(message, message.__msgtype__))


def edge_message(bag, factors, row):
    """An edge as slam_toolbox has it: its covariance in the axes of the source."""
    i, j = factors.pairs[row].tolist()
    pose = factors.measurement[row]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    root = factors.sqrt_information[row]
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    covariance = turn @ np.linalg.inv(root.T @ root) @ turn.T
    flat = 'Pose2D' in str(bag.types.fielddefs[EDGE])
    relative = bag.new('geometry_msgs/msg/Pose2D', x=pose[0], y=pose[1],
                       theta=pose[2]) if flat else bag.pose(pose)
    return bag.new(EDGE, source_id=i, target_id=j, relative_pose=relative,
                   covariance=covariance.ravel())


def toolbox_bag(path, graph, definitions, odometry=None, events=True):
    """
    A recording of slam_toolbox: an event a node, its whole graph now and then, nodes moving.

    odometry : (n, 3), on /odom at the times of the nodes; none: there is none
    """
    bag, factors = Recording(path, definitions), graph.between
    edges = [edge_message(bag, factors, row) for row in range(len(factors))]
    nothing = bag.new(EDGE, source_id=0, target_id=0, covariance=np.zeros(9),
                      relative_pose=edges[0].relative_pose)
    rng = np.random.default_rng(1)
    with bag.writer:
        for k in range(graph.n_poses):
            seconds = 100 + k
            if odometry is not None:
                bag.write('/odom', seconds, bag.odometry(seconds, odometry[k]))
            into = [edge for edge in edges if edge.target_id == k]
            told = {'edges': into} if definitions is POSE else {'edge': (into or [nothing])[-1]}
            pose = bag.pose(rng.normal(size=3))
            if events:
                bag.write('/slam_toolbox/new_node_event', seconds, bag.new(
                    NEW_NODE, new_node_id=k, stamp=bag.time(seconds), pose=pose, **told))
            if k % 20 == 19:
                nodes = [bag.new(NODE, node_id=n, pose=bag.pose(rng.normal(size=3)))
                         for n in range(k + 1)]
                bag.write('/slam_toolbox/loop_closure_event', seconds,
                          bag.new(CLOSED, stamp=bag.time(seconds)))
                bag.write('/slam_toolbox/pose_graph', seconds + 0.5, bag.new(
                    GRAPH, header=bag.header(seconds), nodes=nodes,
                    edges=[edge for edge in edges if edge.target_id <= k]))
    return path


def swarm_bag(path, graph, chain, definitions, robots=(80,)):
    """
    A recording of Swarm-SLAM: one graph, cut into robots of so many keyframes each.

    chain : (n, 3), the odometry
    """
    bag, factors = Recording(path, definitions), graph.between
    starts = np.cumsum((0, *robots))

    def whose(k):
        robot = int(np.searchsorted(starts, k, side='right')) - 1
        return robot, int(k - starts[robot])

    def measured(pose, success):
        if definitions is BARE:
            return {'transform': bag.transform(pose), 'success': success}
        covariance = np.diag([0.04, 0.04, 1.0, 1.0, 1.0, 0.01]).ravel()
        return {'success': success, 'pose': bag.new(
            'geometry_msgs/msg/PoseWithCovariance', pose=bag.pose(pose), covariance=covariance)}

    def loop(seconds, i, j, pose, success=True):
        (robot0, k0), (robot1, k1) = whose(i), whose(j)
        if robot0 == robot1:
            bag.write(f'/r{robot0}/cslam/intra_robot_loop_closure', seconds, bag.new(
                WITHIN, keyframe0_id=k0, keyframe1_id=k1, **measured(pose, success)))
        else:
            bag.write('/cslam/inter_robot_loop_closure', seconds, bag.new(
                BETWEEN, robot0_keyframe_id=k0, robot0_id=robot0, robot1_keyframe_id=k1,
                robot1_id=robot1, **measured(pose, success)))

    reset = {'tracking_reset': False} if definitions is FORK else {}
    with bag.writer:
        for k in range(graph.n_poses):
            robot, number = whose(k)
            bag.write(f'/r{robot}/cslam/keyframe_odom', 100 + k, bag.new(
                KEYFRAME, id=number, odom=bag.odometry(100 + k, chain[k]), **reset))
        for row in np.flatnonzero(~factors.is_odometry):
            loop(200 + row, *factors.pairs[row].tolist(), factors.measurement[row])
        loop(999, 2, 70, np.zeros(3), success=False)
    return path
