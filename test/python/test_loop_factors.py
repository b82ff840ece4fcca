# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Loops and absolute poses become factors between the keyframes nearest to their times, once."""

from dataclasses import replace

import heard
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds import between, compose

WAITING, SUSPECT, ACCEPTED, REJECTED, EXPIRED = range(5)
IN_GRAPH = SUSPECT, ACCEPTED, REJECTED


def planar(*variances):
    """Return the covariance of a message that states these of x, y and yaw."""
    return heard.covariance6(np.diag(variances))


def absolute(time, pose, *variances, **more):
    return heard.loop(None, time, pose, planar(*variances), **more)


def adjoint(pose):
    """Return what takes small motions in the axes of a pose (3,) to those it is seen from."""
    x, y, turn = pose
    cos, sin = np.cos(turn), np.sin(turn)
    return np.array([[cos, -sin, y], [sin, cos, -x], [0, 0, 1]])


def stamps_of(*loops):
    return [[one.reference_stamp, one.stamp] for one in loops]


def listed(backend, *states):
    """Return the stamps of the loops in some states."""
    found = backend.loop_states()
    return found.stamps[np.isin(found.state, states)].tolist()


def stop_and_go():
    """Return a drive on a circle that stops for half a minute every now and then, (n, 3)."""
    angle = np.cumsum(0.005 * (np.arange(4000) // 300 % 2))
    return np.stack((10 * np.sin(angle), 10 - 10 * np.cos(angle), angle), axis=1)


PAIRS = np.array([(0, 150), (4, 151), (5, 149), (6, 152), (7, 153), (2, 199), (58, 143)])
LONG = np.random.default_rng(0).integers(2000, size=(60, 2)) + [0, 2000]


@pytest.mark.parametrize('poses, drift, pairs, atol', [
    (heard.curve(200), (0.0, 0.0, 0.0), PAIRS, 1e-9),
    (heard.curve(200), (5.0, 3.0, 1.0), PAIRS, 1e-9),
    # Of old samples those are forgotten that interpolation finds again.
    (stop_and_go(), (0.0, 0.0, 0.0), LONG, 5e-3)])
def test_a_true_loop_becomes_the_true_pose_between_the_nearest_keyframes(
        poses, drift, pairs, atol):
    """However far odometry drifts between the two times; each under the stamps it came with."""
    loops = [heard.true_loop(poses, *pair) for pair in pairs]
    early, same = heard.loop(-1e-9, 5.0, (1.0, 0.0, 0.0)), heard.loop(5.0, 5.01, (0.1, 0.0, 0.0))
    drifted = np.concatenate((poses[:100], compose(np.array(drift), poses[100:])))
    backend = heard.driven(drifted, {}, loops[0], early, *loops[1:], same)
    i, j, measurement, _ = heard.loops_of(backend)
    samples = np.round(backend.snapshot().stamps / heard.seconds(heard.PERIOD)).astype(int)
    assert_allclose(measurement, between(poses[samples[i]], poses[samples[j]]), atol=atol)
    off = np.abs(samples[:, None] - pairs.ravel()).min(axis=0).reshape(-1, 2)
    assert_array_equal(np.abs(samples[np.stack((i, j), axis=1)] - pairs), off)
    assert off.any() and backend.loop_states().stamps.tolist() == stamps_of(*loops)
    assert heard.refused(backend) == {'before_start': 1, 'same_keyframe': 1}


def test_what_waits_too_long_expires_and_may_be_sent_again():
    """A strike, too, which is no loop."""
    poses = heard.curve(100)
    long, short, longer = (heard.true_loop(poses, *pair) for pair in ((3, 60), (3, 25), (4, 70)))
    backend = heard.driven(poses[:21], {'loop.wait': 1.0}, replace(long, struck=True), long,
                           short, longer)
    assert listed(backend, WAITING) == stamps_of(long, short, longer)
    heard.drive_on(backend, poses[:31], 21)
    assert listed(backend, WAITING) == stamps_of(long, longer) and not heard.refused(backend)
    heard.drive_on(backend, poses[:32], 31)
    assert listed(backend, WAITING) == [] and heard.refused(backend) == {'expired': 3}
    assert listed(backend, EXPIRED) == stamps_of(long, longer)
    assert backend.news() == [
        'a strike from 300000000 ns to 6000000000 ns waited for odometry until 3100000000 ns; '
        'expected odometry of its times']
    heard.drive_on(backend, poses[:70], 32).add_loop(long)
    assert listed(backend, *IN_GRAPH) == stamps_of(short, long)
    assert heard.refused(backend) == {'expired': 3}


def test_other_measurements_of_a_pair_are_other_loops():
    """Another pose, another covariance, or the whole a nanosecond later; not another trust."""
    poses = heard.curve(160)
    one = heard.true_loop(poses, 7, 151, 0.01 * np.eye(6))
    others = [one, replace(one, pose3=np.nextafter(one.pose3, 9)), replace(one, trusted=True),
              replace(one, covariance=0.0101 * np.eye(6)), replace(one, stamp=one.stamp + 1)]
    backend = heard.driven(poses, heard.EVERY, *others, *others)
    # A person may say so as often as they like.
    assert heard.refused(backend) == {'repeated': 4}
    assert backend.news() == ['a loop from 700000000 ns to 15100000000 ns was sent before; '
                              'expected each loop once']
    trusted = backend.snapshot().graph.between.trusted[backend.loop_states().rows]
    assert trusted.tolist() == [True] + 3 * [False]


def test_the_covariance_is_carried_to_the_keyframe(rng):
    """Against differences: how the factor moves when the measured pose does."""
    poses, h, steps = heard.curve(200), 1e-6, np.eye(3)
    covariance = np.diag([1e-4, 3e-4, 2e-4]) + 5e-5
    true = between(poses[7], poses[151])
    backend = heard.driven(poses, {}, *(
        heard.loop(0.7, 15.1, compose(true, h * step), heard.covariance6(covariance))
        for step in (*np.zeros((1, 3)), *steps, *-steps)))
    *_, measurement, found = heard.loops_of(backend)
    off = between(measurement[0], measurement[1:])
    J = (off[:3] - off[3:]).T / (2 * h)
    assert np.abs(J - np.eye(3)).max() > 0.05  # it is carried some way indeed
    assert_allclose(found[0], J @ covariance @ J.T, rtol=1e-6, atol=1e-12)


MODEL = {'loop.sigma_translation': 0.3, 'loop.sigma_rotation': 0.2}
MODELLED = 0.09, 0.09, 0.04
SAID = ' of loop at 4000000000 ns; expected 1e-08 to 1e+06; '


@pytest.mark.parametrize('stated, source, used, said', [
    *((one, 'message', MODELLED, []) for one in heard.UNUSABLE),
    (np.eye(6), 'model', MODELLED, []),
    (planar(0.01, 0.02, 0), 'message', (0.01, 0.02, 0.04), [f'variance 0{SAID}0.04 is used']),
    (planar(0.01, 1e9, 1), 'message', (0.01, 1e6, 1), [f'variance 1e+09{SAID}1e+06 is used']),
    (planar(0.04, np.inf, 0.01), 'message', (0.04, 0, 0.01), []),])
def test_the_model_speaks_where_it_has_to(stated, source, used, said):
    poses, options = heard.curve(50), {**MODEL, 'loop.covariance_source': source}
    backend = heard.driven(poses, {**heard.EVERY, **options},
                           heard.true_loop(poses, 4, 40, stated))
    assert_allclose(heard.loops_of(backend)[3], [np.diag(used)], rtol=1e-6, atol=1e-12)
    assert backend.news() == said


def test_a_loop_that_leads_back_is_turned_round(rng):
    """The measurement inverted, the covariance seen from its other end: the same factor."""
    poses, root = heard.curve(60), 0.1 * rng.standard_normal((3, 3))
    back = heard.loop(5.0, 0.5, between(poses[50], poses[5]), heard.covariance6(root @ root.T))
    *ends, (measurement,), (covariance,) = heard.loops_of(heard.driven(poses, heard.EVERY, back))
    assert ends == [[5], [50]]
    assert_allclose(measurement, between(poses[5], poses[50]), atol=1e-9)
    Ad = adjoint(between(poses[50], poses[5]))
    assert_allclose(covariance, Ad @ root @ root.T @ Ad.T, rtol=1e-6, atol=1e-9)
    backend, unsaid = heard.begun(), replace(back, covariance=planar(1, 1, np.inf))
    assert heard.hear(backend, [unsaid]) == [
        'a loop from 5000000000 ns back to 500000000 ns does not measure all components; '
        'expected its earlier time first']


@pytest.mark.parametrize('before', [True, False])
@pytest.mark.parametrize('robust', [True, False])
def test_the_last_word_on_a_loop_counts(before, robust):
    """Before it comes and after, and though it was said before; there is no second factor."""
    poses = heard.curve(100)
    loops = [heard.true_loop(poses, k, k + 60, 1e-4 * np.eye(6)) for k in range(0, 40, 4)]
    # The times of a strike may be named either way round.
    strike = replace(loops[4], reference_stamp=loops[4].stamp, stamp=loops[4].reference_stamp,
                     struck=True)
    vouch, found = replace(loops[4], trusted=True), []
    backend = heard.driven(poses, {**heard.EVERY, 'robust.enabled': robust},
                           *([strike] if before else []), *loops)
    backend.settle()
    for word in vouch, strike, vouch, vouch:
        found.append(backend.loop_states().state[4])
        backend.add_loop(word)
        assert word is vouch or backend.update(1.0) is not None
        backend.update(1.0)
    assert found == [REJECTED if before else ACCEPTED, ACCEPTED, REJECTED, ACCEPTED]
    assert len(heard.loops_of(backend)[0]) == 10


# Absolute poses


def test_an_absolute_pose_is_a_factor_from_the_world():
    """At a keyframe as it is stated, whole or in part."""
    backend = heard.driven(
        heard.curve(30), heard.EVERY, absolute(1.0, (5, 6, 0.7), 0.04, 0.04, 0.01),
        absolute(2.0, (8, 9, 0.7), 0.04, 0.09, 0), absolute(2.0, (0, 0, 0), 0, -1, np.nan),
        absolute(2.5, (1, 2, 0.7), -1, np.inf, 0.01, trusted=True),
        absolute(2.5, (0, 0, 0), 2e6, 0, np.inf), absolute(-1.0, (0, 0, 0), 1, 1, 1))
    _, j, measurement, covariance = heard.loops_of(backend)
    assert heard.refused(backend) == {'covariance': 2, 'before_start': 1}
    # Without a heading, that of the message means nothing, and the axes are those of the map.
    assert_allclose(measurement, [[5, 6, 0.7], [8, 9, 0], [1, 2, 0.7]], atol=1e-9)
    assert_allclose(covariance, [np.diag([0.04, 0.04, 0.01]), np.diag([0.04, 0.09, 0]),
                                 np.diag([0, 0, 0.01])], atol=1e-9)
    factors = backend.snapshot().graph.between
    assert factors.is_absolute[-3:].all() and j == [10, 20, 25]
    assert factors.trusted[-3:].tolist() == [False, False, True]
    assert backend.loop_states().stamps.tolist() == [
        [heard.seconds(time)] * 2 for time in (1.0, 2.0, 2.5)]


def test_between_keyframes_it_is_carried_to_the_nearest():
    backend, poses = heard.driven(heard.curve(60), {}), heard.curve(60)
    sample = round(backend.snapshot().stamps[3] / heard.seconds(heard.PERIOD)) + 1
    heard.hear(backend, (absolute(sample * heard.PERIOD, poses[sample], 0.04, 0.09, heading)
                         for heading in (0.01, 0)))
    _, j, measurement, covariance = heard.loops_of(backend)
    assert j == [3, 3]
    assert_allclose(measurement[0], poses[sample - 1], atol=1e-9)
    J = adjoint(between(poses[sample - 1], poses[sample]))
    assert_allclose(covariance[0], J @ np.diag([0.04, 0.09, 0.01]) @ J.T)
    # Where that is from there, nobody knows without a heading: the way is noise.
    assert_allclose(measurement[1], [*poses[sample, :2], 0], atol=1e-9)
    lost = (between(poses[sample], poses[sample - 1])[:2] ** 2).mean()
    assert_allclose(covariance[1], np.diag([0.04 + lost, 0.09 + lost, 0]), atol=1e-12)
