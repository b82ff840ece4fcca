# SPDX-License-Identifier: Apache-2.0
"""Whose odometry it is: a stray first message does not decide it, and nothing else is lost."""

import pytest
from problems import odometry

from l1slam_ros.io.messages.base_frame import BaseFrame


def fed(frames, name=''):
    """Return the frame, which messages are in the map, in order, and what is said of others."""
    base, used, refused = BaseFrame(name), [], []
    for k, frame in enumerate(frames):
        found = base.take(frame, odometry(k, (0, 0, 0)))
        if found.anew:
            assert len(used) == 1
            used = []
        used += [sample.stamp // 10**9 for sample in found.ours]
        refused += [str(error) for error in found.others]
    return base, used, refused + [str(error) for error in base.rest()]


@pytest.mark.parametrize('frames, used', [
    ('b', [0]), ('bbb', [0, 1, 2]), ('abbb', [1, 2, 3]), ('acbb', [2, 3]), ('abcb', [1, 3]),
    ('bab', [0, 2]), ('babaa', [0, 2]), ('bbaaaaa', [0, 1]), ('ba', [0]), ('bac', [0])])
def test_the_first_frame_unless_two_of_another_follow(frames, used):
    base, found, refused = fed(frames)
    assert base.name == 'b' and found == used
    assert len(refused) == len(frames) - len(used)
    assert all(said.endswith("; expected that of 'b'") for said in refused)


def test_a_frame_that_the_user_names_is_the_law():
    base, used, refused = fed('aaaabaa', 'b')
    assert base.name == 'b' and used == [4] and len(refused) == 6


def test_messages_without_a_frame_go_with_any():
    assert fed(['', '', ''])[1] == [0, 1, 2]
    assert fed(['', '', 'b', 'a', 'a', 'a', '', 'b'])[1] == [0, 1, 2, 6, 7]
    assert fed(['', 'b', ''], 'b')[1] == [0, 1, 2]
