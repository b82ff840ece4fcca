# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A bag whose loops did not get into the map is no success: exit 3, and where they are."""

from collections import Counter

import pytest
from command import run
from rosbags.rosbag2 import StoragePlugin
from worlds import simulated_bag

import l1slam_ros as l1
from bags import TYPES, mcap_file, recording_of, rosbag2_directory
from l1slam_ros.cli.main import main


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    """Ten seconds of a world with 100 poses and 82 loops."""
    folder = tmp_path_factory.mktemp('world')
    return recording_of(simulated_bag(folder / 'bag', 100, 181))


def changed(recording, topic, change):
    """Return the recording; change : of message and number, in place, of one topic."""
    count, found = Counter(), []
    for name, msgtype, time, data in recording:
        if name == topic:
            message = TYPES.deserialize_cdr(data, msgtype)
            change(message, count[name])
            count[name] += 1
            data = bytes(TYPES.serialize_cdr(message, msgtype))
        found.append((name, msgtype, time, data))
    return found


def renamed(recording, **names):
    names = {f'/{old}': new for old, new in names.items()}
    return [(names.get(topic, topic), *rest) for topic, *rest in recording]


def in_frame(frame, numbers=range(10**6)):
    def change(message, k):
        if k in numbers:
            message.header.frame_id = frame

    return change


def written(tmp_path, recording):
    return mcap_file(tmp_path / 'a.mcap', recording)


@pytest.fixture
def damage_of(capsys):
    """Return a function that tells what is said of a bag of which only a part is used."""
    def last_line(path, *options):
        code = main(['info', str(path), *options])
        assert code in (0, 3)
        err = capsys.readouterr().err
        return err.splitlines()[-1].removeprefix('l1slam: ') if code == 3 else ''
    return last_line


def test_loops_on_another_topic_are_named_with_what_reads_them(capsys, tmp_path, recording):
    names = {'odom': '/robot1/odometry/filtered', 'loop_closures': '/robot1/loops'}
    path = rosbag2_directory(tmp_path / 'bag', renamed(recording, **names), StoragePlugin.SQLITE3)
    said = ('no loop is in the map, but there are loops in 82 messages on /robot1/loops; expected '
            '--loop-topic /robot1/loops')
    asked = (path, '--odom-topic', '/robot1/odometry/filtered')
    for command in ('solve', 'info'):
        out, err = run(capsys, command, *asked, code=3)
        assert err == f'l1slam: {said}\n' and 'nothing looks wrong' not in out
        run(capsys, command, *asked, '--loop-topic', '/robot1/loops')
    with pytest.warns(UserWarning, match='--loop-topic /loops'):
        l1.read_graph(written(tmp_path, renamed(recording, loop_closures='/loops')))


@pytest.mark.parametrize('named, said', [('/nope', 'no messages on /nope; '), ('/odom', '')])
def test_a_wrong_topic_for_the_loops_is_solved_and_said(capsys, tmp_path, recording, named, said):
    path = written(tmp_path, recording)
    for command in ('solve', 'info', 'convert'):
        to = [tmp_path / f'{command}.g2o'] if command == 'convert' else []
        assert run(capsys, command, path, *to, '--loop-topic', named, code=3)[1] == (
            f'l1slam: {said}no loop is in the map, but there are loops in 82 messages on '
            '/loop_closures; expected --loop-topic /loop_closures\n')


def test_of_several_robots_each_is_named_with_its_odometry_and_one_that_is_read_will_do(
        damage_of, tmp_path, recording):
    robots = [renamed(recording, odom=f'/r{k}/odom', loop_closures=f'/r{k}/loops')
              for k in (2, 1)]
    path = written(tmp_path, [*robots[0], *robots[1]])
    assert damage_of(path, '--odom-topic', '/r1/odom') == (
        'no loop is in the map, but there are loops in 82 messages on /r1/loops and 82 messages '
        'on /r2/loops; expected --loop-topic /r1/loops or --loop-topic /r2/loops --odom-topic '
        '/r2/odom')
    assert damage_of(path, '--odom-topic', '/r1/odom', '--loop-topic', '/r1/loops') == ''


@pytest.mark.parametrize('count, lost', [(82, True), (42, True), (41, False), (1, False)])
def test_more_than_half_of_the_loops_refused_is_too_many(
        capsys, tmp_path, recording, count, lost):
    path = written(tmp_path, changed(recording, '/loop_closures', in_frame('map', range(count))))
    said = (f"l1slam: {count} of 82 loops on /loop_closures did not get into the map, the first: "
            f"frame 'map' of a loop; expected ")
    for command in ('solve', 'info'):
        err = run(capsys, command, path, code=3 if lost else 0)[1]
        assert (said in err) == lost


def test_loops_that_are_lost_in_the_odometry_count_too(damage_of, tmp_path, recording):
    """By a clock of their own they begin before the odometry, or never come."""
    def earlier(message, k):
        message.header.stamp.sec -= 900
        message.header.frame_id = 'base_link@1.000000000'

    def later(message, k):
        message.header.stamp.sec += 900

    for change in (earlier, later):
        path = written(tmp_path, changed(recording, '/loop_closures', change))
        assert damage_of(path) == '82 of 82 loops on /loop_closures did not get into the map'


def test_what_was_sent_again_is_in_the_map(damage_of, tmp_path, recording):
    twice = [one for one in recording for _ in range(1 + 2 * (one[0] == '/loop_closures'))]
    assert damage_of(written(tmp_path, twice)) == ''


def test_poses_that_are_no_loops_are_none(damage_of, tmp_path, recording):
    for frame in 'map', '', 'user@home', 'a@1':
        others = changed(recording, '/loop_closures', in_frame(frame))
        assert damage_of(written(tmp_path, renamed(others, loop_closures='/amcl_pose'))) == ''


@pytest.mark.parametrize('topic', ['/absolute_poses', '/false_loop_closures'])
def test_absolute_poses_and_strikes_are_no_loops_that_were_lost(
        damage_of, tmp_path, recording, topic):
    others = changed(recording, '/loop_closures', in_frame('map')) if 'abs' in topic else recording
    others = renamed(others, loop_closures=topic)
    assert damage_of(written(tmp_path, others)) == ''
    if 'abs' in topic:  # those that are refused are no lost loops
        poses = [one for one in others if one[0] == topic]
        assert damage_of(written(tmp_path, [*recording, *poses, *poses])) == ''


def test_a_bag_without_loops_is_one(capsys, tmp_path, recording):
    path = written(tmp_path, [one for one in recording if one[0] == '/odom'])
    run(capsys, 'info', path)
    assert 'no messages on /nope' in run(capsys, 'info', path, '--loop-topic', '/nope', code=2)[1]
