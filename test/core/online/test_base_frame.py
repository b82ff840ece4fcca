# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Whose odometry it is: a stray first message does not decide it, and nothing else is lost."""

from dataclasses import replace

import pytest
from problems import EVERY, odometry

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.running.backend import Backend


def fed(frames, name=''):
    """Return the frame, which messages are in the map, in order, and what is said of others."""
    builder, refused = GraphBuilder(se2, replace(EVERY, base_frame=name)), 0
    for k, frame in enumerate(frames, 1):
        try:
            builder.add_odometry(replace(odometry(k, (k, 0, 0)), frame=frame))
        except MessageError as error:
            assert str(error).endswith("; expected that of 'b'")
            refused += 1
    builder.finish()
    used = builder.keyframe_stamps // 10**9 - 1
    refused += builder.notes.refused['child_frame']
    return builder.robots[0].base_frame.name, used.tolist(), refused


@pytest.mark.parametrize('frames, used', [
    ('b', [0]), ('bbb', [0, 1, 2]), ('abbb', [1, 2, 3]), ('acbb', [2, 3]), ('abcb', [1, 3]),
    ('bab', [0, 2]), ('babaa', [0, 2]), ('bbaaaaa', [0, 1]), ('ba', [0]), ('bac', [0])])
def test_the_first_frame_unless_two_of_another_follow(frames, used):
    assert fed(frames) == ('b', used, len(frames) - len(used))


def test_a_frame_that_the_user_names_is_the_law():
    assert fed('aaaabaa', 'b') == ('b', [4], 6)


def test_messages_without_a_frame_go_with_any():
    assert fed(['', '', ''])[1] == [0, 1, 2]
    assert fed(['', '', 'b', 'a', 'a', 'a', '', 'b'])[1] == [0, 1, 2, 6, 7]
    assert fed(['', 'b', ''], 'b')[1] == [0, 1, 2]


@pytest.mark.parametrize('begin_again', [
    lambda backend: backend.reset(), lambda backend: backend.restore(backend.saved())])
def test_no_reset_forgets_whose_odometry_it_is(begin_again):
    backend = Backend(EVERY)
    for k in range(3):
        backend.add_odometry(replace(odometry(k, (k, 0, 0)), frame='b'))
    begin_again(backend)
    with pytest.raises(MessageError, match="odometry of 'a'; expected that of 'b'"):
        backend.add_odometry(replace(odometry(9, (0, 0, 0)), frame='a'))


def test_a_stray_of_two_that_came_at_once_leaves_a_whole_map():
    """The second of the robot's is refused, as its stamp is that of the first."""
    backend = Backend(EVERY)
    backend.add_odometry(replace(odometry(5, (7, 0, 0)), frame='a'))
    backend.add_odometry(replace(odometry(6, (1, 0, 0)), frame='b'))
    with pytest.raises(MessageError, match='is not after the last one'):
        backend.add_odometry(replace(odometry(6, (1, 0, 0)), frame='b'))
    backend.update()
    assert backend.poses[:, 0].tolist() == [1.0]


def test_a_stray_behind_a_restored_map_takes_nothing_of_it():
    """The robot's odometry goes on from where the map ended."""
    first, second = Backend(EVERY), Backend(EVERY)
    for k in range(5):
        first.add_odometry(replace(odometry(k, (k, 0, 0)), frame='b'))
    second.restore(first.saved())
    for time, x, frame in (10, 50, 'a'), (11, 70, 'b'), (12, 71, 'b'):
        second.add_odometry(replace(odometry(time, (x, 0, 0)), frame=frame))
    assert second.base_frame.name == 'b'
    assert second.poses[:5].tolist() == first.poses.tolist()
    assert second.poses[-2:, 0].tolist() == pytest.approx([4, 5])
