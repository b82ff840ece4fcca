# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Drivers that restart, fall silent or deliver out of order, on laps of a square."""

from contextlib import suppress
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from laps import LAP, SAME, Laps, at, late, stamp
from numpy.testing import assert_allclose
from problems import EVERY, hear, odometry, straight

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.noise import covariance_of
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.online.keyframes import OdometryOptions
from l1slam_ros.core.online.options import GraphBuilderOptions
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.core.running.snapshot import ACCEPTED, REJECTED

NEAR, ZERO = (0.02, 0.0, 0.0), (0.0, 0.0, 0.0)
# [s] Into the second lap, 11.4 m from the origin, before a corner, near the end and at the end.
TIMES = {'far': LAP + 14.4, 'before a corner': LAP + 7.5, 'on the way home': LAP + 36.0,
         'at home': 2 * LAP - 0.3}


def told(backend, laps, samples):
    """Return the settled back end after all messages, and how many were refused."""
    refused = 0
    for message in laps.heard(samples):
        try:
            hear(backend, [message])
        except MessageError as error:
            assert error.cause == 'old_stamp'
            refused += 1
    backend.update(0.01)
    backend.settle()
    return backend, refused


@cache
def drive(twist):
    """Return laps, and the error of the map of them that nothing disturbs."""
    laps = Laps(seed=4, twist=twist)
    backend, refused = told(Backend(), laps, laps.samples())
    assert not refused and not backend.news() and not backend.counts()[1]
    assert (backend.loop_states().state == ACCEPTED).all()
    return laps, laps.error(backend.snapshot())


def assert_whole(laps, backend, least, missing):
    """Check that the map is as good as may be, and that no true loop is rejected."""
    error = laps.error(backend.snapshot())
    assert error < 2 * least + (0.5 if missing >= 4 else 0.1)
    states = backend.loop_states().state
    assert not (states == REJECTED).any() and (states == ACCEPTED).sum() > len(laps.loops) - 30


@pytest.mark.parametrize('silence', [0.05, 0.5, 2.0, 4.0])
@pytest.mark.parametrize('where', [NEAR, ZERO, SAME], ids=['near', 'zero', 'same'])
@pytest.mark.parametrize('when', TIMES)
def test_odometry_that_restarts_bends_no_map(when, where, silence):
    # Each two of these are tried with and without a twist.
    twist = (list(TIMES).index(when) + (NEAR, ZERO, SAME).index(where) + int(2 * silence)) % 2 == 1
    laps, least = drive(twist)
    backend, refused = told(Backend(), laps, laps.restarted(TIMES[when], silence, where))
    assert_whole(laps, backend, least, silence)
    assert not refused and not backend.counts()[1]
    first = stamp(TIMES[when]) + round(1e9 * silence)
    news = [one for one in backend.news() if abs(_stamp_in(one) - first) <= 5e7]
    moved = np.linalg.norm(at(np.array([TIMES[when] + silence]))[0, :2])
    # The robot is there, or next to nothing is missing: nothing is to be said.
    assert news or (where is SAME and silence < 0.2) or (where is not SAME and moved < 0.5)


def _stamp_in(sentence):
    return int(sentence.split(' at stamp ')[1].split()[0]) if ' at stamp ' in sentence else 0


@pytest.mark.parametrize('begin', [LAP + 7.0, LAP + 12.0, LAP + 17.5])
def test_loops_into_a_silence_say_how_little_is_known_of_it(begin):
    """Round a corner, and along a side."""
    laps, least = drive(False)
    backend, _ = told(Backend(), laps, laps.silent(begin, begin + 4))
    assert_whole(laps, backend, least, 4)
    assert not backend.news()
    now, states = backend.snapshot(), backend.loop_states()
    sigma = np.sqrt(np.diagonal(covariance_of(
        now.graph.between.sqrt_information[states.rows]), axis1=1, axis2=2))
    times = (states.stamps - stamp(0.0)) * 1e-9
    inside = ((times > begin + 0.1) & (times < begin + 3.9)).any(axis=1)
    assert inside.sum() >= 14 and (sigma[inside] > 0.2).all() and (sigma[~inside] < 0.1).all()
    off = _off(laps, now, states, at)
    assert (np.abs(off[inside]) < 3 * sigma[inside]).all()


def _off(laps, now, states, truth):
    """Return what the loop factors measure off the truth, (k, 3)."""
    factors, times = now.graph.between, (now.stamps - stamp(0.0)) * 1e-9
    i, j = factors.i[states.rows], factors.j[states.rows]
    true = se2.between(truth(times[i]), truth(times[j]))
    return se2.local(factors.measurement[states.rows], true)


def test_a_loop_whose_end_is_not_seen_any_more_when_the_odometry_restarts():
    """The part before ends where it was seen last."""
    builder = GraphBuilder(se2, EVERY)
    for k, pose in enumerate(straight(20, 0.1)):
        builder.add_odometry(odometry(1.0 + 0.1 * k, pose))
    for k, pose in enumerate(straight(20, 0.1)):
        builder.add_odometry(odometry(5.0 + 0.1 * k, pose))
    assert builder.robots[0].track.gaps.tolist() == [20]
    times = np.array([2.0, 2.9, 3.9, 4.9, 5.0, 5.5]) * 1e9
    metres, radians = builder.robots[0].track.unseen(times.astype(np.int64)).T
    assert (np.diff(metres[1:4]) > 0.5).all() and 1 < metres[3] < 3
    assert not metres[[0, 1, 4, 5]].any() and not radians[[0, 1, 4, 5]].any()


# Disorder


@pytest.mark.parametrize('delay, share', [(1.0, 0.2), (0.3, 0.5)])
def test_messages_that_come_late_make_no_parts(delay, share):
    laps, least = drive(False)
    found = late(laps.samples(), share, delay, np.random.default_rng(1))
    backend, refused = told(Backend(), laps, found)
    assert_whole(laps, backend, least, 0)
    assert not backend.snapshot().graph.firsts.size
    assert 0 < refused < share * len(found)
    # The pose of the robot waits for none of them.
    newest, backend = 0, Backend()
    for sample in found[:200]:
        moved = False
        with suppress(MessageError):
            moved = backend.add_odometry(sample)
        assert moved == (sample.stamp > newest)
        newest = max(newest, sample.stamp)
        assert backend.robot().stamp == newest


def in_order(samples, options, order):
    builder = GraphBuilder(se2, options)
    for k in order:
        builder.add_odometry(samples[k])
    return builder


@pytest.mark.parametrize('source', ['model', 'increment', 'twist'])
def test_late_messages_are_put_in_their_place_while_the_keyframe_is_open(source):
    options = GraphBuilderOptions(odometry=OdometryOptions(source))
    covariance = np.diag([1e-6, 2e-6, 1, 1, 1, 3e-6])
    poses = [se2.identity(1)]
    for _ in range(99):
        poses.append(se2.retract(poses[-1], np.array([[0.0505, 0.0, 0.005]])))
    samples = [odometry(1.0 + 0.05 * k, pose[0], covariance, covariance)
               for k, pose in enumerate(poses)]
    order = np.arange(len(samples)).reshape(-1, 10)
    order[:, [4, 5, 6]] = order[:, [6, 4, 5]]  # each tenth is a keyframe
    straight_on = in_order(samples, options, range(100))
    mixed = in_order(samples, options, order.ravel())
    mixed_track, straight_track = (one.robots[0].track for one in (mixed, straight_on))
    assert mixed.graph.n_poses == 10 and len(mixed_track) == len(straight_track) == 100
    times = np.array([sample.stamp for sample in samples])
    assert_allclose(mixed_track.at(times), straight_track.at(times), atol=1e-12)
    ours, theirs = mixed.graph.between, straight_on.graph.between
    assert_allclose(ours.measurement, theirs.measurement, atol=1e-12)
    if source != 'twist':  # which states for all the time since the message before
        assert_allclose(ours.sqrt_information, theirs.sqrt_information, rtol=1e-4, atol=1e-6)


def test_what_is_late_is_dropped_where_its_keyframe_is_closed_or_nothing_may_be_late():
    for reorder, causes in (1.0, 'after a later keyframe'), (0.0, 'is not after the last one'):
        options = replace(EVERY, odometry=OdometryOptions(reorder=reorder))
        builder = GraphBuilder(se2, options)
        for k in (0, 1, 2, 4, 5):
            builder.add_odometry(odometry(1.0 + 0.1 * k, (0.1 * k, 0.0, 0.0)))
        with pytest.raises(MessageError, match=causes) as raised:
            builder.add_odometry(odometry(1.3, (0.3, 0.0, 0.0)))
        assert raised.value.cause == 'old_stamp' and builder.graph.n_poses == 5


@pytest.mark.parametrize('back', [0.7, 1.5, 30.0])
def test_a_clock_that_is_set_back_for_good_is_no_late_message(back):
    """By less than may be late, it is only known once it has caught up, by the way made."""
    builder = GraphBuilder(se2, GraphBuilderOptions())
    for k in range(200):
        time = 100.0 + 0.05 * k - (back if k >= 100 else 0.0)
        try:
            builder.add_odometry(odometry(time, (0.05 * k, 0.0, 0.0)))
        except MessageError as error:
            assert error.cause == 'old_stamp' and back < 1
    assert builder.notes.warned == {'new_part': 1} and len(builder.robots[0].track.gaps) == 1
    assert builder.robots[0].track.last_stamp == round((109.95 - back) * 1e9)


# What is no restart


@pytest.mark.parametrize('rate', [1.0, 5.0, 20.0, 50.0])
@pytest.mark.parametrize('speed', [0.2, 1.0, 15.0])
def test_ordinary_robots_are_left_alone(rate, speed):
    """They stop, turn on the spot, back up, come home and lose messages; stamps jitter."""
    rng = np.random.default_rng(2)
    pace = np.repeat(rng.choice([0.0, 1.0, 1.0, -0.5], 40), 3 * max(round(rate), 2))
    turning = np.repeat(rng.choice([0.0, 0.0, 0.5, -0.5], 40), 3 * max(round(rate), 2))
    smooth = np.ones(max(round(rate), 1)) / max(round(rate), 1)  # it takes a second to speed up
    steps = np.stack([np.convolve(pace, smooth, 'same') * speed / rate, np.zeros(len(pace)),
                      np.convolve(turning, smooth, 'same') / rate], axis=1)
    poses = [np.zeros((1, 3))]
    for step in [*steps, *-steps[::-1]]:  # and back home all the way
        poses.append(se2.retract(poses[-1], step[None]))
    builder = GraphBuilder(se2, GraphBuilderOptions())
    for k, pose in enumerate(poses):
        if rng.random() > 0.1:
            builder.add_odometry(odometry(
                100 + (k + rng.uniform(-0.2, 0.2)) / rate, pose[0] + rng.normal(0, 1e-3, 3)))
    assert not +builder.notes.refused and not builder.notes.warned
    assert not builder.robots[0].track.gaps.size and not builder.robots[0].stream.held


@pytest.mark.parametrize('sign', ['source', 'covariance', None])
def test_signs_of_a_restart_count_where_the_pose_does_not_fit(sign):
    """A step of .4 m in .05 s, which alone may be a correction of the odometry."""
    builder, stated = GraphBuilder(se2, GraphBuilderOptions()), np.diag([1.0, 1, 0, 0, 0, 1])
    for k in range(80):
        after = k >= 40
        size = 1e-4 * (k - 40 + 1 if after and sign == 'covariance' else k + 1)
        sample = odometry(1.0 + 0.05 * k, (5 + 0.05 * k, 0.4 * after, 0.0), size * stated)
        builder.add_odometry(replace(sample, other_source=sign == 'source' and k == 40))
    assert builder.robots[0].track.gaps.size == (sign is not None)
    assert builder.notes.warned == ({'new_part': 1} if sign else {})


def test_another_source_that_goes_on_where_the_robot_is_changes_nothing():
    builder = GraphBuilder(se2, GraphBuilderOptions())
    for k in range(80):
        sample = odometry(1.0 + 0.05 * k, (5 + 0.05 * k, 0.0, 0.0))
        builder.add_odometry(replace(sample, other_source=k == 40))
    assert not builder.notes.warned and not builder.robots[0].track.gaps.size


def test_a_restart_is_the_users_to_ignore():
    laps, _ = drive(False)
    backend = Backend(BackendOptions(on_time_jump='ignore'))
    told(backend, laps, laps.restarted(TIMES['far'], 0.05, NEAR))
    assert not backend.snapshot().graph.firsts.size
    assert 'the robot is taken to be where it was' in backend.news()[0]


def unsure_at(stamps):
    """Return how often a step is said to be hardly known, of a robot that drives .05 m each."""
    builder = GraphBuilder(se2, GraphBuilderOptions())
    for time, pose in zip(stamps, straight(len(stamps), 0.05), strict=True):
        builder.add_odometry(odometry(time, pose))
    return builder.notes.warned['unsure']


@pytest.mark.parametrize('in_a_heap', [10, 25, 60])
def test_stamps_that_come_in_heaps_are_doubted_once(in_a_heap):
    """All samples of 4 s are stamped within 1.8 s; the odometry has not stood in between."""
    heap = np.linspace(0.0, 1.8, in_a_heap)
    before = 10.0 + 0.1 * np.arange(50)
    heaps = [before[-1] + 0.1 + 4.0 * k + heap for k in range(20)]
    assert unsure_at(np.concatenate((before, *heaps))) <= 1


@pytest.mark.parametrize('seconds', [1.0, 2.5, 4.0])
def test_odometry_that_stands_now_and_then_is_doubted_each_time(seconds):
    """A driver stands still, and goes on from where it was; of three times each is said."""
    times = 10.0 + 0.1 * np.arange(500)
    for k in (100, 220, 340):
        times[k:] += seconds
    assert unsure_at(times) == 3
