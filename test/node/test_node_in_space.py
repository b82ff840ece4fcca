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
from node_bench import call, header, put
from worlds import made, position_error

import l1slam_ros as l1

NS = 10**9
KEYFRAMES = 60
LOOPS = 20
PLANAR = np.diag([0.0025, 0.0025, 0, 0, 0, 1e-4])


def said(message, pose, covariance):
    """Return a message of a pose (7,), its quaternion as far from 1 as digits of floats leave."""
    put(message.pose.pose, pose[:3], 1.0003 * pose[3:])
    message.pose.covariance = covariance.ravel()
    return message


def positions_of(path):
    places = (pose.pose.position for pose in path.poses)
    return np.array([(place.x, place.y, place.z) for place in places])


@pytest.mark.parametrize(('of_odometry', 'of_loops', 'told'), [
    (lambda k: np.eye(6), np.zeros((6, 6)), []),
    (lambda k: 1e-4 * k * np.eye(6), PLANAR, ['variance 0 of loop', '0.01 is used'])])
def test_what_front_ends_in_space_send_makes_a_map(
        bench, tmp_path, capfd, of_odometry, of_loops, told):
    """Frames of their own, covariances that grow or mean nothing, loops that leave z unset."""
    path = made(tmp_path / 'sphere.g2o', KEYFRAMES, KEYFRAMES - 1 + LOOPS, '--world', 'sphere')
    graph, by_odometry = l1.read_graph(path)
    factors = graph.between
    b = bench(dimension=3, odom_frame='camera_init')
    for k, pose in enumerate(by_odometry):
        b.send('/odom', said(Odometry(header=header('camera_init', (k + 1) * NS),
                                      child_frame_id='body'), pose, of_odometry(k + 1)))
        for row in np.flatnonzero(~factors.is_odometry & (factors.j == k)):
            b.send('/loop_closures', said(PoseWithCovarianceStamped(header=header(
                f'body@{factors.i[row] + 1}.000000000', (k + 1) * NS)),
                factors.measurement[row], of_loops))
    b.map_of(KEYFRAMES)
    answer = call(b, 'optimize')
    assert answer.success and 'times what is stated' in answer.message
    truth = np.loadtxt(f'{path}.truth.txt')[:, 1:4]
    before = position_error(by_odometry[:, :3], truth)
    b.until(lambda: position_error(positions_of(b.path()), truth) < 0.6 * before, 'a better map')
    b.anew()
    assert b.count('accepted_loops') == LOOPS and b.count('factors') == len(factors)
    assert b.path().header.frame_id == 'map' and not b.refused()
    said_so = ''

    def is_told():
        nonlocal said_so
        said_so += capfd.readouterr().err
        return all(part in said_so for part in told)

    b.until(is_told, f'{told} is told')
    assert said_so.count('WARN') == bool(told)
