# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""GPS through the real node: the map comes to the world, and jumps of it are refused."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from fixes import seen
from geometry_msgs.msg import PoseWithCovarianceStamped
from node_bench import EVERY_MESSAGE, call, odometry, poses_of

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.running.snapshot import ACCEPTED
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.bags.from_graph import write_graph_bag
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.ros.shell.header import header


def fix(stamp, position, frame='map', variance=0.01):
    message = PoseWithCovarianceStamped(header=header(frame, stamp))
    message.pose.pose.position.x, message.pose.pose.position.y = position
    message.pose.covariance = np.diag([variance, variance, 0, 0, 0, 0.0]).ravel()
    return message


def test_a_world_seen_by_gps_is_saved_and_goes_on(bench, tmp_path):
    rng = np.random.default_rng(5)
    made = simulate_world(200, 300, WorldOptions(), rng)
    world = seen(made.graph, made.truth, 10, rng, 0.1, sigma=0.2)
    write_graph_bag(tmp_path / 'bag', GraphRecord(world.graph, None, np.arange(200)))
    b = bench(save_path=str(tmp_path / 'map.g2o'), **EVERY_MESSAGE)
    b.play(tmp_path / 'bag')
    b.until(lambda: len(b.path().poses) == 200, 'all keyframes')
    node = b.backend._backend

    def refused():
        now = node.snapshot()
        states, factors = now.loop_states(), now.graph.between
        return sorted(factors.j[states.rows[states.state != ACCEPTED]].tolist())

    b.until(lambda: refused() == world.false.tolist(), 'the false ones are refused, no others')
    assert call(b, 'optimize').success and refused() == world.false.tolist()
    assert world.error(node.poses) < 0.6
    b.until(lambda: world.error(poses_of(b.path())) < 0.6, 'the Path is in the world')
    before = node.poses
    assert call(b, 'save').success and call(b, 'reset').success and call(b, 'load').success
    np.testing.assert_allclose(node.poses, before)
    b.until(lambda: refused() == world.false.tolist(), 'they are judged anew')
    # The robot drives ten metres on, straight ahead, and GPS sees it there.
    last = before[-1]
    for k in range(12):
        b.send('/odom', odometry((2000 + k) * 10**9, 1.0 * k))
    there = se2.compose(last[None], np.array([[11.0, 0.0, 0.0]]))[0]
    b.send('/absolute_poses', fix(2011 * 10**9, there[:2].tolist()))
    b.until(lambda: len(node.loop_states().state) == 21 and node.loop_states().state[-1]
            == ACCEPTED, 'the new one is believed')
    assert np.hypot(*(node.poses[-1] - there)[:2]) < 1.0


def test_what_is_not_of_the_map_frame_or_says_nothing_is_counted(bench):
    b = bench()
    b.send('/odom', odometry(10**9, 0.0))
    b.send('/odom', odometry(2 * 10**9, 1.0))
    for message in (fix(10**9, (1.0, 2.0), 'odom'), fix(10**9, (1.0, 2.0), ''),
                    fix(10**9, (1.0, 2.0), variance=0.0)):
        b.send('/absolute_poses', message)
    b.send('/absolute_poses', fix(2 * 10**9, (30.0, 2.0)))
    b.until(lambda: b.status()[2].get('refused.frame') == '2', 'those of other frames are counted')
    b.until(lambda: b.status()[2].get('refused.covariance') == '1', 'so is what says nothing')
    b.until(lambda: b.path().poses and b.path().poses[-1].pose.position.x == pytest.approx(30),
            'the one that is left puts the map in its place')
