# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Drivers that restart, fall silent or deliver out of order, on laps of a square."""

from functools import cache

import heard
import numpy as np
import pytest
from laps import LAP, SAME, Laps, at, late, stamp
from numpy.testing import assert_allclose
from worlds import between, compose

ACCEPTED, REJECTED = 2, 3
NEAR, ZERO, AWAY = (0.02, 0.0, 0.0), (0.0, 0.0, 0.0), (5e8, 1e5, 1.0)
# [s] Into the second lap, 11.4 m from the origin, before a corner, near the end and at the end.
FAR, CORNER, HOME, END = LAP + 14.4, LAP + 7.5, LAP + 36.0, 2 * LAP - 0.3


def told(laps, samples, **options):
    """Return the settled back end after all messages, and how many were refused at once."""
    backend = heard.begun({}, **options)
    refused = heard.hear(backend, laps.heard(samples))
    assert all('odometry stamp' in one for one in refused)
    backend.update(0.01)
    backend.settle()
    return backend, len(refused)


@cache
def drive(twist):
    """Return laps, and the error of the map of them that nothing disturbs."""
    laps = Laps(seed=4, twist=twist)
    backend, refused = told(laps, laps.samples())
    assert not refused and not backend.news() and not heard.refused(backend)
    assert (backend.loop_states().state == ACCEPTED).all()
    return laps, laps.error(backend.snapshot())


def assert_whole(laps, backend, least, missing):
    """Check that the map is as good as may be, and that no true loop is rejected."""
    error = laps.error(backend.snapshot())
    assert error < 2 * least + (0.5 if missing >= 4 else 0.1)
    states = backend.loop_states().state
    assert not (states == REJECTED).any() and (states == ACCEPTED).sum() > len(laps.loops) - 30


@pytest.mark.parametrize('when, silence, where, twist', [
    (FAR, 0.05, NEAR, False), (FAR, 0.5, NEAR, True), (FAR, 4.0, ZERO, False),
    (FAR, 2.0, SAME, True), (CORNER, 0.05, SAME, False), (CORNER, 2.0, ZERO, True),
    (CORNER, 4.0, NEAR, False), (HOME, 0.05, ZERO, True), (HOME, 2.0, NEAR, False),
    (HOME, 4.0, SAME, True), (END, 0.5, ZERO, False), (END, 4.0, SAME, True),
    (FAR, 0.05, AWAY, False), (CORNER, 2.0, AWAY, True)])
def test_odometry_that_restarts_bends_no_map(when, silence, where, twist):
    laps, least = drive(twist)
    backend, refused = told(laps, laps.restarted(when, silence, where))
    assert_whole(laps, backend, least, silence)
    assert not refused and not heard.refused(backend)
    first = stamp(when) + round(1e9 * silence)
    stamps = [int(one.split(' at stamp ')[1].split()[0]) for one in backend.news()
              if ' at stamp ' in one]
    moved = np.linalg.norm(at(np.array([when + silence]))[0, :2])
    # The robot is there, or next to nothing is missing: nothing is to be said.
    assert any(abs(one - first) <= 5e7 for one in stamps) or (
        silence < 0.2 if where is SAME else moved < 0.5)


@pytest.mark.parametrize('begin', [LAP + 7.0, LAP + 12.0])
def test_loops_into_a_silence_say_how_little_is_known_of_it(begin):
    """Round a corner, and along a side."""
    laps, least = drive(False)
    backend, _ = told(laps, laps.silent(begin, begin + 4))
    assert_whole(laps, backend, least, 4)
    assert not backend.news()
    i, j, measurement, covariance = heard.loops_of(backend)
    sigma = np.sqrt(covariance.diagonal(axis1=1, axis2=2))
    times = (backend.loop_states().stamps - stamp(0.0)) * 1e-9
    inside = ((times > begin + 0.1) & (times < begin + 3.9)).any(axis=1)
    assert inside.sum() >= 14 and (sigma[inside] > 0.2).all() and (sigma[~inside] < 0.1).all()
    there = at((backend.snapshot().stamps - stamp(0.0)) * 1e-9)
    off = between(between(there[i], there[j]), measurement)
    assert (np.abs(off[inside]) < 3 * sigma[inside]).all()


def test_a_loop_whose_end_is_not_seen_any_more_when_the_odometry_restarts():
    """The part before ends where it was seen last."""
    backend, times = heard.begun(), [2.0, 2.9, 3.9, 4.9, 5.0, 5.5]
    for start in 1.0, 5.0:
        heard.drive_on(backend, heard.straight(20, 0.1), start=start)
    heard.hear(backend, (heard.loop(1.0, time, (1.0, 0, 0), 1e-4 * np.eye(6)) for time in times))
    assert heard.parts(backend) == [20]
    variance = heard.loops_of(backend)[3].diagonal(axis1=1, axis2=2) - 1e-4
    metres = np.sqrt(np.abs(variance[:, 0]))
    assert (np.diff(metres[1:4]) > 0.5).all() and 1 < metres[3] < 3
    assert_allclose(variance[[0, 1, 4, 5]], 0, atol=1e-12)


@pytest.mark.parametrize('delay, share', [(1.0, 0.2), (0.3, 0.5)])
def test_messages_that_come_late_make_no_parts(delay, share):
    laps, least = drive(False)
    found = late(laps.samples(), share, delay, np.random.default_rng(1))
    backend, refused = told(laps, found)
    assert_whole(laps, backend, least, 0)
    assert not heard.parts(backend) and 0 < refused < share * len(found)


@pytest.mark.parametrize('source', ['model', 'increment', 'twist'])
def test_late_messages_are_put_in_their_place_while_the_keyframe_is_open(source):
    covariance = np.diag([1e-6, 2e-6, 1, 1, 1, 3e-6])
    poses = [np.zeros(3)]
    for _ in range(99):
        poses.append(compose(poses[-1], np.array([0.0505, 0.0, 0.005])))
    samples = [heard.odometry(1.0 + 0.05 * k, pose, covariance, covariance)
               for k, pose in enumerate(poses)]
    order = np.arange(100).reshape(-1, 10)
    order[:, [4, 5, 6]] = order[:, [6, 4, 5]]  # each tenth is a keyframe
    found = []
    for one in range(100), order.ravel():
        backend = heard.begun({}, **{'odometry.covariance_source': source})
        assert not heard.hear(backend, (samples[k] for k in one))
        heard.hear(backend, (heard.loop(1.0, 1.0 + 0.05 * k, poses[k]) for k in range(10, 100)))
        found.append((heard.steps_of(backend), heard.loops_of(backend)))
    ((ours, noise), (*pairs, loops, _)), ((theirs, other), (*others, same, _)) = found
    assert len(ours) == len(theirs) == 9 and pairs == others
    assert_allclose(theirs, ours, atol=1e-12)
    assert_allclose(same, loops, atol=1e-9)
    if source != 'twist':  # which states for all the time since the message before
        assert_allclose(other, noise, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize('reorder, said', [
    (1.0, 'after a later keyframe'), (0.0, 'is not after the last one, 1500000000 ns')])
def test_what_is_late_is_dropped_where_its_keyframe_is_closed_or_nothing_may_be_late(
        reorder, said):
    backend = heard.begun(**{'odometry.reorder': reorder})
    (refused,) = heard.hear(backend, (
        heard.odometry(1.0 + k / 10, (k / 10, 0, 0)) for k in (0, 1, 2, 4, 5, 1e7, 3)))
    assert said in refused and len(backend.poses) == 5
