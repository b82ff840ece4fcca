# SPDX-License-Identifier: Apache-2.0
"""Whose odometry it is: by what the first messages agree on; nothing is lost in between."""

import pytest
from problems import odometry

from l1slam_ros.io.base_frame import BaseFrame


def fed(frames, name=''):
    """Return the frame, which messages were used, in order, and which refused, how."""
    base, used, refused = BaseFrame(name), [], []
    for k, frame in enumerate(frames):
        ours, others = base.take(frame, odometry(k, (0, 0, 0)))
        used += [sample.stamp // 10**9 for sample in ours]
        refused += [str(error) for error in others]
    return base, used, refused


@pytest.mark.parametrize('frames, used', [
    ('bbbb', [0, 1, 2, 3]),
    ('abbb', [1, 2, 3]),
    ('aabbbb', [2, 3, 4, 5]),
    ('abcbb', [1, 3, 4]),
    ('bbab', [0, 1, 3]),
    ('bbbaaaaaa', [0, 1, 2]),
])
def test_the_first_frame_that_three_messages_have(frames, used):
    base, found, refused = fed(frames)
    assert base.name == 'b' and found == used
    assert len(refused) == len(frames) - len(used)
    assert all(said.endswith("; expected that of 'b'") for said in refused)


def test_a_frame_that_the_user_names_is_the_law():
    base, used, refused = fed('aaaabaa', 'b')
    assert base.name == 'b' and used == [4] and len(refused) == 6


def test_messages_without_a_frame_go_with_any():
    assert fed(['', '', ''])[1] == [0, 1, 2]
    assert fed(['', '', '', '', 'b', 'a', ''])[1] == [0, 1, 2, 3, 4, 6]
    assert fed(['', 'b', 'a', '', 'b', 'b'])[1] == [0, 1, 3, 4, 5]
    assert fed(['', 'b', ''], 'b')[1] == [0, 1, 2]


@pytest.mark.parametrize('frames, used', [('a', [0]), ('ab', [1]), ('aab', [0, 1]), ('', [])])
def test_when_there_are_no_more_messages_what_has_come_decides(frames, used):
    base, found, _ = fed(frames[:2])
    if frames[2:]:
        base.take(frames[2], odometry(2, (0, 0, 0)))
    ours, _ = base.settle()
    assert found + [sample.stamp // 10**9 for sample in ours] == used
