# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Several robots in the real node, on real DDS."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_bench import EVERY_MESSAGE, call, header, loop, odometry, poses_of, put
from team import Team
from worlds import between

import l1slam_ros as l1

NAMES = [f'r{k}' for k in range(1, 6)]


def message_of(found):
    """Return topic and message of a sample or a loop."""
    if isinstance(found, l1.LoopClosure):
        one, other = (NAMES[robot] for robot in found.robots)
        frame = '{}/base_link@{}.{:09d}'.format(one, *divmod(found.reference_stamp, 10**9))
        topic, message = f'/{other}/loop_closures', PoseWithCovarianceStamped(
            header=header(frame, found.stamp))
    else:
        topic, message = '', Odometry(header=header('odom', found.stamp),
                                      child_frame_id='base_link')
    put(message.pose.pose, found.pose3[:3], found.pose3[3:])
    message.pose.covariance = found.covariance.ravel()
    return topic, message


def play(b, team, late=0, joined=True):
    """Send all that robots say, as fast as it is used."""
    sent, unheard = 0, 0
    for robot, found in team.messages(late):
        topic, message = message_of(found)
        if not topic or joined or len(set(found.robots)) == 1:
            b.send(topic or f'/{NAMES[robot]}/odom', message)
            sent += 1
            unheard += 1
        if not topic and unheard >= 40:
            b.until(lambda name=f'{NAMES[robot]}/', last=found.stamp: b.newest(name) >= last,
                    'it is used')
            unheard = 0
    b.until(lambda: sum(int(value) for key, value in b.status()[2].items()
                        if key.endswith('.received')) == sent, 'all is used')
    b.anew()
    b.until(lambda: b.status()[2]['behind.loops'] == '0', 'all is judged')


def settled(b, joined):
    call(b, 'optimize')
    b.until(lambda: b.status('r2')[2].get('joined') == str(joined), 'the map is done')
    b.until(lambda: b.path('r2/').header.frame_id == ('map' if joined else 'r2/map'),
            'the path of the second robot is in its map')


def test_robots_with_lies_between_them_have_the_loops_of_the_batch(bench):
    """Each is late by so much more than the one before it."""
    robots, late, share = 3, 1.25, 50
    team = Team(n=150, edges=520, lies=90, robots=robots)
    b = bench(robots=NAMES[:robots], **EVERY_MESSAGE)
    play(b, team, late)
    settled(b, True)
    b.anew()
    expected = {(NAMES[one], NAMES[other], *ends) for one, other, *ends in team.believed()}
    found = {ends for ends, (state, _) in b.loops().items() if state == 'accepted'}
    assert len(expected) > 100 and len(expected ^ found) <= 0.01 * len(expected)
    for robot, name in enumerate(NAMES[:robots]):
        assert b.status(name)[2]['joined'] == 'True'
        b.until(lambda name=name: len(b.path(f'{name}/').poses) == share, 'all of it')
        truth = between(team.truth[0], team.truth[team.robot == robot])
        path = b.path(f'{name}/')
        assert path.header.frame_id == 'map'
        assert np.abs(poses_of(path) - truth)[:, :2].max() < 0.7
        heard = b.received[f'{name}/map_to_odom']
        b.until(lambda heard=heard: heard[-1].header.frame_id == 'map', 'it is in the map')
        assert {message.child_frame_id for message in heard} == {f'{name}/odom'}
    b.anew()
    assert not b.refused()


def test_a_robot_that_nothing_joins_is_published_in_its_own_map(bench):
    team, b = Team(n=120, edges=400, lies=0), bench(robots=NAMES[:2], **EVERY_MESSAGE)
    play(b, team, joined=False)
    settled(b, False)
    b.until(lambda: len(b.path('r2/').poses) == 60, 'all of it')
    truth = between(team.truth[60], team.truth[60:])
    b.until(lambda: np.abs(poses_of(b.path('r2/')) - truth)[:, :2].max() < 0.5,
            'its loops have made its map')
    assert {p.header.frame_id for p in b.received['r2/pose']} == {'r2/map'}
    assert {p.header.frame_id for p in b.received['r1/pose']} == {'map'}
    transform = b.received['r2/map_to_odom'][-1]
    assert (transform.header.frame_id, transform.child_frame_id) == ('r2/map', 'r2/odom')
    b.until(lambda: b.status('r2')[2].get('odom.received') == '60', 'it is said')
    assert b.status('r1')[1] == 'in map'
    assert b.status('r2')[1] == (
        'in r2/map: nothing that is believed joins it to the first robot')


def test_loops_of_robots_that_nobody_named_are_counted_and_the_first_are_said(bench, capfd):
    b = bench(robots=NAMES[:2], **EVERY_MESSAGE)
    b.send('/r1/odom', odometry(10**9, 0.0))
    for k in range(60):
        for reference in 1, 2:
            b.send('/r1/loop_closures', loop(
                5 * 10**9, frame=f'x{k}/base_link@{reference}.000000000'))
    b.until(lambda: b.count('refused.robot') == 120, 'they are counted')
    said = [line for line in capfd.readouterr().err.splitlines() if 'refused:' in line]
    assert len(said) == 21 and 'more than 20 other robots' in said[-1]
    assert all(f'x{k}/base_link' in line and 'expected one of r1, r2' in line
               for k, line in enumerate(said[:-1]))


def test_frames_may_have_the_name_of_the_robot_or_not(bench):
    b = bench(robots=NAMES[:2], **EVERY_MESSAGE)
    for k in range(4):
        b.send('/r1/odom', odometry((1 + k) * 10**9, 1.0 * k, frame='r1/base_link'))
        b.send('/r2/odom', odometry((1 + k) * 10**9, 1.0 * k))
    b.send('/r2/loop_closures', loop(3 * 10**9, frame='r1/base_link@2.000000000', variance=.01))
    b.send('/r2/loop_closures', loop(4 * 10**9, frame='base_link@1.000000000', variance=.01))
    # Between two robots the reference may be later: clocks differ.
    b.send('/r2/loop_closures', loop(2 * 10**9, frame='r1/base_link@4.000000000', variance=.01))
    b.until(lambda: sum(b.count(f'{state}_loops') for state in (
        'accepted', 'suspect', 'rejected')) == 3, 'all three are loops')
    assert not b.refused()
