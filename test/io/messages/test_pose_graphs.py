# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Pose graphs of other front ends, in their own messages: from bags, and by the node's reader."""

import numpy as np
import pytest
from command import run
from messages import odometry, of_rosbags
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from l1slam_ros.core.errors import FileError, MessageError
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.io.bags.reader import read_messages
from l1slam_ros.io.bags.topics import Topics
from l1slam_ros.io.bags.writer import new_bag
from l1slam_ros.io.formats import read_input
from l1slam_ros.io.messages.pose_graphs import MAP_GRAPH, POSE_GRAPH, PoseGraphs

SECOND = 10**9
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


def header(seconds):
    stamp = M['builtin_interfaces/msg/Time'](int(seconds), round(seconds % 1 * SECOND))
    return M['std_msgs/msg/Header'](stamp, 'map')


def parts(pose):
    """Return position and orientation of a pose (1, 3) in the plane."""
    numbers = se2.to_pose3(pose)[0].tolist()
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
        i, j, kind, transform(se2.between(truth[i - 1][None], truth[j - 1][None])),
        np.linalg.inv(covariance).ravel())


def map_graph(seconds, ids, links):
    return M[MAP_GRAPH](header(seconds), transform(np.zeros((1, 3))), np.array(ids, np.int32),
                        [pose_message(np.zeros((1, 3)))] * len(ids), links)


def edge(i, j, kind, truth, covariance=COVARIANCE, robots=(0, 0)):
    return M['pose_graph_tools_msgs/msg/PoseGraphEdge'](
        header(0), i, j, *robots, kind,
        pose_message(se2.between(truth[i - 1][None], truth[j - 1][None])), covariance.ravel())


def pose_graph(seconds, keys, edges, robot=0):
    nodes = [M['pose_graph_tools_msgs/msg/PoseGraphNode'](
        header(time), robot, key, pose_message(np.zeros((1, 3)))) for key, time in keys]
    return M[POSE_GRAPH](header(seconds), nodes, edges)


@pytest.fixture
def truth(rng):
    return rng.normal(size=(6, 3))


def taken(graphs, message):
    found = list(graphs.take(message))
    return ([one for one in found if isinstance(one, LoopClosure)],
            [one.cause for one in found if isinstance(one, MessageError)])


def growing(truth, closing):
    """Return the graphs of a robot whose keyframe k + 1 is of 10 + k s, with links at the end."""
    links, messages = [], []
    for k in range(1, 7):
        links = links + ([link(k - 1, k, NEIGHBOUR, truth)] if k > 1 else [])
        messages.append(map_graph(9 + k, range(1, k + 1), links + (closing if k == 6 else [])))
    return messages


@pytest.mark.parametrize('ends', [(1, 6), (6, 1)])
def test_a_link_is_a_loop_between_the_times_of_its_keyframes(truth, ends):
    """Whichever way it points: the later keyframe seen from the earlier, its noise in its axes."""
    graphs, loops = PoseGraphs(), []
    for message in growing(truth, [link(*ends, GLOBAL, truth)]):
        found, errors = taken(graphs, message)
        loops += found
        assert not errors
    (loop,) = loops
    assert (loop.reference_stamp, loop.stamp, loop.trusted) == (10 * SECOND, 15 * SECOND, False)
    expected = se2.between(truth[:1], truth[5:])
    assert np.allclose(se2.from_pose3(loop.pose3[None]), expected)
    Ad = se3.adjoint(se3.from_pose3(se2.to_pose3(se2.inverse(expected))))[0]
    turned = COVARIANCE if ends == (1, 6) else Ad @ COVARIANCE @ Ad.T
    assert np.allclose(loop.covariance, turned)
    # It is repeated in every message from then on.
    assert taken(graphs, growing(truth, [link(*ends, GLOBAL, truth)])[-1]) == ([], [])


def test_only_what_was_measured_between_two_keyframes_is_a_loop(truth):
    closing = [link(6, 1, VIRTUAL, truth), link(6, 6, PRIOR, truth), link(6, 2, LANDMARK, truth)]
    graphs = PoseGraphs()
    assert all(taken(graphs, message) == ([], []) for message in growing(truth, closing))


def test_a_keyframe_of_unknown_time_is_never_given_one(truth):
    """Who listens late knows the newest alone; what begins anew has its numbers again."""
    graphs, messages = PoseGraphs(), growing(truth, [link(6, 1, GLOBAL, truth)])
    assert taken(graphs, messages[-1]) == ([], ['keyframe'])
    assert taken(graphs, messages[-1]) == ([], [])
    later = map_graph(16, range(1, 8), [link(6, 2, GLOBAL, truth), link(6, 5, GLOBAL, truth)])
    assert taken(graphs, later)[1] == ['keyframe', 'keyframe']
    graphs = PoseGraphs()
    for message in messages:
        taken(graphs, message)
    anew = [map_graph(100 + k, range(1, k + 2), []) for k in range(5)]
    closing = [link(6, 3, GLOBAL, truth), link(6, 1, GLOBAL, truth)]
    anew.append(map_graph(105, range(1, 7), closing))
    found = [taken(graphs, message) for message in anew]
    (loop,), errors = found[-1]
    assert loop.stamps == (102 * SECOND, 105 * SECOND) and errors == ['keyframe']


def test_a_pose_graph_tells_the_times_and_whose_they_are(truth):
    keys = [(k, 10.5 + k) for k in range(1, 7)]
    graphs = PoseGraphs()
    unset = np.full((6, 6), -1.0)
    loops, errors = taken(graphs, pose_graph(20, keys, [
        edge(1, 2, ODOM, truth), edge(1, 5, LOOPCLOSE, truth), edge(2, 6, LOOPCLOSE, truth, unset),
        edge(1, 4, REJECTED, truth), edge(3, 6, LOOPCLOSE, truth, robots=(0, 1))]))
    assert [loop.stamps for loop in loops] == [
        (round(11.5 * SECOND), round(15.5 * SECOND)), (round(12.5 * SECOND), round(16.5 * SECOND))]
    assert np.allclose(loops[0].covariance, COVARIANCE) and (loops[1].covariance == unset).all()
    assert not errors
    # The second message adds to the first; another robot's graph is not ours.
    loops, errors = taken(graphs, pose_graph(21, [], [edge(6, 3, LOOPCLOSE, truth)]))
    assert [loop.stamps for loop in loops] == [(round(13.5 * SECOND), round(16.5 * SECOND))]
    assert taken(graphs, pose_graph(22, [(9, 30.0)], [
        edge(1, 6, LOOPCLOSE, truth, robots=(1, 1))], robot=1)) == ([], [])


@pytest.fixture
def bag(tmp_path, truth):
    """A bag with odometry, and the graphs of RTAB-Map and of pose_graph_tools."""
    with new_bag(tmp_path / 'bag', {}) as writer:
        types = writer._typestore
        types.register(FIELDS)

        def write(topic, seconds, message):
            writer.write(topic, seconds * SECOND,
                         bytes(types.serialize_cdr(message, message.__msgtype__)))

        writer.add_topic('/odom', 'nav_msgs/msg/Odometry')
        writer.add_topic('/rtabmap/mapGraph', MAP_GRAPH)
        writer.add_topic('/kimera/pose_graph', POSE_GRAPH)
        closing = [link(6, 1, GLOBAL, truth)]
        for k, message in enumerate(growing(truth, closing)):
            numbers = se2.to_pose3(se2.between(truth[:1], truth[k : k + 1]))[0].tolist()
            write('/odom', 10 + k, odometry(
                of_rosbags, header(10 + k), position=numbers[:3], quaternion=numbers[3:],
                covariance=np.zeros(36)))
            write('/rtabmap/mapGraph', 10 + k, message)
        write('/kimera/pose_graph', 20, pose_graph(
            20, [(k, 9.0 + k) for k in range(1, 7)],
            [edge(k, k + 1, ODOM, truth) for k in range(1, 6)] + [edge(1, 6, LOOPCLOSE, truth)]))
    return tmp_path / 'bag'


@pytest.mark.parametrize('topic', ['/rtabmap/mapGraph', '/kimera/pose_graph'])
def test_from_a_bag_come_the_loops_or_the_whole_graph(bag, truth, topic):
    """The definitions are those in the bag: no package is installed that knows them."""
    graph = read_input(bag, topics=Topics(loops=topic)).graph
    loops = graph.between.pairs[~graph.between.is_odometry]
    assert loops.tolist() == [[0, graph.n_poses - 1]]
    whole = read_input(bag, topics=Topics(odometry=topic))
    factors = whole.graph.between
    assert whole.ids.tolist() == [1, 2, 3, 4, 5, 6] and not whole.skipped
    assert factors.is_odometry.tolist() == [True] * 5 + [False]
    assert np.allclose(se2.residual(factors.measurement, truth[factors.i], truth[factors.j]), 0)
    sigma = 1 / np.diagonal(factors.sqrt_information, axis1=1, axis2=2)
    assert np.allclose(sigma, SIGMA[[0, 1, 5]])


@pytest.mark.parametrize('keys', [(6, 2**63), (2**64 - 1, 2**63)])
def test_a_key_beyond_63_bits_is_one_line(capsys, tmp_path, truth, keys):
    truth = {k - 1: pose for k, pose in enumerate(truth, 1)} | {
        key - 1: truth[0] for key in keys[-1:] + keys[:1] if key > 6}
    with new_bag(tmp_path / 'bag', {}) as writer:
        types = writer._typestore
        types.register(FIELDS)
        writer.add_topic('/pose_graph', POSE_GRAPH)
        message = pose_graph(20, [(k, 9.0) for k in (*range(1, 7), *keys)], [
            *(edge(k, k + 1, ODOM, truth) for k in range(1, 6)), edge(*keys, LOOPCLOSE, truth)])
        writer.write('/pose_graph', SECOND, bytes(types.serialize_cdr(message, POSE_GRAPH)))
    out, _ = run(capsys, 'info', tmp_path / 'bag', '--odom-topic', '/pose_graph', code=3)
    assert 'poses       6 in SE2, ids 1 to 6' in out
    assert f'an edge of keyframe {max(keys)}; expected numbers up to 2^63 - 1' in out
    _, errors = taken(PoseGraphs(), message)
    assert errors == ['number']


def test_who_read_no_loops_is_told_of_the_graphs(bag):
    assert read_input(bag).damage == (
        'no loop is in the map, but there are loops in 1 message on /kimera/pose_graph and 6 '
        'messages on /rtabmap/mapGraph; expected --loop-topic /kimera/pose_graph or --loop-topic '
        '/rtabmap/mapGraph')
    for topics in (Topics(loops='/rtabmap/mapGraph'), Topics(odometry='/rtabmap/mapGraph'),
                   Topics(odometry='/kimera/pose_graph')):
        assert read_input(bag, topics=topics).damage == ''


def test_who_has_no_odometry_is_told_of_the_graph(bag):
    with pytest.raises(FileError, match=f'0 keyframes from /none; .*{MAP_GRAPH} is on /rtabmap'):
        read_input(bag, topics=Topics(odometry='/none'))


def test_the_node_reads_them_too(bag, ros):
    node = pytest.importorskip('l1slam_ros.ros.node').BackendNode()
    try:
        graphs = PoseGraphs()
        for message in read_messages(bag, ['/rtabmap/mapGraph']):
            node._inputs._on_pose_graph(graphs, message.data)
        assert node._backend.loop_states().stamps.tolist() == [[10 * SECOND, 15 * SECOND]]
    finally:
        node.close()
