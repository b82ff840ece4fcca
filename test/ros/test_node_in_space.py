# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The node in space, fed as lidar and inertial front ends do it."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_bench import call

from l1slam_ros.core.geometry import se3
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.ros.shell.header import header

NS = 10**9
KEYFRAMES = 60
LOOPS = 20
PLANAR = np.diag([0.0025, 0.0025, 0, 0, 0, 1e-4])


def said(message, pose, covariance):
    """Return a message of a pose (7,), its quaternion as far from 1 as digits of floats leave."""
    p, q = message.pose.pose.position, message.pose.pose.orientation
    p.x, p.y, p.z, q.x, q.y, q.z, q.w = (pose * np.append(np.ones(3), np.full(4, 1.0003))).tolist()
    message.pose.covariance = covariance.ravel()
    return message


@pytest.mark.parametrize(('of_odometry', 'of_loops', 'told'), [
    (lambda k: np.eye(6), np.zeros((6, 6)), []),
    (lambda k: 1e-4 * k * np.eye(6), PLANAR, ['variance 0 of loop', '0.01 is used'])])
def test_what_front_ends_in_space_send_makes_a_map(bench, capfd, of_odometry, of_loops, told):
    """Frames of their own, covariances that grow or mean nothing, loops that leave z unset."""
    world = simulate_world(KEYFRAMES, KEYFRAMES - 1 + LOOPS, WorldOptions(block=2),
                           np.random.default_rng(0), 'building')
    factors = world.graph.between
    b = bench(dimension=3, odom_frame='camera_init')
    for k, pose in enumerate(world.odometry):
        b.send('/odom', said(Odometry(header=header('camera_init', (k + 1) * NS),
                                      child_frame_id='body'), pose, of_odometry(k + 1)))
        for row in np.flatnonzero(~factors.is_odometry & (factors.j == k)):
            b.send('/loop_closures', said(PoseWithCovarianceStamped(header=header(
                f'body@{factors.i[row] + 1}.000000000', (k + 1) * NS)),
                factors.measurement[row], of_loops))
    b.until(lambda: len(b.path().poses) == KEYFRAMES, 'a map of all')
    answer = call(b, 'optimize')
    assert answer.success and 'times what is stated' in answer.message
    now, truth = b.backend._backend.snapshot(), se3.positions(world.truth)
    found, before = (absolute_trajectory_error(se3.positions(poses), truth)
                     for poses in (now.poses, world.odometry))
    assert now.judgement.accepted.all() and found < 0.6 * before
    assert b.path().header.frame_id == 'map' and not b.backend._inputs.refused
    said_so = ''

    def is_told():
        nonlocal said_so
        said_so += capfd.readouterr().err
        return all(part in said_so for part in told)

    b.until(is_told, f'{told} is told')
    assert said_so.count('WARN') == bool(told)
