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
from node_bench import EVERY_MESSAGE, call, header, odometry, poses_of, stamp_of
from worlds import compose, made, truth_of

import l1slam_ros as l1


def fix(stamp, position, frame='map', variance=0.01):
    message = PoseWithCovarianceStamped(header=header(frame, stamp))
    message.pose.pose.position.x, message.pose.pose.position.y = position
    message.pose.covariance = np.diag([variance, variance, 0, 0, 0, 0.0]).ravel()
    return message


def test_a_world_seen_by_gps_is_saved_and_goes_on(bench, tmp_path):
    rng = np.random.default_rng(5)
    path = made(tmp_path / 'world.g2o', 200, 300, '--seed', 5)
    graph, poses = l1.read_graph(path)
    world = seen(graph, truth_of(path), 10, rng, 0.1, sigma=0.2)
    l1.write_graph(tmp_path / 'bag', world.graph, poses)
    b = bench(save_path=str(tmp_path / 'map.g2o'), **EVERY_MESSAGE)
    b.play(tmp_path / 'bag')
    keyframes = [stamp_of(pose.header) for pose in b.map_of(200).poses]

    def refused():
        ends = {end for (_, end), (state, _) in b.loops().items() if state != 'accepted'}
        return sorted(map(keyframes.index, ends))

    b.until(lambda: len(b.loops()) == 20 and refused() == world.false.tolist(),
            'the false ones are refused, no others')
    assert call(b, 'optimize').success
    b.until(lambda: world.error(poses_of(b.path())) < 0.6, 'the Path is in the world')
    assert refused() == world.false.tolist()
    assert call(b, 'save').success and call(b, 'reset').success
    b.map_of(0)
    b.received['loop_status'].clear()
    assert call(b, 'load').success
    _, before = l1.read_graph(tmp_path / 'map.g2o')
    np.testing.assert_allclose(poses_of(b.map_of(200)), before, atol=1e-6)
    b.until(lambda: len(b.loops()) == 20 and refused() == world.false.tolist(),
            'they are judged anew')
    # The robot drives ten metres on, straight ahead, and GPS sees it there.
    last = before[-1]
    for k in range(12):
        b.send('/odom', odometry((2000 + k) * 10**9, 1.0 * k))
    there = compose(last, np.array([11.0, 0.0, 0.0]))
    b.send('/absolute_poses', fix(2011 * 10**9, there[:2].tolist()))
    b.until(lambda: [state for (_, end), (state, _) in b.loops().items() if end == 2011 * 10**9]
            == ['accepted'], 'the new one is believed')
    assert len(b.loops()) == 21
    b.until(lambda: stamp_of(b.path().poses[-1].header) == 2011 * 10**9 and np.hypot(
        *(poses_of(b.path())[-1] - there)[:2]) < 1.0, 'the Path is there')


def test_what_is_not_of_the_map_frame_or_says_nothing_is_counted(bench):
    b = bench()
    b.send('/odom', odometry(10**9, 0.0))
    b.send('/odom', odometry(2 * 10**9, 1.0))
    for message in (fix(10**9, (1.0, 2.0), 'odom'), fix(10**9, (1.0, 2.0), ''),
                    fix(10**9, (1.0, 2.0), variance=0.0)):
        b.send('/absolute_poses', message)
    b.send('/absolute_poses', fix(2 * 10**9, (30.0, 2.0)))
    b.until(lambda: b.refused() == {'frame': 2, 'covariance': 1}, 'they are counted')
    b.until(lambda: b.path().poses and b.path().poses[-1].pose.position.x == pytest.approx(30),
            'the one that is left puts the map in its place')
