# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Graphs of slam_toolbox and Swarm-SLAM: bags that rosbags writes by the packages' definitions."""

import numpy as np
import pytest
from front_ends import (
    BARE,
    EDGE,
    FORK,
    NEW_NODE,
    POSE,
    POSE2D,
    WITHIN,
    Recording,
    swarm_bag,
    toolbox_bag,
)
from records import read
from worlds import made

import l1slam_ros as l1


@pytest.fixture(scope='module')
def world(tmp_path_factory):
    """Return a drive through streets with 5 false loops among its loops."""
    path = tmp_path_factory.mktemp('world') / 'w.g2o'
    return read(made(path, 80, 130, '--false-loops', 5, '--seed', 3))


@pytest.fixture(scope='module', params=[POSE2D, POSE], ids=['Pose2D', 'Pose'])
def toolbox(request, tmp_path_factory, world):
    return toolbox_bag(tmp_path_factory.mktemp('toolbox') / 'bag', world.graph, request.param)


def same_factors(found, expected):
    """Whether two graphs have the same factors, in any order."""
    def rows(graph):
        f = graph.between
        return np.lexsort((f.j, f.i, ~f.is_odometry))
    f, e = found.between, expected.between
    a, b = rows(found), rows(expected)
    assert f.pairs[a].tolist() == e.pairs[b].tolist()
    assert f.is_odometry[a].tolist() == e.is_odometry[b].tolist()
    assert np.allclose(f.measurement[a], e.measurement[b], atol=1e-12)
    assert np.allclose(f.sqrt_information[a], e.sqrt_information[b], rtol=1e-9)


@pytest.mark.parametrize('topics', [{}, {'odom_topic': '/slam_toolbox/pose_graph'}])
def test_slam_toolboxs_graph_is_taken_as_it_was_measured(toolbox, world, topics):
    """Each edge once, whatever the nodes' own poses; nobody has to name a topic."""
    record = read(toolbox, **topics)
    assert record.ids.tolist() == list(range(80)) and not record.skipped
    same_factors(record.graph, world.graph)


@pytest.mark.parametrize('definitions', [POSE2D, POSE], ids=['Pose2D', 'Pose'])
def test_slam_toolboxs_loops_have_the_times_of_its_nodes(tmp_path, world, definitions):
    """Beside odometry from elsewhere, which is at the nodes when they were there."""
    factors = world.graph.between
    pairs = np.sort(factors.pairs[~factors.is_odometry], axis=1)
    bag = toolbox_bag(tmp_path / 'bag', world.graph, definitions, world.poses)
    record = read(bag, loop_topic='/slam_toolbox/pose_graph')
    found = record.graph.between
    assert record.graph.n_poses == 80 and record.skipped == ()
    assert sorted(found.pairs[~found.is_odometry].tolist()) == sorted(pairs.tolist())
    # Without the events nobody knows when the nodes were: no loop is given a time.
    bag = toolbox_bag(tmp_path / 'without', world.graph, definitions, world.poses,
                      events=False)
    record = read(bag, loop_topic='/slam_toolbox/pose_graph')
    assert record.graph.between.is_odometry.all()
    assert record.skipped[0].startswith(f'{len(pairs)} messages refused: a loop of keyframe ')
    assert 'whose stamp no message has given; expected a known keyframe' in record.skipped[0]


def test_a_slam_toolbox_that_begins_anew_has_a_graph_of_its_own(tmp_path):
    bag = Recording(tmp_path / 'bag', POSE2D)
    step = bag.new('geometry_msgs/msg/Pose2D', x=1.0, y=0.0, theta=0.0)
    with bag.writer:
        for start in 10, 50:
            for source, node, later in (0, 0, 0), (0, 1, 1), (1, 2, 2), (2, 3, 3), (3, 0, 3.5):
                if later == node:
                    bag.write('/odom', start + node, bag.odometry(start + node, (node, 0.0, 0.0)))
                edge = bag.new(EDGE, source_id=source, target_id=node, relative_pose=step,
                               covariance=np.eye(3).ravel())
                bag.write('/events', start + later, bag.new(
                    NEW_NODE, new_node_id=node, stamp=bag.time(start + node),
                    pose=bag.pose(np.zeros(3)), edge=edge))
    record = read(tmp_path / 'bag', loop_topic='/events')
    loops = record.graph.between.pairs[~record.graph.between.is_odometry]
    assert sorted((record.stamps[loops] // 10**9).tolist()) == [[10, 13], [50, 53]]


@pytest.mark.parametrize('definitions', [BARE, FORK], ids=['transform', 'covariance'])
@pytest.mark.parametrize('robots', [(80,), (50, 30)])
def test_swarm_slams_robots_have_one_graph(tmp_path, world, definitions, robots):
    path = swarm_bag(tmp_path / 'bag', world.graph, world.poses, definitions, robots)
    record = read(path)
    factors = record.graph.between
    ids = [(ord('a') + robot << 56) + k for robot, n in enumerate(robots) for k in range(n)]
    assert record.ids.tolist() == ids and not record.skipped
    of_world, local = world.graph.between, world.graph.manifold.local
    expected = {tuple(pair): pose for pair, pose in zip(
        of_world.pairs.tolist(), of_world.measurement, strict=True)}
    if len(robots) > 1:
        del expected[49, 50]
    assert {tuple(pair) for pair in factors.pairs.tolist()} == expected.keys()
    for pair, pose in zip(factors.pairs.tolist(), factors.measurement, strict=True):
        assert np.allclose(local(expected[tuple(pair)][None], pose[None]), 0, atol=1e-9)
    assert np.count_nonzero(factors.is_odometry) == 80 - len(robots)
    sigma = 1 / np.diagonal(factors.sqrt_information, axis1=1, axis2=2)[~factors.is_odometry]
    assert np.allclose(sigma, (0.1, 0.1, 0.05) if definitions is BARE else (0.2, 0.2, 0.1))


def test_of_swarm_slam_a_topic_that_is_named_stands_for_its_robot(tmp_path, world):
    path = swarm_bag(tmp_path / 'bag', world.graph, world.poses, BARE, (50, 30))
    record = read(path, odom_topic='/r1/cslam/keyframe_odom')
    assert record.ids.tolist() == [(ord('b') << 56) + k for k in range(30)]
    with pytest.raises(l1.L1SlamError, match=f'0 keyframes from /none; .*{WITHIN} is on /r0/csl'):
        l1.read_graph(path, odom_topic='/none')
