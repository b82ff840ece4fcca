# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Graphs of slam_toolbox and Swarm-SLAM: bags that rosbags writes by the packages' definitions."""

from types import SimpleNamespace

import numpy as np
import pytest
from messages import odometry
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import l1slam_ros as l1
from l1slam_ros.core.errors import FileError, MessageError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.noise import covariance_of
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.worlds.false_loops import random_false_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world, with_false_loops
from l1slam_ros.io.bags.reader import read_messages
from l1slam_ros.io.bags.topics import Topics
from l1slam_ros.io.formats import read_input
from l1slam_ros.io.graphs.robots import symbol
from l1slam_ros.io.messages.slam_toolbox import GRAPH, NEW_NODE, SlamToolbox
from l1slam_ros.io.messages.swarm_slam import BETWEEN, KEYFRAME, WITHIN, SwarmSlam

SECOND = 10**9
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
SIGMA = 0.02


class Recording:
    """A bag under way, written by rosbags alone."""

    def __init__(self, path, definitions):
        self.types = get_typestore(Stores.ROS2_JAZZY)
        self.types.register({name: fields for key, text in definitions.items()
                             for name, fields in get_types_from_msg(text, key).items()})
        self.path, self._connections = path, {}
        self.writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)

    def new(self, name, **fields):
        return self.types.types[name](**fields)

    def write(self, topic, seconds, message):
        if topic not in self._connections:
            self._connections[topic] = self.writer.add_connection(
                topic, message.__msgtype__, typestore=self.types)
        self.writer.write(self._connections[topic], round(seconds * SECOND),
                          self.types.serialize_cdr(message, message.__msgtype__))

    def time(self, seconds):
        return self.new('builtin_interfaces/msg/Time', sec=int(seconds), nanosec=0)

    def header(self, seconds):
        return self.new('std_msgs/msg/Header', stamp=self.time(seconds), frame_id='map')

    def pose(self, pose, name='Pose', position='position', rotation='orientation',
             vector='Point'):
        x, y, z, *q = se2.to_pose3(np.array(pose)[None])[0].tolist()
        turn = dict(zip('xyzw', q, strict=True))
        return self.new(f'geometry_msgs/msg/{name}', **{
            position: self.new(f'geometry_msgs/msg/{vector}', x=x, y=y, z=z),
            rotation: self.new('geometry_msgs/msg/Quaternion', **turn)})

    def transform(self, pose):
        return self.pose(pose, 'Transform', 'translation', 'rotation', 'Vector3')

    def odometry(self, seconds, pose):
        x, y, z, *q = se2.to_pose3(np.array(pose)[None])[0].tolist()
        return odometry(self.new, self.header(seconds), position=(x, y, z), quaternion=q,
                        covariance=np.zeros(36))


@pytest.fixture(scope='module')
def world():
    """A drive through streets with 5 false loops among its loops."""
    rng = np.random.default_rng(3)
    world = simulate_world(80, 130, WorldOptions(
        odometry_sigma_translation=SIGMA, loop_sigma_translation=2 * SIGMA), rng)
    return with_false_loops(world, random_false_loops(world.graph, world.truth, 5, rng))


def g2o_of(world, path):
    l1.write_graph(path, world.graph, world.odometry)
    return path


def edge_message(bag, factors, row):
    """An edge as slam_toolbox has it: its covariance in the axes of the source."""
    i, j = factors.pairs[row].tolist()
    pose = factors.measurement[row]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    covariance = turn @ covariance_of(factors.sqrt_information[row][None])[0] @ turn.T
    flat = 'Pose2D' in str(bag.types.fielddefs[EDGE])
    relative = bag.new('geometry_msgs/msg/Pose2D', x=pose[0], y=pose[1],
                       theta=pose[2]) if flat else bag.pose(pose)
    return bag.new(EDGE, source_id=i, target_id=j, relative_pose=relative,
                   covariance=covariance.ravel())


def toolbox_bag(path, graph, definitions, rng):
    """A recording of slam_toolbox: an event a node, its whole graph now and then, nodes moving."""
    bag, factors = Recording(path, definitions), graph.between
    edges = [edge_message(bag, factors, row) for row in range(len(factors))]
    nothing = bag.new(EDGE, source_id=0, target_id=0, covariance=np.zeros(9), relative_pose=type(
        edges[0].relative_pose)(**vars(edges[0].relative_pose)))
    with bag.writer:
        for k in range(graph.n_poses):
            seconds = 100 + k
            into = [edge for edge in edges if edge.target_id == k]
            told = {'edges': into} if definitions is POSE else {'edge': (into or [nothing])[-1]}
            bag.write('/slam_toolbox/new_node_event', seconds, bag.new(
                NEW_NODE, new_node_id=k, stamp=bag.time(seconds),
                pose=bag.pose(rng.normal(size=3)), **told))
            if k % 20 == 19:
                nodes = [bag.new(NODE, node_id=n, pose=bag.pose(rng.normal(size=3)))
                         for n in range(k + 1)]
                bag.write('/slam_toolbox/loop_closure_event', seconds,
                          bag.new(CLOSED, stamp=bag.time(seconds)))
                bag.write('/slam_toolbox/pose_graph', seconds + 0.5, bag.new(
                    GRAPH, header=bag.header(seconds), nodes=nodes,
                    edges=[edge for edge in edges if edge.target_id <= k]))
    return path


@pytest.fixture(scope='module', params=[POSE2D, POSE], ids=['Pose2D', 'Pose'])
def toolbox(request, tmp_path_factory, world):
    return toolbox_bag(tmp_path_factory.mktemp('toolbox') / 'bag', world.graph, request.param,
                       np.random.default_rng(1))


def same_factors(found, expected):
    """Whether two graphs have the same factors, in any order."""
    def rows(graph):
        f = graph.between
        return np.lexsort((f.j, f.i, ~f.is_odometry))
    f = found.between
    e = expected.between
    a = rows(found)
    b = rows(expected)
    assert f.pairs[a].tolist() == e.pairs[b].tolist()
    assert f.is_odometry[a].tolist() == e.is_odometry[b].tolist()
    assert np.allclose(f.measurement[a], e.measurement[b], atol=1e-12)
    assert np.allclose(f.sqrt_information[a], e.sqrt_information[b], rtol=1e-9)


@pytest.mark.parametrize('topics', [Topics(), Topics(odometry='/slam_toolbox/pose_graph')])
def test_slam_toolboxs_graph_is_taken_as_it_was_measured(toolbox, world, topics):
    """Each edge once, whatever the nodes' own poses; nobody has to name a topic."""
    record = read_input(toolbox, topics=topics)
    assert record.ids.tolist() == list(range(80)) and not record.skipped and not record.damage
    same_factors(record.graph, world.graph)


def test_slam_toolboxs_graph_makes_the_map_of_its_g2o_file(toolbox, world, tmp_path):
    expected = l1.solve(l1.read_graph(g2o_of(world, tmp_path / 'w.g2o'))[0])
    graph = l1.read_graph(toolbox)[0]
    found = l1.solve(graph)
    assert np.allclose(found.poses, expected.poses, atol=1e-6)
    refused = graph.between.pairs[~found.inliers]
    assert len(refused) == 5 == np.count_nonzero(~expected.inliers)


def loops_of(graphs, messages):
    found = [one for message in messages for one in graphs.take(message.data, message.topic)]
    return ([one for one in found if isinstance(one, LoopClosure)],
            [one.cause for one in found if isinstance(one, MessageError)])


def test_slam_toolboxs_loops_have_the_times_of_its_nodes(toolbox, world):
    names = ['/slam_toolbox/new_node_event', '/slam_toolbox/pose_graph']
    loops, errors = loops_of(SlamToolbox(), read_messages(toolbox, names))
    factors = world.graph.between
    pairs = np.sort(factors.pairs[~factors.is_odometry], axis=1)
    assert sorted(loop.stamps for loop in loops) == sorted(
        tuple((100 + pair) * SECOND for pair in ends) for ends in pairs.tolist())
    assert not errors
    # Without the events nobody knows when the nodes were: no loop is given a time.
    loops, errors = loops_of(SlamToolbox(), read_messages(toolbox, names[1:]))
    assert not loops and errors == ['keyframe'] * len(pairs)


def test_a_slam_toolbox_that_begins_anew_has_a_graph_of_its_own():
    graphs = SlamToolbox()

    def event(node, seconds, source):
        pose = SimpleNamespace(x=1.0, y=0.0, theta=0.0)
        edge = SimpleNamespace(source_id=source, target_id=node, relative_pose=pose,
                               covariance=np.eye(3).ravel())
        return SimpleNamespace(new_node_id=node, edge=edge,
                               stamp=SimpleNamespace(sec=seconds, nanosec=0))

    for seconds in 10, 50:
        for node in range(4):
            assert not list(graphs.take(event(node, seconds + node, max(node - 1, 0))))
        (loop,) = graphs.take(event(0, seconds, 3))
        assert loop.stamps == (seconds * SECOND, (seconds + 3) * SECOND)


def swarm_bag(path, graph, definitions, robots=(80,)):
    """A recording of Swarm-SLAM: one graph, cut into robots of so many keyframes each."""
    bag, factors = Recording(path, definitions), graph.between
    starts = np.cumsum((0, *robots))
    chain = se2.identity(graph.n_poses)
    for k in range(1, graph.n_poses):
        step = factors.measurement[np.flatnonzero(factors.is_odometry & (factors.j == k))]
        chain[k] = se2.compose(chain[k - 1 : k], step)[0]

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


@pytest.mark.parametrize('definitions', [BARE, FORK], ids=['transform', 'covariance'])
@pytest.mark.parametrize('robots', [(80,), (50, 30)])
def test_swarm_slams_robots_have_one_graph(tmp_path, world, definitions, robots):
    path = swarm_bag(tmp_path / 'bag', world.graph, definitions, robots)
    record = read_input(path)
    factors = record.graph.between
    ids = [symbol(chr(ord('a') + robot), k) for robot, n in enumerate(robots) for k in range(n)]
    assert record.ids.tolist() == ids and not record.skipped and not record.damage
    of_world = world.graph.between
    expected = {tuple(pair): pose for pair, pose in zip(
        of_world.pairs.tolist(), of_world.measurement, strict=True)}
    if len(robots) > 1:
        del expected[49, 50]
    assert {tuple(pair) for pair in factors.pairs.tolist()} == expected.keys()
    for pair, pose in zip(factors.pairs.tolist(), factors.measurement, strict=True):
        assert np.allclose(se2.local(expected[tuple(pair)][None], pose[None]), 0, atol=1e-9)
    assert np.count_nonzero(factors.is_odometry) == 80 - len(robots)
    sigma = 1 / np.diagonal(factors.sqrt_information, axis1=1, axis2=2)[~factors.is_odometry]
    assert np.allclose(sigma, (0.1, 0.1, 0.05) if definitions is BARE else (0.2, 0.2, 0.1))


@pytest.mark.parametrize('robots', [(80,), (50, 30)])
def test_swarm_slams_graph_makes_the_map_of_its_g2o_file(tmp_path, world, robots):
    """The same numbers as text, by the symbols of GTSAM; the models' information in both."""
    record = read_input(swarm_bag(tmp_path / 'bag', world.graph, BARE, robots))
    f = record.graph.between
    lines = []
    for pair, (x, y, heading), root in zip(record.ids[f.pairs].tolist(), f.measurement.tolist(),
                                           f.sqrt_information, strict=True):
        numbers = (root.T @ root)[np.triu_indices(3)]
        lines.append(' '.join(map(repr, ['EDGE_SE2', *pair, x, y, heading, *numbers.tolist()])
                              ).replace("'", ''))
    (tmp_path / 'w.g2o').write_text('\n'.join(lines))
    expected = l1.solve(l1.read_graph(tmp_path / 'w.g2o')[0])
    found = l1.solve(record.graph)
    assert np.allclose(found.poses, expected.poses, atol=1e-6)
    assert np.count_nonzero(~found.inliers) == np.count_nonzero(~expected.inliers) >= 5


def test_one_robot_of_swarm_slam_and_loops_alone(tmp_path, world):
    """A topic that is named stands for its robot; where the odometry is another's, loops count."""
    path = swarm_bag(tmp_path / 'bag', world.graph, BARE, (50, 30))
    record = read_input(path, topics=Topics(odometry='/r1/cslam/keyframe_odom'))
    assert record.ids.tolist() == [symbol('b', k) for k in range(30)]
    loops, errors = loops_of(SwarmSlam(), read_messages(path))
    between = sum(i < 50 <= j or j < 50 <= i
                  for i, j in world.graph.between.pairs.tolist()) - 1
    assert errors == ['robot'] * between and between > 0
    assert all(loop.stamp > loop.reference_stamp >= 100 * SECOND for loop in loops)
    with pytest.raises(FileError, match=f'0 keyframes from /none; .*{WITHIN} is on /r0/cslam'):
        read_input(path, topics=Topics(odometry='/none'))


def test_the_node_takes_their_loops(tmp_path, toolbox, world, ros):
    """Beside odometry from elsewhere; loops between robots are counted."""
    node = pytest.importorskip('l1slam_ros.ros.node').BackendNode()
    try:
        path = swarm_bag(tmp_path / 'bag', world.graph, BARE, (50, 30))
        swarm, graphs = SwarmSlam(), SlamToolbox()
        for message in read_messages(toolbox):
            if not message.topic.endswith('loop_closure_event'):
                node._inputs._on_pose_graph(graphs, message.data)
        factors = world.graph.between
        count = np.count_nonzero(~factors.is_odometry)
        assert len(node._backend.loop_states().stamps) == count
        for message in read_messages(path, ['/r0/cslam/keyframe_odom',
                                            '/cslam/inter_robot_loop_closure']):
            node._inputs._on_pose_graph(swarm, message.data)
        assert node._inputs.refused['robot'] > 0
        assert len(node._backend.loop_states().stamps) == count
    finally:
        node.close()
