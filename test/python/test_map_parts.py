# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Where odometry does not go on from where it was, a part of the map begins that loops join."""


import heard
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import between, compose


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


def test_a_stamp_is_of_the_part_that_the_robot_is_in_if_that_goes_back_so_far():
    """What came before is of its time, unless it waits until the later part has it."""
    backend = heard.begun()
    heard.drive_on(backend, heard.curve(40), start=100.0)
    heard.hear(backend, (heard.loop(100.1, end, (1.0, 0.0, 0.0)) for end in (101.5, 104.4)))
    heard.drive_on(backend, heard.curve(20), start=101.0)
    heard.hear(backend, (heard.loop(*times, (1.0, 0.0, 0.0)) for times in (
        (101.2, 102.4), (100.3, 102.4), (100.3, 100.9))))
    backend.snapshot()
    heard.drive_on(backend, heard.curve(35), 20, start=101.0)
    assert heard.loops_of(backend)[:2] == ([1, 42, 3, 3, 1], [15, 54, 54, 9, 74])


def test_near_a_gap_nothing_is_carried_across_it():
    """The end is nearer to the first keyframe of the second part, and begins between samples."""
    backend = heard.begun({}, **{'keyframe.rotation': 0.0})
    poses = heard.straight(30, 0.1)
    poses[14:, 0] += 1e6
    heard.drive_on(backend, poses, start=1.0)
    backend.add_loop(heard.loop(1.03, 2.3, (1.27, 0.0, 0.0)))
    stamps = backend.snapshot().stamps[[2, 3]].tolist()
    assert stamps == [heard.seconds(2.0), heard.seconds(2.4)]
    i, j, measurement, _ = heard.loops_of(backend)
    assert (i, j) == ([0], [2])
    assert_allclose(measurement, [[1.0, 0, 0]], atol=1e-9)


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
