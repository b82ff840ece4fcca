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
from node_bench import EVERY_MESSAGE, call, loop, odometry, poses_of
from team import Team, believed_by

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.io.messages.conversion import reference_frame_id
from l1slam_ros.ros.shell.header import header

NAMES = [f'r{k}' for k in range(1, 6)]


def message_of(found):
    """Return topic and message of a sample or a loop."""
    if isinstance(found, LoopClosure):
        one, other = (NAMES[robot] for robot in found.robots)
        frame = reference_frame_id(f'{one}/base_link', found.reference_stamp)
        topic, message = f'/{other}/loop_closures', PoseWithCovarianceStamped(
            header=header(frame, found.stamp))
    else:
        topic, message = '', Odometry(header=header('odom', found.stamp),
                                      child_frame_id='base_link')
    pose = message.pose.pose
    (pose.position.x, pose.position.y, _, _, _, pose.orientation.z,
     pose.orientation.w) = found.pose3.tolist()
    message.pose.covariance = found.covariance.ravel()
    return topic, message


def play(b, team, late=0, between=True):
    """Send all that robots say, as fast as it is used."""
    sent, traffic = 0, b.backend._inputs.traffic
    for robot, found in team.messages(late):
        topic, message = message_of(found)
        if not topic or between or len(set(found.robots)) == 1:
            b.send(topic or f'/{NAMES[robot]}/odom', message)
            sent += 1
        if sent % 40 == 0:
            b.until(lambda n=sent: sum(t.received for t in traffic.values()) >= n, 'it is used')
    b.until(lambda: sum(t.received for t in traffic.values()) == sent, 'all is used')
    b.until(lambda: b.backend._backend.behind().loops == 0, 'all is judged')


def lines(b):
    """Return what is said of each robot: sentence and values."""
    found = b.received['/diagnostics'][-1].status if b.received['/diagnostics'] else []
    return {status.name.rpartition(' ')[2]: (status.message, {
        v.key: v.value for v in status.values}) for status in found}


def settled(b, joined):
    b.until(lambda: call(b, 'optimize') and b.backend._backend.robot(1).joined == joined,
            'the map is done')
    b.until(lambda: b.received['r2/path'] and b.received['r2/path'][-1].header.frame_id == (
        'map' if joined else 'r2/map'), 'the path of the second robot is in its map')


@pytest.mark.parametrize(('robots', 'late'), [(2, 0), (2, 5), (5, 1.25)])
def test_robots_with_lies_between_them_have_the_loops_of_the_batch(bench, robots, late):
    """Each is late by so much more than the one before it."""
    team, share = Team(n=240, edges=800, lies=160, robots=robots), 240 // robots
    b = bench(robots=NAMES[:robots], **EVERY_MESSAGE)
    play(b, team, late)
    settled(b, True)
    expected, found = team.believed(), believed_by(b.backend._backend.snapshot())
    assert len(expected) > 150 and len(expected ^ found) <= 0.01 * len(expected)
    for robot, name in enumerate(NAMES[:robots]):
        assert b.backend._backend.robot(robot).joined
        path = b.received[f'{name}/path'][-1]
        b.until(lambda name=name: len(b.received[f'{name}/path'][-1].poses) == share, 'all of it')
        truth = se2.between(np.tile(team.truth[:1], (share, 1)), team.truth[team.robot == robot])
        path = b.received[f'{name}/path'][-1]
        assert path.header.frame_id == 'map'
        assert np.abs(poses_of(path) - truth)[:, :2].max() < 0.7
        heard = b.received[f'{name}/map_to_odom']
        b.until(lambda heard=heard: heard[-1].header.frame_id == 'map', 'it is in the map')
        assert {message.child_frame_id for message in heard} == {f'{name}/odom'}
    assert not b.backend._inputs.refused


def test_a_robot_that_nothing_joins_is_published_in_its_own_map(bench):
    team, b = Team(n=120, edges=400, lies=0), bench(robots=NAMES[:2], **EVERY_MESSAGE)
    play(b, team, between=False)
    settled(b, False)
    b.until(lambda: len(b.received['r2/path'][-1].poses) == 60, 'all of it')
    truth = se2.between(np.tile(team.truth[60:61], (60, 1)), team.truth[60:])
    b.until(lambda: np.abs(poses_of(b.received['r2/path'][-1]) - truth)[:, :2].max() < 0.5,
            'its loops have made its map')
    assert {p.header.frame_id for p in b.received['r2/pose']} == {'r2/map'}
    assert {p.header.frame_id for p in b.received['r1/pose']} == {'map'}
    transform = b.received['r2/map_to_odom'][-1]
    assert (transform.header.frame_id, transform.child_frame_id) == ('r2/map', 'r2/odom')
    b.until(lambda: lines(b).get('r2', ('', {}))[1].get('odom.received') == '60', 'it is said')
    assert lines(b)['r1'][0] == 'in map'
    assert lines(b)['r2'][0] == (
        'in r2/map: nothing that is believed joins it to the first robot')


def test_a_map_of_two_robots_is_loaded_by_their_names(bench, tmp_path):
    team, path = Team(n=120, edges=400, lies=0), str(tmp_path / 'map.g2o')
    b = bench(robots=NAMES[:2], save_path=path, **EVERY_MESSAGE)
    play(b, team)
    settled(b, True)
    b.until(lambda: len(b.received['r2/path'][-1].poses) == 60, 'all of it')
    b.until(lambda: b.backend._backend.update(0.0) is None, 'the map stands still')
    assert call(b, 'save').success
    second = poses_of(b.received['r2/path'][-1])
    b.close()
    b = bench(robots=NAMES[1::-1], save_path=path, load_on_start=True, **EVERY_MESSAGE)
    b.until(lambda: b.received['r2/path'] and len(b.received['r2/path'][-1].poses) == 60,
            'the map is back')
    # The second one is the first now: its frame is that of the map.
    first = np.tile(second[:1], (60, 1))
    np.testing.assert_allclose(poses_of(b.received['r2/path'][-1]),
                               se2.between(first, second), atol=1e-6)
    # It goes on, from elsewhere: a new part of the same robot.
    for k in range(3):
        b.send('/r2/odom', odometry((1000 + k) * 10**9, 1.0 * k))
    b.until(lambda: len(b.received['r2/path'][-1].poses) == 63, 'it drives on')
    assert len(b.received['r1/path'][-1].poses) == 60


def test_a_loop_of_a_robot_that_nobody_named_is_counted_and_said_once(bench, capfd):
    b = bench(robots=NAMES[:2], **EVERY_MESSAGE)
    b.send('/r1/odom', odometry(10**9, 0.0))
    for k in range(3):
        b.send('/r1/loop_closures', loop((5 + k) * 10**9, frame=f'r9/base_link@{k + 1}.000000000'))
    b.until(lambda: b.backend._inputs.refused['robot'] == 3, 'they are counted')
    said = [line for line in capfd.readouterr().err.splitlines() if 'r9/' in line]
    assert len(said) == 1 and 'expected one of r1, r2' in said[0]


def test_of_many_robots_that_nobody_named_the_first_are_said_and_all_counted(bench, capfd):
    b = bench(robots=NAMES[:2], **EVERY_MESSAGE)
    b.send('/r1/odom', odometry(10**9, 0.0))
    for k in range(60):
        b.send('/r1/loop_closures', loop(5 * 10**9, frame=f'x{k}/base_link@1.000000000'))
    b.until(lambda: b.backend._inputs.refused['robot'] == 60, 'they are counted')
    said = [line for line in capfd.readouterr().err.splitlines() if 'refused:' in line]
    assert len(said) == 21 and 'more than 20 other robots' in said[-1]
    assert len(b.backend._inputs._strangers) == 21


def test_frames_may_have_the_name_of_the_robot_or_not(bench):
    b = bench(robots=NAMES[:2], **EVERY_MESSAGE)
    for k in range(4):
        b.send('/r1/odom', odometry((1 + k) * 10**9, 1.0 * k, frame='r1/base_link'))
        b.send('/r2/odom', odometry((1 + k) * 10**9, 1.0 * k))
    b.send('/r2/loop_closures', loop(3 * 10**9, frame='r1/base_link@2.000000000', variance=.01))
    b.send('/r2/loop_closures', loop(4 * 10**9, frame='base_link@1.000000000', variance=.01))
    # Between two robots the reference may be later: clocks differ.
    b.send('/r2/loop_closures', loop(2 * 10**9, frame='r1/base_link@4.000000000', variance=.01))
    counted = b.backend._backend.counts
    b.until(lambda: sum(counts for name, counts in counted().sizes.items()
                        if name in ('accepted_loops', 'suspect_loops', 'rejected_loops')) == 3,
            'all three are loops')
    assert not b.backend._inputs.refused
