# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Robots that pause, race, stop or jitter lose nothing; only what is not motion is told of."""

import heard
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import compose

MINUTE = 60.0  # [s] The longest pause without a doubt.
AGAIN = {'new_part': 1}


def timed(times, poses):
    """Return samples by their times (n,) [s] and poses (n, 3)."""
    return [heard.odometry(*sample) for sample in zip(times, poses, strict=True)]


def pausing(pause, drift):
    """Return a robot that stands where it stood, before and after a pause."""
    poses, late = np.insert(heard.curve(36), [20] * 4, heard.curve(21)[20], axis=0), np.arange(40)
    late = (late >= 22)[:, None]
    return timed(1.0 + 0.1 * np.arange(40) + pause * late[:, 0], poses + late * [drift, 0, 0])


def fast(speed, period):
    """Return a robot from rest, over a gap, and with two stamps a microsecond apart."""
    times = 1.0 + period * np.delete(np.arange(100), slice(40, 55))
    times = np.concatenate((0.7 + 0.01 * np.arange(20), np.insert(times, 60, times[60] - 1e-6)))
    return timed(times, np.maximum(times - 1.0, 0.0)[:, None] * [speed, 0, 0])


def at_home():
    """Return a robot on a grid without noise, which comes home exactly, and rests."""
    steps = [(1, 0), (1, 0), (0, 0), (0, 0), (-1, 0), (-1, 0), (0, 1), (0, -1), (1, 0), (-1, 0)]
    return timed(1.0 + 0.1 * np.arange(11), np.cumsum([(0, 0, 0), *((*s, 0) for s in steps)], 0))


def ordinary(rate, speed):
    """Return a robot that stops, turns on the spot, backs up, and comes home; stamps jitter."""
    rng, smooth = np.random.default_rng(2), np.ones(rate) / rate  # it takes a second to speed up
    pace, turning = (np.convolve(np.repeat(rng.choice(choices, 12), 3 * max(rate, 2)), smooth,
                                 'same') / rate
                     for choices in ([0.0, 1.0, 1.0, -0.5], [0.0, 0.0, 0.5, -0.5]))
    poses = [np.zeros(3)]
    for step in np.stack((pace * speed, 0 * pace, turning), axis=1):
        poses.append(compose(poses[-1], step))
    poses = np.array([*poses, *poses[-2::-1]])
    times = 100 + (np.arange(len(poses)) + rng.uniform(-0.2, 0.2, len(poses))) / rate
    came = rng.random(len(poses)) > 0.1
    return timed(times[came], (poses + rng.normal(0, 1e-3, poses.shape))[came])


def signed(sign, step):
    """Return a robot that steps aside by some metres in .05 s, and what else begins anew then."""
    sizes = 1e-4 * np.arange(1, 81)
    sizes[40:] -= 40e-4 * (sign == 'covariance')
    return [heard.odometry(1.0 + 0.05 * k, (5 + 0.05 * k, step * (k >= 40), 0), size * np.eye(6),
                           other_source=sign == 'source' and k == 40)
            for k, size in enumerate(sizes)]


def set_back(back):
    """Return a robot whose clock is set back."""
    k = np.arange(200)
    return timed(100.0 + 0.05 * k - back * (k >= 100), heard.straight(200, 0.05))


def in_heaps(heap):
    """Return a robot whose samples of 4 s are stamped within 1.8 s: it has not stood between."""
    times = np.concatenate([10 + 0.1 * np.arange(50), *(
        15.0 + 4.0 * k + np.linspace(0.0, 1.8, heap) for k in range(20))])
    return timed(times, heard.straight(len(times), 0.05))


def standing(pause):
    """Return a robot that its driver says nothing of three times, as if it had stood."""
    k = np.arange(500)
    return timed(10.0 + 0.1 * k + pause * sum(k >= one for one in (100, 220, 340)),
                 heard.straight(500, 0.05))


@pytest.mark.parametrize('samples, told', [
    *((pausing(pause, drift), [{}])
      for pause in (3.0, MINUTE + 1, 10 * MINUTE, 86400.0) for drift in (0, 3.0)),
    *((fast(*how), [{}]) for how in ((40.0, 0.1), (40.0, 1.0), (40.0, 0.02), (320.0, 0.1))),
    *((timed(1.0 + period * np.arange(40), heard.curve(40)), [{}]) for period in (1.0, 1.9)),
    *((ordinary(*how), [{}]) for how in ((1, 15.0), (5, 1.0), (20, 0.2), (50, 15.0))),
    # A step of .4 m alone may be a correction of the odometry.
    (at_home(), [{}]), (signed('', 0.4), [{}]), (signed('source', 0.0), [{}]),
    (signed('covariance', 0.0), [{}]), (signed('source', 0.4), [AGAIN]),
    # By less than may be late, it is only known once it has caught up, by the way made.
    (signed('covariance', 0.4), [AGAIN]), *((set_back(back), [AGAIN]) for back in (0.7, 1.5, 30)),
    *((in_heaps(heap), [{}, {'unsure': 1}]) for heap in (10, 25, 60)),
    *((standing(pause), [{'unsure': 3}]) for pause in (1.0, 2.5, 4.0))])
def test_only_what_is_no_motion_is_told_of(samples, told):
    backend = heard.begun()
    errors = heard.hear(backend, samples)
    assert heard.told(backend) in told and not heard.refused(backend)
    assert len(heard.parts(backend)) == (AGAIN in told)
    assert backend.robot().stamp == samples[-1].stamp
    if told[0] == {}:
        assert not errors
        found = np.array([one.pose3[:2] for one in samples])
        assert_allclose(backend.snapshot().odometry[:, :2], found, atol=1e-9)
