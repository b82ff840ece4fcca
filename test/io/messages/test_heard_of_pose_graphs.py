# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What is heard of the pose graphs of others one by one, as by the node."""

import numpy as np
import pytest
from pose_graphs import (
    COVARIANCE,
    GLOBAL,
    LOOPCLOSE,
    ODOM,
    REJECTED,
    SECOND,
    driven,
    edge,
    growing,
    link,
    map_graph,
    pose_graph,
    write,
)

import l1slam_ros as l1
from l1slam_ros.core.errors import MessageError
from l1slam_ros.io.bags.reader import read_messages
from l1slam_ros.io.messages.pose_graphs import PoseGraphs


@pytest.fixture
def truth(rng):
    return rng.normal(size=(6, 3))


def taken(graphs, message):
    found = list(graphs.take(message))
    return ([one for one in found if isinstance(one, l1.LoopClosure)],
            [one.cause for one in found if isinstance(one, MessageError)])


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


@pytest.mark.parametrize('keys', [(6, 2**63), (2**64 - 1, 2**63)])
def test_a_key_beyond_63_bits_is_refused_by_its_cause(truth, keys):
    truth = {k - 1: pose for k, pose in enumerate(truth, 1)} | {
        key - 1: truth[0] for key in keys[-1:] + keys[:1] if key > 6}
    message = pose_graph(20, [(k, 9.0) for k in (*range(1, 7), *keys)], [
        *(edge(k, k + 1, ODOM, truth) for k in range(1, 6)), edge(*keys, LOOPCLOSE, truth)])
    assert taken(PoseGraphs(), message)[1] == ['number']


@pytest.fixture
def bag(tmp_path, truth):
    """A bag with odometry, and the graphs of RTAB-Map and of pose_graph_tools."""
    graphs = growing(truth, [link(6, 1, GLOBAL, truth)])
    return write(tmp_path / 'bag', [
        *driven(truth), *(('/rtabmap/mapGraph', 10 + k, graph) for k, graph in enumerate(graphs)),
        ('/kimera/pose_graph', 20, pose_graph(
            20, [(k, 9.0 + k) for k in range(1, 7)],
            [edge(k, k + 1, ODOM, truth) for k in range(1, 6)] + [edge(1, 6, LOOPCLOSE, truth)]))])


def test_the_node_reads_them_too(bag, ros):
    node = pytest.importorskip('l1slam_ros.ros.node').BackendNode()
    try:
        graphs = PoseGraphs()
        for message in read_messages(bag, ['/rtabmap/mapGraph']):
            node._inputs._on_pose_graph(graphs, message.data)
        assert node._backend.loop_states().stamps.tolist() == [[10 * SECOND, 15 * SECOND]]
    finally:
        node.close()
