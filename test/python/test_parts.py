# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Where odometry does not go on from where it was, a part of the map begins that loops join."""

from contextlib import nullcontext

import heard
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import between, compose

import l1slam_ros as l1


def test_until_loops_join_it_a_part_begins_where_the_last_one_ends():
    poses = heard.curve(60)
    backend = heard.begun()
    heard.drive_on(backend, poses[:40], start=100.0)
    heard.drive_on(backend, poses[40:], start=101.0)
    assert heard.told(backend) == {'new_part': 1} and not heard.refused(backend)
    now = backend.snapshot()
    assert heard.parts(backend) == [40] and len(now.graph.between) == 58
    assert_allclose(now.odometry[40:], compose(poses[39], between(poses[40], poses[40:])),
                    atol=1e-9)
    assert now.stamps[40] == heard.seconds(101.0)
    # Each part is told of, not only the first.
    assert backend.news() == ['odometry stamp 101000000000 ns is not after the last one, '
                              '103900000000 ns; a new part of the map begins where the last one '
                              'ends']
    heard.drive_on(backend, poses[40:], start=101.0)
    assert len(backend.news()) == 1 and heard.told(backend) == {'new_part': 2}


@pytest.mark.parametrize('reference, stamp, ends', [
    (101.2, 102.4, [42, 54]), (100.3, 102.4, [3, 54]), (100.3, 100.9, [3, 9])])
def test_a_stamp_is_of_the_part_that_the_robot_is_in_if_that_goes_back_so_far(
        reference, stamp, ends):
    backend = heard.begun()
    heard.drive_on(backend, heard.curve(40), start=100.0)
    heard.drive_on(backend, heard.curve(20), start=101.0)
    backend.add_loop(heard.loop(reference, stamp, (1.0, 0.0, 0.0)))
    i, j, *_ = heard.loops_of(backend)
    assert i + j == ends


def test_loops_that_came_before_the_clock_was_set_back_are_of_their_time():
    """Also one that waits then for a time that never comes, until the second part has it."""
    backend = heard.begun()
    heard.drive_on(backend, heard.curve(20), start=100.0)
    for end in 101.5, 102.5:
        backend.add_loop(heard.loop(100.1, end, (1.0, 0.0, 0.0)))
    heard.drive_on(backend, heard.curve(30), start=100.0)
    assert heard.loops_of(backend)[:2] == ([1, 21], [15, 45])


def test_near_a_gap_nothing_is_carried_across_it():
    """The time is nearer to the first keyframe of the second part than to its own."""
    backend = heard.begun({}, **{'keyframe.rotation': 0.0})
    poses = heard.straight(30, 0.1)
    poses[14:, 0] += 1e6
    heard.drive_on(backend, poses, start=1.0)
    backend.add_loop(heard.loop(1.0, 2.3, (1.3, 0.0, 0.0)))
    stamps = backend.snapshot().stamps[[2, 3]].tolist()
    assert stamps == [heard.seconds(2.0), heard.seconds(2.4)]
    i, j, measurement, _ = heard.loops_of(backend)
    assert (i, j) == ([0], [2])
    assert_allclose(measurement, [[1.0, 0, 0]], atol=1e-9)


@pytest.mark.parametrize('choice, poses, x', [
    ('new_segment', 60, 39.0), ('reset', 20, 0.0), ('ignore', 40, None)])
def test_what_becomes_of_the_map_is_the_users_to_say(choice, poses, x):
    backend = heard.begun(on_time_jump=choice)
    for count in 40, 20:
        for k, pose in enumerate(heard.straight(count)):
            refused = choice == 'ignore' and count == 20
            with pytest.raises(l1.L1SlamError) if refused else nullcontext():
                backend.add_odometry(heard.odometry(100.0 + k * heard.PERIOD, pose))
        backend.settle()
    assert len(backend.poses) == poses
    if x is not None:
        assert_allclose(backend.poses[-20], [x, 0, 0], atol=1e-9)
        robot = backend.robot()
        assert_allclose(compose(robot.map_to_odom, robot.odometry), [[x + 19, 0, 0]], atol=1e-9)


def test_played_twice_it_is_one_map_with_twice_the_odometry():
    """The loops are known, and what they say is in the first part; the second is odometry."""
    poses, backend = heard.curve(100), heard.begun()
    loops = [heard.true_loop(poses, k, k + 60, 1e-4 * np.eye(6)) for k in range(0, 40, 4)]
    for _ in range(2):
        heard.drive_on(backend, poses)
        assert not heard.hear(backend, loops)
    backend.settle()
    assert heard.parts(backend) == [100] and len(backend.snapshot().graph.between) == 198 + 10
    assert heard.refused(backend) == {'repeated': 10}
    assert_allclose(backend.poses, [*poses, *compose(poses[-1], poses)], atol=1e-6)


def test_a_saved_map_keeps_its_parts():
    first, second = heard.begun(), heard.begun()
    heard.drive_on(first, heard.curve(40), start=100.0)
    heard.drive_on(first, heard.straight(20), start=98.0)
    first.settle()
    second.restore(first.saved())
    assert heard.parts(second) == [40]
    assert second.snapshot().stamps.tolist() == first.snapshot().stamps.tolist()
    # The odometry of the second part goes on, in its frame.
    second.add_odometry(heard.odometry(100.0, (20.0, 0.0, 0.0)))
    assert_allclose(second.poses[60], compose(second.poses[59], np.array([1.0, 0, 0])), atol=1e-6)
    assert heard.parts(second) == [40]
    # Another recording, made earlier, is a part of its own.
    heard.drive_on(second, heard.straight(5), start=0.5)
    assert heard.parts(second) == [40, 61]
    assert_allclose(second.poses[61], second.poses[60], atol=1e-9)


@pytest.mark.parametrize('choice, begins', [
    ('new_segment', [40]), ('reset', []), ('ignore', [])])
def test_a_robot_carried_off_while_its_map_was_saved_is_where_loops_say(choice, begins):
    """What begins elsewhere begins a part; or, by the user's word, where the robot was."""
    poses, first, second = heard.curve(100), heard.begun(), heard.begun(on_time_jump=choice)
    second.restore(heard.drive_on(first, poses[:40]).saved())
    elsewhere = compose(np.array([50.0, 60.0, 1.0]), poses)
    heard.drive_on(second, elsewhere, 60)
    heard.hear(second, (heard.true_loop(poses, k, k + 60, 1e-4 * np.eye(6)) for k in range(40)))
    second.settle()
    assert heard.parts(second) == begins
    if begins:
        assert_allclose(second.poses, np.delete(poses, np.s_[40:60], axis=0), atol=1e-6)
    else:
        assert len(second.poses) == 80
