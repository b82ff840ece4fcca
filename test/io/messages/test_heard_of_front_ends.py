# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What is heard of slam_toolbox and Swarm-SLAM one by one, as by the node."""

from types import SimpleNamespace

import numpy as np
import pytest
from front_ends import BARE, POSE, POSE2D, SECOND, swarm_bag, toolbox_bag
from records import read
from worlds import made

import l1slam_ros as l1
from l1slam_ros.core.errors import MessageError
from l1slam_ros.io.bags.reader import read_messages
from l1slam_ros.io.messages.slam_toolbox import SlamToolbox
from l1slam_ros.io.messages.swarm_slam import SwarmSlam


@pytest.fixture(scope='module')
def world(tmp_path_factory):
    """Return a drive through streets with 5 false loops among its loops."""
    path = tmp_path_factory.mktemp('world') / 'w.g2o'
    return read(made(path, 80, 130, '--false-loops', 5, '--seed', 3))


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


def loops_of(graphs, messages):
    found = [one for message in messages for one in graphs.take(message.data, message.topic)]
    return ([one for one in found if isinstance(one, l1.LoopClosure)],
            [one.cause for one in found if isinstance(one, MessageError)])


def test_where_the_odometry_is_anothers_loops_of_swarm_slam_count(tmp_path, world):
    path = swarm_bag(tmp_path / 'bag', world.graph, world.poses, BARE, (50, 30))
    loops, errors = loops_of(SwarmSlam(), read_messages(path))
    between = sum(i < 50 <= j or j < 50 <= i
                  for i, j in world.graph.between.pairs.tolist()) - 1
    assert errors == ['robot'] * between and between > 0
    assert all(loop.stamp > loop.reference_stamp >= 100 * SECOND for loop in loops)


@pytest.fixture(scope='module', params=[POSE2D, POSE], ids=['Pose2D', 'Pose'])
def toolbox(request, tmp_path_factory, world):
    return toolbox_bag(tmp_path_factory.mktemp('toolbox') / 'bag', world.graph, request.param,
                       np.random.default_rng(1))


def test_the_node_takes_their_loops(tmp_path, toolbox, world, ros):
    """Beside odometry from elsewhere; loops between robots are counted."""
    node = pytest.importorskip('l1slam_ros.ros.node').BackendNode()
    try:
        path = swarm_bag(tmp_path / 'bag', world.graph, world.poses, BARE, (50, 30))
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
