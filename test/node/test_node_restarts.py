# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The odometry's driver restarts while the real node listens: another publisher, another frame."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from laps import LAP, Laps, at, stamp
from nav_msgs.msg import Odometry
from node_bench import call, header, odometry, poses_of, put, stamp_of
from problems import seconds
from rclpy.qos import QoSProfile
from worlds import position_error

import l1slam_ros as l1


def message_of(found):
    """Return the message of a sample or a loop."""
    if isinstance(found, l1.LoopClosure):
        message = PoseWithCovarianceStamped(header=header(
            'base_link@{}.{:09d}'.format(*divmod(found.reference_stamp, 10**9)), found.stamp))
    else:
        message = Odometry(header=header('odom', found.stamp), child_frame_id='base_link')
    put(message.pose.pose, found.pose3[:3], found.pose3[3:])
    message.pose.covariance = found.covariance.ravel()
    return message


def restart_driver(b):
    """Let another publisher speak on odom from now on."""
    b.peer.destroy_publisher(b.publishers['/odom'])
    b.publishers['/odom'] = b.peer.create_publisher(Odometry, '/odom', QoSProfile(depth=1000))
    b.until(lambda: b.publishers['/odom'].get_subscription_count()
            and b.peer.count_publishers('/odom') == 1, 'the node hears of it')


def error_of(path):
    """Return the error of a Path's positions to the lap as it was driven [m]."""
    stamps = np.array([stamp_of(pose.header) for pose in path.poses])
    truth = at((stamps - stamp(0.0)) * 1e-9)
    return position_error(poses_of(path)[:, :2], truth[:, :2])


def said(capfd):
    return [line for line in capfd.readouterr().err.splitlines() if 'WARN' in line]


def test_a_map_over_a_restart_is_whole_and_the_restart_is_told_of(bench, capfd):
    laps = Laps(seed=4, laps=2.5)
    b = bench()
    sent = 0
    begin, silence = LAP + 14.4, 2.0
    for found in laps.heard(laps.restarted(begin, silence, (0.02, 0.0, 0.0))):
        is_loop = isinstance(found, l1.LoopClosure)
        if not is_loop and found.stamp == stamp(begin + silence):
            restart_driver(b)
        b.send('/loop_closures' if is_loop else '/odom', message_of(found))
        sent += not is_loop
        if not is_loop and sent % 20 == 0:
            b.until(lambda last=found.stamp: b.newest() >= last, 'it is used')
    b.until(lambda: sum(b.count(f'{state}_loops') for state in (
        'accepted', 'suspect', 'rejected')) == len(laps.loops), 'all loops are used')
    # All that joins both parts is one lap driven twice: the map is taken, and that is said.
    answer = call(b, 'optimize')
    assert not answer.success and answer.message.startswith('doubtful: two parts of the map are ')
    b.anew()
    assert b.count('accepted_loops') == len(laps.loops) and not b.refused()
    # The answer may come before the Path that goes with it.
    b.until(lambda: len(b.path().poses) == b.count('keyframes') and error_of(b.path()) < 0.2,
            'the whole map, and right')
    told = []
    b.until(lambda: told.extend(said(capfd)) or told, 'it is told of')
    assert len(told) == 1 and f'at stamp {stamp(begin + silence)} ns' in told[0]


@pytest.mark.parametrize('restarts', [True, False])
def test_another_publisher_makes_a_small_jump_a_restart(bench, capfd, restarts):
    """Without it, the odometry may as well have been corrected."""
    b = bench()
    for k in range(60):
        if k == 30 and restarts:
            restart_driver(b)
        b.send('/odom', odometry(seconds(10 + 0.05 * k), 5 + 0.05 * k + 0.4 * (k >= 30)))
    b.until(lambda: b.newest() == seconds(12.95), 'all is used')
    b.anew()
    assert b.count('keyframes') - 1 - b.count('factors') == restarts
    assert b.count('odometry.new_part') == restarts
    told = []
    if restarts:
        b.until(lambda: told.extend(said(capfd)) or told, 'it is told of')
        assert 'a new part of the map begins' in told[0]
        b.until(lambda: b.status()[2].get('odometry.new_part') == '1', 'diagnostics say so')
        level, sentence, _ = b.status()
        assert level == DiagnosticStatus.WARN and 'last minute: 1 new_part' in sentence
