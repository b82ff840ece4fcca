# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Strays among the odometry are dropped and counted, and robots that do odd things let pass."""

import heard
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import between, compose

import l1slam_ros as l1

GOOD = [(1.0 + k * heard.PERIOD, pose) for k, pose in enumerate(heard.curve(60))]
PAUSE, FASTEST = 60.0, 340.0  # [s], [m/s] The longest pause; no vehicle has been faster.


def fed(samples, options=heard.EVERY, **more):
    """Return the back end after samples (time, pose), and what was said of those refused."""
    backend = heard.begun(options, **more)
    return backend, heard.hear(backend, (heard.odometry(*sample) for sample in samples))


def among(place, *lates, poses=()):
    """Return good samples with others so long after the one of a number [s], but before it."""
    time, pose = GOOD[place]
    poses = poses or [pose] * len(lates)
    strays = [(time + late, pose) for late, pose in zip(lates, poses, strict=True)]
    return [*GOOD[:place], *strays, *GOOD[place:]]


@pytest.mark.parametrize('samples, causes, errors, said', [
    *((among(place, ahead - 0.05), {'stamp_ahead': 1}, [],
       f'ns is {ahead + 0.05:.6g} s after the one before; expected the next one to go on')
      for place in (1, 2, 20) for ahead in (2.2, 59.0, PAUSE + 1, 3600.0, 1e9)),
    (among(10, 1e6, 2e6, 1.5e6), {'stamp_ahead': 3}, [], 'ns is 1e+06 s after the one'),
    # A node that runs on simulated time says the wall's until it has heard the clock.
    (among(0, 1.7e9), {'stamp_ahead': 1}, [], 'first odometry stamp 1700000001000000000 ns'),
    (among(0, 2 * PAUSE), {'stamp_ahead': 1}, [], 'expected one before that of the next'),
    (among(10, 1e6, -0.5), {'stamp_ahead': 1}, ['0.4 s late'], 'ns is 1e+06 s after the one'),
    (among(10, -0.6), {}, ['came 0.5 s late, and says where the robot did not go'], ''),
    (among(40, -3.0), {'old_stamp': 1}, [], 'is not after the last one, 4900000000 ns'),
    (among(40, -0.35, -0.2), {}, ['came 0.25 s late', 'came 0.1 s late'], ''),
    *((among(30, *(-0.05, -0.03)[:count], poses=[(x, y, 1.0), (2 * x, 2 * y, 1.0)][:count]),
       {'jump': count}, [], '.05 s later, at stamp 3950000000 ns; expected a motion that robots')
      for x, y in ((5e8, 0.0), (0.0, -3e5), (1.2 * FASTEST * heard.PERIOD, 0.0))
      for count in (1, 2))])
def test_strays_are_dropped_and_counted(samples, causes, errors, said):
    """The map is that of all others, also where two pieces of garbage do not agree."""
    backend, refused = fed(samples)
    expected, _ = fed(GOOD)
    assert heard.refused(backend) == causes and not heard.told(backend)
    assert said in ''.join(backend.news()) and len(refused) == len(errors)
    assert all(error in one for error, one in zip(errors, refused, strict=True))
    now, then = backend.snapshot(), expected.snapshot()
    assert now.stamps.tolist() == then.stamps.tolist()
    assert_allclose(heard.steps_of(backend)[0], heard.steps_of(expected)[0], atol=1e-12)


@pytest.mark.parametrize('frame', [(0.0, 0.0, 0.0), (7e4, -3e5, 2.0)])
@pytest.mark.parametrize('moving', [True, False])
def test_odometry_that_moves_its_frame_goes_on_from_where_the_robot_was(frame, moving):
    """By the user's word. The step in between says that it is not known."""
    poses = heard.curve(200)
    after = between(poses[120], poses[120:] if moving else np.repeat(poses[120:121], 80, axis=0))
    found = np.concatenate((poses[:120], compose(np.array(frame), after)))
    backend = heard.driven(found, on_time_jump='ignore')
    assert heard.told(backend) == {'moved': 1} and not heard.refused(backend)
    assert 'the robot is taken to be where it was' in backend.news()[0]
    # The robot did not move from 119 to 120, as far as is known; then as its odometry says.
    assert_allclose(backend.snapshot().odometry[:120], poses[:120], atol=1e-9)
    off = between(compose(poses[119], after), backend.snapshot().odometry[120:])
    assert_allclose(off, 0, atol=1e-9)
    sigmas = np.sqrt(heard.steps_of(backend)[1].diagonal(axis1=1, axis2=2))
    assert (sigmas[119] >= 0.1).all() and (sigmas[118] < 0.03).all()
    backend.settle()
    there = compose(backend.robot().map_to_odom, np.array([frame]))
    assert_allclose(there, poses[119:120], atol=1e-9)


def test_a_sample_far_ahead_is_used_once_the_next_one_goes_on_from_it():
    backend, _ = fed(GOOD[:19])
    ahead = [heard.odometry(time, GOOD[19][1]) for time in (1e6, 1e6 + 0.1)]
    assert not backend.add_odometry(ahead[0]) and backend.robot().stamp == heard.seconds(2.8)
    with pytest.raises(l1.L1SlamError, match='is not after the last one, 1000000000000000 ns'):
        backend.add_odometry(ahead[0])
    assert backend.add_odometry(ahead[1]) and len(backend.poses) == 21
    assert not heard.refused(backend)


# Whose odometry it is


def of_frames(frames, backend):
    """Return what is said of samples of some frames, refused at once, number k at k + 1 s."""
    return heard.hear(backend, (heard.odometry(k, (k, 0, 0), frame=frame)
                                for k, frame in enumerate(frames, 1)))


@pytest.mark.parametrize('frames, used, held, name', [
    ('b', [0], 0, ''), ('bbb', [0, 1, 2], 0, ''), ('abbb', [1, 2, 3], 0, ''),
    ('acbb', [2, 3], 0, ''), ('abcb', [1, 3], 0, ''), ('bab', [0, 2], 0, ''),
    ('babaa', [0, 2], 0, ''), ('bbaaaaa', [0, 1], 0, ''), ('ba', [0], 1, ''),
    ('bac', [0], 2, ''), ('aaaabaa', [4], 0, 'b'), (['', 'b', ''], [0, 1, 2], 0, 'b'),
    (['', '', 'b', 'a', 'a', 'a', '', '/b'], [0, 1, 2, 6, 7], 0, '')])
def test_the_first_frame_is_the_robots_unless_two_of_another_follow(frames, used, held, name):
    """What the user names is the law, and messages without a frame go with any."""
    backend = heard.begun(base_frame=name)
    refused = of_frames(frames, backend)
    assert backend.base_frame.name == 'b'
    assert all(one.endswith("; expected that of 'b'") for one in refused)
    assert (backend.snapshot().stamps // 10**9 - 1).tolist() == used
    lost = len(refused) + backend.counts().refused.get('child_frame', 0)
    assert lost + held + len(used) == len(frames)


@pytest.mark.parametrize('begin_again', [
    lambda backend: backend.reset(), lambda backend: backend.restore(backend.saved())])
def test_no_reset_forgets_whose_odometry_it_is(begin_again):
    backend = heard.begun()
    of_frames('bbb', backend)
    begin_again(backend)
    assert of_frames('a', backend) == ["odometry of 'a'; expected that of 'b'"]
