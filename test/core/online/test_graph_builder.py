# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""From samples and loops to keyframes and factors, whatever comes in whichever order."""

from dataclasses import replace
from time import process_time

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import (
    PERIOD,
    UNKNOWN,
    covariance6,
    covariance_of,
    curve,
    drive_on,
    grown,
    keyframe_samples,
    loop,
    loops_of,
    odometry,
    random_information,
    seconds,
    straight,
    true_loop,
)
from scipy.spatial.transform import Rotation

from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.graph.factor_graph import WORLD
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.online.loops import loop_factors
from l1slam_ros.core.online.loops.loop_factors import LoopOptions
from l1slam_ros.core.online.options import GraphBuilderOptions

EVERY = GraphBuilderOptions(keyframe=KeyframeOptions(0.0, 0.0, 0.0))
DEFAULTS = GraphBuilderOptions()


def added(builder, *loops):
    """Add loops; return how many factors are made of those that are due."""
    for one in loops:
        builder.add_loop(one)
    return builder.add_due_loops()


def assert_true(builder, poses):
    """Every loop factor is the true relative pose of its keyframes."""
    i, j, measurement = loops_of(builder)
    keyframes = keyframe_samples(builder)
    true = se2.between(poses[keyframes[i]], poses[keyframes[j]])
    assert_allclose(se2.local(true, measurement), 0, atol=1e-9)


# Odometry


def test_snapshots_stay_as_they_were():
    builder = grown(curve(5), EVERY)
    stamps, poses = builder.keyframe_stamps, builder.keyframe_poses
    before = stamps.copy(), poses.copy()
    drive_on(builder, curve(200), 5)
    assert_array_equal(stamps, before[0])
    assert_array_equal(poses, before[1])


# Loops


@pytest.mark.parametrize('reference, sample', [
    (0, 150), (4, 151), (5, 149), (6, 152), (7, 153), (2, 199), (58, 143)])
@pytest.mark.parametrize('drift', [(0.0, 0.0, 0.0), (5.0, 3.0, 1.0)])
def test_a_true_loop_becomes_the_true_pose_between_keyframes(reference, sample, drift):
    """Whatever keyframes are nearest, and however far odometry drifts between the two times."""
    poses = curve(200)
    drifted = se2.compose(np.broadcast_to(drift, (100, 3)), poses[100:])
    builder = grown(np.concatenate((poses[:100], drifted)), DEFAULTS)
    assert added(builder, true_loop(poses, reference, sample)) == 1
    assert len(builder.loops.waiting) == 0
    assert_true(builder, poses)
    (i,), (j,), _ = loops_of(builder)
    keyframes = keyframe_samples(builder)
    assert abs(keyframes[i] - reference) == np.abs(keyframes - reference).min()
    assert abs(keyframes[j] - sample) == np.abs(keyframes - sample).min()


def test_a_loop_between_two_samples_is_interpolated():
    """On a straight line at 1 m/s: exact."""
    builder = grown([(k * PERIOD, 0.0, 0.0) for k in range(100)], DEFAULTS)
    added(builder, loop(1.03, 7.77, (6.74, 0.0, 0.0)))
    (i,), (j,), measurement = loops_of(builder)
    x = builder.keyframe_poses[:, 0]
    assert (x[i], x[j]) == (pytest.approx(1.0), pytest.approx(8.0))
    assert_allclose(measurement, [[7.0, 0, 0]], atol=1e-9)


def test_a_loop_before_its_odometry_gives_the_same_factor():
    """With every message a keyframe; else a late loop may find a nearer keyframe."""
    poses = curve(200)
    loops = [true_loop(poses, 7, 151), true_loop(poses, 33, 188), true_loop(poses, 2, 90)]
    after = grown(poses, EVERY)
    before, middle = GraphBuilder(se2, EVERY), GraphBuilder(se2, EVERY)
    for one in loops:
        before.add_loop(one)
        after.add_loop(one)
    drive_on(before, poses, 0)
    drive_on(middle, poses[:100], 0)
    for one in loops:
        middle.add_loop(one)
    drive_on(middle, poses, 100)
    for builder in (after, before, middle):
        assert builder.add_due_loops() == 3
        for ours, theirs in zip(loops_of(builder), loops_of(after), strict=True):
            assert_array_equal(ours, theirs)


def test_a_loop_expires_when_it_has_waited_too_long_and_may_be_sent_again():
    poses = curve(100)
    builder = grown(poses[:21], GraphBuilderOptions(loop=LoopOptions(wait=1.0)))
    one = true_loop(poses, 3, 60)
    builder.add_loop(one)
    for k in range(21, 31):
        builder.add_odometry(odometry(k * PERIOD, poses[k]))
        assert builder.add_due_loops() == 0
        assert len(builder.loops.waiting) == 1 and not +builder.notes.refused
    builder.add_odometry(odometry(31 * PERIOD, poses[31]))
    builder.add_due_loops()
    assert len(builder.loops.waiting) == 0 and +builder.notes.refused == {'expired': 1}
    drive_on(builder, poses[:70], 32)
    assert builder.add_due_loops() == 0 and loops_of(builder)[0] == []
    assert added(builder, one) == 1 and +builder.notes.refused == {'expired': 1}


def test_loops_for_a_robot_that_never_comes_are_bounded(monkeypatch):
    """Its own clock would let them expire. What waits for others is left alone."""
    monkeypatch.setattr(loop_factors, '_MOST_WAITING', 300)
    builder = grown(curve(20), DEFAULTS)
    own = loop(1.0, 3.0, (1.0, 0.0, 0.0))
    builder.add_loop(own)
    for k in range(2000):
        builder.add_loop(replace(loop(1.0, 1.0 + k, (1.0, 0.0, 0.0)), robot=1))
        builder.add_odometry(odometry((20 + k) * PERIOD, (0.0, 0.0, 0.0)))
    waiting, told = builder.loops.waiting, builder.notes.news()
    assert builder.notes.refused['expired'] == builder.loops.lost == 1701
    assert waiting.stamps()[1:, 1].tolist() == [seconds(1.0 + k) for k in range(1701, 2000)]
    assert waiting.stamps()[:1].tolist() == stamps_of(own)
    assert len(waiting._queues[1]._by_time) < 800
    assert sum('expected odometry of that robot' in sentence for sentence in told) == 1
    # It comes after all: those that still wait are used.
    builder.add_odometry(odometry(1700.0, (0.0, 0.0, 0.0)), 1)
    builder.add_odometry(odometry(1701.5, (0.3, 0.0, 0.0)), 1)
    assert builder.add_due_loops() > 0


@pytest.mark.parametrize('reference, time, cause', [
    (-1.0, 5.0, 'before_start'), (-5.0, -1.0, 'before_start'), (-1e-9, 9.0, 'before_start'),
    (5.0, 5.01, 'same_keyframe'), (0.0, 0.1, 'same_keyframe')])
def test_a_loop_that_can_be_no_factor_is_counted(reference, time, cause):
    builder = grown(curve(101), GraphBuilderOptions(keyframe=KeyframeOptions(0.0, 0.0, 1.0)))
    assert added(builder, loop(reference, time, (1.0, 0.0, 0.0))) == 0
    assert +builder.notes.refused == {cause: 1}
    assert len(builder.loops.waiting) == 0 and loops_of(builder)[0] == []


# What became of which loop


def stamps_of(*loops):
    return [[one.reference_stamp, one.stamp] for one in loops]


def test_each_loop_of_the_graph_has_its_row_and_the_stamps_it_came_with():
    """Its own, not those of the keyframes it was carried to; refused ones leave no row."""
    poses = curve(200)
    builder = grown(poses, DEFAULTS)
    good = [true_loop(poses, *pair) for pair in ((7, 151), (33, 188), (2, 90))]
    early, same = loop(-1.0, 5.0, (1.0, 0.0, 0.0)), loop(5.0, 5.01, (0.1, 0.0, 0.0))
    added(builder, good[0], early, good[1], same)
    beyond = poses[-1] + straight(30)[1:]
    drive_on(builder, np.concatenate((poses, beyond)), 200)
    added(builder, good[2])
    assert_true(builder, np.concatenate((poses, beyond)))
    in_graph, waiting, expired = builder.loops.stamps
    assert in_graph.tolist() == stamps_of(*good)
    assert len(waiting) == len(expired) == 0
    factors = builder.graph.between
    assert_array_equal(builder.loops.rows, np.flatnonzero(~factors.is_odometry))
    ends = builder.keyframe_stamps[factors.pairs[builder.loops.rows]]
    assert 0 < np.abs(ends - in_graph).max() < seconds(0.5)


def test_loops_that_wait_and_loops_that_expired_keep_their_stamps():
    poses = curve(100)
    builder = grown(poses[:20], GraphBuilderOptions(loop=LoopOptions(wait=2.0)))
    loops = [true_loop(poses, 3, 95), true_loop(poses, 3, 30), true_loop(poses, 4, 99)]
    added(builder, *loops)
    assert [part.tolist() for part in builder.loops.stamps] == [[], stamps_of(*loops), []]
    drive_on(builder, poses[:50], 20)
    late = true_loop(poses, 5, 60)
    added(builder, late)
    assert [part.tolist() for part in builder.loops.stamps] == [
        stamps_of(loops[1]), stamps_of(late), stamps_of(loops[0], loops[2])]
    assert +builder.notes.refused == {'expired': 2} and len(builder.loops.waiting) == 1


@pytest.mark.parametrize('late', [False, True])
def test_a_word_counts_for_the_loops_that_came_before_it(late):
    """Though all of them waited for odometry, and become factors together."""
    poses = curve(50)
    builder = grown(poses[:20 if late else 50], GraphBuilderOptions())
    one = true_loop(poses, 3, 30)
    for word in ({}, {'struck': True}, {'trusted': True, 'pose3': odometry(0, (1, 0, 0)).pose3},
                 {'pose3': odometry(0, (2, 0, 0)).pose3}):
        added(builder, replace(one, **word))
    drive_on(builder, poses, 20 if late else 50)
    builder.add_due_loops()
    factors, rows = builder.graph.between, builder.loops.rows
    assert factors.struck[rows].tolist() == [True, False, False]
    assert factors.trusted[rows].tolist() == [False, True, False]


def test_a_strike_that_waits_or_expires_is_no_loop():
    poses = curve(100)
    builder = grown(poses[:20], GraphBuilderOptions(loop=LoopOptions(wait=2.0)))
    added(builder, replace(true_loop(poses, 3, 95), struck=True))
    assert len(builder.loops.waiting) == 1 and not any(map(len, builder.loops.stamps))
    drive_on(builder, poses[:50], 20)
    builder.add_due_loops()
    assert not len(builder.loops.waiting) and not any(map(len, builder.loops.stamps))
    assert builder.notes.sentences()[0].startswith('1 message refused: a strike from 300000000 ns')


# The same loop again


@pytest.mark.parametrize('times', [2, 5, 50])
def test_a_loop_sent_again_is_used_once(times):
    """At once, while it waits, and long after; also where it was carried to other keyframes."""
    poses = curve(200)
    builder = grown(poses[:100], DEFAULTS)
    loops = [true_loop(poses, 7, 90), true_loop(poses, 33, 120)]
    for k in range(times):
        if k == times // 2:
            drive_on(builder, poses, 100)
        added(builder, *loops)
    assert len(loops_of(builder)[0]) == 2
    assert +builder.notes.refused == {'repeated': 2 * (times - 1)}
    assert builder.notes.sentences() == [
        f'{2 * (times - 1)} messages refused: a loop from 700000000 ns to 9000000000 ns was sent '
        'before; expected each loop once']


def test_other_measurements_of_a_pair_are_other_loops():
    """Another pose, another covariance, or the whole a nanosecond later; not another trust."""
    poses = curve(200)
    builder, one = grown(poses, EVERY), true_loop(poses, 7, 151, 0.01 * np.eye(6))
    others = [one, replace(one, pose3=np.nextafter(one.pose3, 9)), replace(one, trusted=True),
              replace(one, covariance=0.0101 * np.eye(6)), replace(one, stamp=one.stamp + 1)]
    assert added(builder, *others, *others) == len(others) - 1
    # A person may say so as often as they like.
    assert +builder.notes.refused == {'repeated': len(others) - 1}
    assert builder.graph.between.trusted[builder.loops.rows].tolist() == [True] + 3 * [False]


def test_a_loop_of_an_earlier_run_is_known_by_the_keyframes_it_named(rng):
    poses, covariance = curve(60), covariance6(random_information(1, rng)[0])
    first, second = grown(poses, EVERY), GraphBuilder(se2, EVERY)
    loops = [true_loop(poses, 4, 40, covariance), true_loop(poses, 3, 55)]
    added(first, *loops)
    second.restore(first.grown())
    second.add_odometry(odometry(60 * PERIOD, poses[-1]))
    new = replace(loops[0], covariance=1.01 * covariance), loop(0.0, 6.0, (1.0, 0.0, 0.0))
    assert added(second, *loops, *new) == 2 and +second.notes.refused == {'repeated': 2}
    assert second.loops.stamps[0].tolist() == stamps_of(*loops, *new)
    assert_array_equal(second.loops.rows, np.flatnonzero(~second.graph.between.is_odometry))


def cpu(call, times):
    start = process_time()
    for _ in range(times):
        call()
    return process_time() - start


def test_loops_that_wait_or_expired_cost_nothing():
    """4,000 of each, against one that waits; looking through them takes 100 times as long."""
    idle = grown(curve(20), DEFAULTS)
    idle.add_loop(loop(1.0, 1e6, (1.0, 0.0, 0.0)))
    busy = grown(curve(20), GraphBuilderOptions(loop=LoopOptions(wait=100.0)))
    added(busy, *(loop(1.0, 1e5 + k, (1.0, 0.0, 0.0)) for k in range(4000)))
    drive_on(busy, np.zeros((2000, 3)), 20)
    added(busy, *(loop(1.0, 2e5 + k, (1.0, 0.0, 0.0)) for k in range(4000)))
    assert busy.notes.refused['expired'] == len(busy.loops.waiting) == 4000
    assert [len(part) for part in busy.loops.stamps] == [0, 4000, 4000]
    assert cpu(busy.add_due_loops, 300) < 10 * cpu(idle.add_due_loops, 300)
    assert cpu(lambda: busy.loops.stamps, 300) < 50 * cpu(lambda: idle.loops.stamps, 300)


# The covariance of loops


def test_the_covariance_is_carried_to_the_keyframe(rng):
    """Against differences: how the factor moves when the measured pose does."""
    poses, covariance = curve(200), 1e-4 * random_information(1, rng)[0]
    reference = 7
    sample = 151
    h = 1e-6

    def measured(step):
        builder = grown(poses, DEFAULTS)
        true = se2.between(poses[reference][None], poses[sample][None])
        added(builder, loop(reference * PERIOD, sample * PERIOD,
                            se2.retract(true, step[None])[0], covariance6(covariance)))
        return builder, loops_of(builder)[2]

    builder, middle = measured(np.zeros(3))
    columns = [(se2.local(middle, measured(h * unit)[1])
                - se2.local(middle, measured(-h * unit)[1]))[0] / (2 * h) for unit in np.eye(3)]
    J = np.stack(columns, axis=1)
    assert np.abs(J - np.eye(3)).max() > 0.05  # it is carried some way indeed
    assert_allclose(covariance_of(builder, -1), J @ covariance @ J.T, rtol=1e-6, atol=1e-12)


MODEL = LoopOptions(sigma_translation=0.3, sigma_rotation=0.2)
ALWAYS_MODEL = LoopOptions('model', 0.3, 0.2)


@pytest.mark.parametrize('stated, options', [
    (UNKNOWN, MODEL), (-np.eye(6), MODEL), (np.full((6, 6), np.nan), MODEL),
    (np.full((6, 6), 9999.0), MODEL), (np.full((6, 6), 1e308), MODEL), (np.eye(6), ALWAYS_MODEL),
], ids=['0', '-1', 'nan', '9999', '1e308', 'as told'])
def test_the_model_speaks_where_it_has_to(stated, options):
    builder = grown(curve(50), GraphBuilderOptions(EVERY.keyframe, loop=options))
    added(builder, true_loop(curve(50), 4, 40, stated))
    assert_allclose(covariance_of(builder, -1), np.diag([0.09, 0.09, 0.04]), atol=1e-12)


def test_what_a_loop_leaves_unset_the_model_says():
    builder = grown(curve(50), GraphBuilderOptions(EVERY.keyframe, loop=MODEL))
    added(builder, true_loop(curve(50), 4, 40, covariance6(np.diag([0.01, 0.02, 0]))))
    assert_allclose(covariance_of(builder, -1), np.diag([0.01, 0.02, 0.04]), atol=1e-12)
    (told,) = builder.notes.sentences()
    assert told.startswith('variance 0 of loop at') and told.endswith('0.04 is used')


# What must not break it


@pytest.mark.parametrize('options', [
    GraphBuilderOptions(odometry=OdometryOptions(sigma_translation=1e6)),
    GraphBuilderOptions(odometry=OdometryOptions(sigma_translation=0.0, floor_translation=1e-9)),
    GraphBuilderOptions(loop=LoopOptions('model', 1e-9, 0.05)),
], ids=['sigma', 'floor', 'loop'])
def test_every_allowed_model_works(options):
    builder = grown([(10.0 * k, 0, k) for k in range(3)], options)
    assert added(builder, loop(0.0, 0.2, (20.0, 0.0, 2.0))) == 1


# Absolute poses


def absolute(time, pose, variances=(0.04, 0.04, 0.01), **more):
    """Return the robot at `pose` (3,) in the map frame at a time [s]."""
    return LoopClosure(None, seconds(time), se2.to_pose3(np.array(pose, float)),
                       covariance6(np.diag(variances)), **more)


def test_an_absolute_pose_is_a_factor_from_the_world():
    """At a keyframe as it is stated, whole or in part."""
    poses = curve(30)
    builder = grown(poses, EVERY)
    assert added(builder, absolute(1.0, (5, 6, 0.7)),
                 absolute(2.0, (8, 9, 0.7), (0.04, 0.09, 0)),
                 absolute(2.5, (1, 2, 0.7), (-1, np.inf, 0.01), trusted=True)) == 3
    i, j, measurement = loops_of(builder)
    assert i == [WORLD] * 3 and j == [10, 20, 25]
    # Without a heading, that of the message means nothing, and the axes are those of the map.
    assert_allclose(measurement, [[5, 6, 0.7], [8, 9, 0], [1, 2, 0.7]], atol=1e-9)
    factors = builder.graph.between
    assert_allclose(factors.sqrt_information[-3:], [
        np.diag([5, 5, 10]), np.diag([5, 10 / 3, 0]), np.diag([0, 0, 10])], atol=1e-9)
    assert factors.trusted[-3:].tolist() == [False, False, True]
    in_graph, waiting, _ = builder.loops.stamps
    assert in_graph.tolist() == [[seconds(t)] * 2 for t in (1.0, 2.0, 2.5)] and not len(waiting)


def test_between_keyframes_it_is_carried_to_the_nearest(rng):
    poses = curve(60)
    builder = grown(poses, GraphBuilderOptions())
    at = keyframe_samples(builder)[3] + 1
    way = se2.between(poses[at:at + 1], poses[at - 1:at])
    added(builder, *(absolute(at * PERIOD, poses[at], (0.04, 0.09, heading))
                    for heading in (0.01, 0)))
    _, j, measurement = loops_of(builder)
    assert j == [3, 3]
    assert_allclose(measurement[0], poses[at - 1], atol=1e-9)
    Ad = se2.adjoint(se2.inverse(way))[0]
    rows = len(builder.graph.between) - 2, len(builder.graph.between) - 1
    assert_allclose(covariance_of(builder, rows[0]), Ad @ np.diag([0.04, 0.09, 0.01]) @ Ad.T)
    # Where that is from there, nobody knows without a heading: the way is noise.
    assert_allclose(measurement[1], [*poses[at, :2], 0], atol=1e-9)
    lost = (way[0, :2] ** 2).mean()
    root = builder.graph.between.sqrt_information[rows[1]]
    assert_allclose(np.diag(root)[:2] ** -2, [0.04 + lost, 0.09 + lost])


def test_absolute_poses_wait_expire_and_come_once():
    poses = curve(30)
    builder = grown(poses[:10], EVERY)
    there = (5, 6, 0.7)
    assert added(builder, absolute(1.5, there)) == 0 and len(builder.loops.waiting) == 1
    drive_on(builder, poses, 10)
    assert added(builder, absolute(1.5, there), absolute(-1.0, there),
                 absolute(1.5, there, (0, -1, np.nan)), absolute(1.5, there, (2e6, 0, np.inf)),
                 absolute(90.0, there)) == 1
    assert builder.notes.refused == {'repeated': 1, 'before_start': 1, 'covariance': 2}
    drive_on(builder, np.repeat(poses[-1:], 150, axis=0), 30)
    assert builder.add_due_loops() == 0 and builder.notes.refused['expired'] == 1


def test_a_loop_may_leave_components_unsaid():
    builder = grown(curve(30), EVERY)
    added(builder, loop(0.5, 2.0, (1, 2, 0.3), covariance6(np.diag([0.04, np.inf, 0.01]))))
    assert_allclose(builder.graph.between.sqrt_information[-1], np.diag([5, 0, 10]))


@pytest.mark.parametrize(('manifold', 'slope', 'mounted', 'says'), [
    (se2, 0.1, 0.0, 'has left the plane by 0.5'), (se2, 0.0, 0.3, ''), (se2, 0.01, 0.3, ''),
    (se3, 0.1, 0.3, '')])
def test_a_slope_is_said_where_it_is_dropped(manifold, slope, mounted, says):
    """Of a sensor that is mounted high and tilted, what changes is; by then it is half a metre."""
    builder = GraphBuilder(manifold, GraphBuilderOptions())
    turn = Rotation.from_euler('ZY', [[0.1 * k, mounted - slope] for k in range(20)]).as_quat()
    for k in range(20):
        pose3 = np.array([k * np.cos(slope), 0.0, mounted + k * np.sin(slope), *turn[k]])
        builder.add_odometry(OdometrySample(seconds(k), pose3, np.eye(6), np.eye(6)))
    sentences = builder.notes.sentences()
    assert len(sentences) == bool(says)
    if says:
        assert says in sentences[0] and 'dimension 3' in sentences[0]
