# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Strays among the odometry are dropped and counted, moved frames glued, robots let pass."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import (
    PERIOD,
    covariance_of,
    curve,
    drive_on,
    grown,
    loop,
    odometry,
    seconds,
    true_loop,
)

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.measurements import FASTEST, LONGEST_PAUSE
from l1slam_ros.core.graph.parts import bridged
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.online.options import GraphBuilderOptions
from l1slam_ros.io.bags.from_graph import write_graph_bag
from l1slam_ros.io.bags.to_graph import DEFAULT_TOPICS, graph_from_bag
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file

EVERY = GraphBuilderOptions(KeyframeOptions(0.0, 0.0, 0.0))
IGNORE = replace(EVERY, on_time_jump='ignore')
DAY = 86400.0


def fed(samples, verbatim=False, options=EVERY):
    """Return the builder after samples (time, pose), and which were refused at once."""
    builder, refused = GraphBuilder(se2, options, verbatim), []
    for k, (time, pose) in enumerate(samples):
        try:
            builder.add_odometry(odometry(time, pose))
        except MessageError as error:
            assert error.cause == 'old_stamp'
            refused.append(k)
    return builder, refused


def timed(poses):
    return [(1.0 + k * PERIOD, pose) for k, pose in enumerate(poses)]


def assert_same(builder, expected):
    assert_array_equal(builder.keyframe_stamps, expected.keyframe_stamps)
    assert_allclose(builder.graph.between.measurement, expected.graph.between.measurement,
                    atol=1e-12)


@pytest.mark.parametrize('ahead', [2.2, 59.0, LONGEST_PAUSE + 1, 3600.0, 1e9])
@pytest.mark.parametrize('place', [1, 2, 20])
def test_a_stamp_far_ahead_is_dropped_when_the_next_one_is_right(ahead, place):
    good = timed(curve(40))
    stray = (good[place][0] - 0.05 + ahead, good[place][1])
    builder, refused = fed(good[:place] + [stray] + good[place:])
    assert +builder.notes.refused == {'stamp_ahead': 1} and not refused
    assert not builder.robots[0].stream.held
    assert_same(builder, fed(good)[0])


def test_stamps_far_ahead_one_after_the_other():
    good = timed(curve(40))
    strays = [(1e6, good[9][1]), (2e6, good[9][1]), (1.5e6, good[9][1])]
    builder, _ = fed(good[:10] + strays + good[10:])
    assert +builder.notes.refused == {'stamp_ahead': 3}
    assert_same(builder, fed(good)[0])


@pytest.mark.parametrize('stray', [1.7e9, 1.0 + 2 * LONGEST_PAUSE])
def test_the_very_first_stamp_is_the_stray(stray):
    """A node that runs on simulated time says the wall's until it has heard the clock."""
    poses = curve(40)
    builder = GraphBuilder(se2, EVERY)
    builder.add_odometry(odometry(stray, poses[0]))
    builder.add_loop(true_loop(poses, 12, 30))
    for time, pose in timed(poses):
        builder.add_odometry(odometry(time, pose))
    assert +builder.notes.refused == {'stamp_ahead': 1}
    assert_same(builder, fed(timed(poses))[0])
    assert builder.add_due_loops() == 1


@pytest.mark.parametrize('pause', [3.0, LONGEST_PAUSE + 1, 10 * 60.0, DAY])
def test_a_robot_that_pauses_loses_nothing(pause):
    """Also with drift meanwhile, and when it stands where it stood: before, and after."""
    poses = np.insert(curve(36), [20] * 4, curve(21)[20], axis=0)
    for drift in (0.0, 3.0):
        samples = [(time + (pause if k >= 22 else 0.0), pose + [drift * (k >= 22), 0.0, 0.0])
                   for k, (time, pose) in enumerate(timed(poses))]
        builder, _ = fed(samples)
        assert builder.graph.n_poses == 40
        assert not builder.notes.refused and not builder.notes.warned
        assert_allclose(builder.keyframe_poses, [pose for _, pose in samples], atol=1e-9)


@pytest.mark.parametrize('jump', [(5e8, 0.0), (0.0, -3e5), (1.2 * FASTEST * PERIOD, 0.0)])
@pytest.mark.parametrize('count', [1, 2])
def test_a_jump_and_back_again_leaves_the_map_unharmed(jump, count):
    """Garbage is dropped, also two pieces of it that do not agree."""
    good = timed(curve(60))
    bad = [(time, (*(k + 1) * np.array(jump), 1.0)) for k, (time, _) in enumerate(good[30:32])]
    builder, _ = fed(good[:30] + bad[:count] + good[30 + count:])
    expected, _ = fed(good[:30] + good[30 + count:])
    assert +builder.notes.refused == {'jump': count} and not builder.notes.warned
    assert_same(builder, expected)
    said = builder.notes.sentences()[0]
    assert said.startswith(f'{count} message{"s" * (count > 1)} refused: odometry ')
    assert f'at stamp {seconds(4.0)} ns; expected a motion that robots make' in said


@pytest.mark.parametrize('new_frame', [(0.0, 0.0, 0.0), (7e4, -3e5, 2.0)],
                         ids=['at the identity', 'far away'])
@pytest.mark.parametrize('moving', [True, False])
def test_odometry_that_moves_its_frame_goes_on_from_where_the_robot_was(new_frame, moving):
    """The step in between says that it is not known; loops across it are carried as ever."""
    poses = curve(200)
    after = np.repeat(poses[120:121], 80, axis=0) if not moving else poses[120:]
    moved = se2.compose(np.array([new_frame]), se2.between(poses[120:121], after))
    builder, _ = fed(timed(np.concatenate((poses[:120], moved))), options=IGNORE)
    assert builder.graph.n_poses == 200 and not +builder.notes.refused
    assert builder.notes.warned == {'moved': 1}
    assert 'the robot is taken to be where it was' in builder.notes.sentences()[0]
    # The robot did not move from 119 to 120, as far as is known; then as its odometry says.
    expected = se2.compose(poses[119:120], se2.between(poses[120:121], after))
    assert_allclose(builder.keyframe_poses[:120], poses[:120], atol=1e-9)
    assert_allclose(se2.local(expected, builder.keyframe_poses[120:]), 0, atol=1e-9)
    model = OdometryOptions()
    known = np.diag(covariance_of(builder, 118))
    assert (np.sqrt(np.diag(covariance_of(builder, 119))) >= 0.1).all() and known.max() < 1e-3
    assert known.max() >= model.floor_translation**2
    offset = se2.compose(poses[119:120], se2.inverse(moved[:1]))
    assert_allclose(builder.robots[0].offset, offset, atol=1e-9)


def test_where_the_frame_moves_there_is_a_keyframe():
    """Or the transform from the map would be that of the old frame until the robot moves on."""
    builder = GraphBuilder(se2, GraphBuilderOptions())
    drive_on(builder, np.linspace((0, 0, 0), (2, 0, 0), 20), 0)
    before = builder.graph.n_poses
    for k in range(20, 24):
        builder.add_odometry(odometry(k * PERIOD, (0.0, 0.0, 0.0)))
    assert builder.graph.n_poses == before + 1
    assert builder.keyframe_stamps[-1] == seconds(2.0)
    assert_allclose(builder.keyframe_poses[-1], (2, 0, 0), atol=1e-9)
    assert_allclose(builder.robots[0].offset, [(2, 0, 0)], atol=1e-9)


@pytest.mark.parametrize('speed, period', [(40.0, 0.1), (40.0, 1.0), (40.0, 0.02), (320.0, 0.1)])
def test_a_fast_robot_is_a_robot(speed, period):
    """Also over a gap of some messages, from rest, and with two stamps a microsecond apart."""
    times = 1.0 + period * np.delete(np.arange(100), slice(40, 55))
    times = np.insert(times, 60, times[60] - 1e-6)
    samples = [(time, (speed * (time - 1.0), 0.0, 0.0)) for time in times]
    samples = [(0.7 + 0.01 * k, (0.0, 0.0, 0.0)) for k in range(20)] + samples
    builder, _ = fed(samples)
    assert builder.graph.n_poses == len(samples)
    assert not builder.notes.refused and not builder.notes.warned


def test_a_robot_that_comes_home_exactly_is_no_restart():
    """On a grid without noise, at once or after a rest."""
    steps = [(1, 0), (1, 0), (0, 0), (0, 0), (-1, 0), (-1, 0), (0, 1), (0, -1), (1, 0), (-1, 0)]
    builder, _ = fed(timed([(*at, 0.0) for at in np.cumsum([(0, 0), *steps], axis=0)]))
    assert not builder.notes.refused and not builder.notes.warned and builder.graph.n_poses == 11


def test_the_last_sample_is_held_and_said_not_lost_in_silence():
    good = timed(curve(20))
    builder, _ = fed([*good[:19], (1e6, good[19][1])])
    builder.finish()
    assert builder.graph.n_poses == 19 and not builder.notes.refused
    assert builder.robots[0].stream.reason().startswith('odometry stamp 1000000000000000 ns is ')
    with pytest.raises(MessageError, match='is not after the last one, 1000000000000000 ns'):
        builder.add_odometry(odometry(1e6, good[19][1]))
    builder.add_odometry(odometry(1e6 + 0.1, good[19][1]))
    assert builder.graph.n_poses == 21 and not builder.notes.refused
    assert not builder.robots[0].stream.held


@pytest.mark.parametrize('period', [1.0, 2.5, 30.0])
def test_slow_odometry_passes(period):
    """Messages are confirmed one by the other; the last of a recording needs none."""
    for n in 20, 21:
        builder, _ = fed([(1.0 + k * period, pose) for k, pose in enumerate(curve(n))])
        builder.finish()
        assert builder.graph.n_poses == n
        assert not builder.notes.refused and not builder.robots[0].stream.held


def test_one_old_header_is_dropped_while_another_sample_is_held():
    good = timed(curve(20))
    builder, refused = fed([*good[:10], (1e6, good[9][1]), (1.5, good[9][1]), *good[10:]])
    assert refused == [11] and +builder.notes.refused == {'stamp_ahead': 1}
    assert_same(builder, fed(good)[0])


def test_a_restored_map_does_not_begin_anew():
    first = grown(curve(60), EVERY)
    second = GraphBuilder(se2, IGNORE)
    second.restore(first.grown())
    second.add_odometry(odometry(1e6, (0.0, 0.0, 0.0)))
    for k in range(3):
        with pytest.raises(MessageError, match='is not after the last one'):
            second.add_odometry(odometry(100.0 + k, (0.0, 0.0, 0.0)))
    assert second.graph.n_poses == 61 and (np.diff(second.keyframe_stamps) > 0).all()


def test_a_graph_of_odd_messages_comes_back_from_a_bag_exactly(tmp_path):
    """Loops twice, years between keyframes, steps of kilometres, variances of 1e-12 and 1e9."""
    builder = GraphBuilder(se2, EVERY, verbatim=True)
    for k, (time, x) in enumerate([(1.0, 0.0), (1.1, 9e3), (1.2, 0.0), (1e9, 1.0), (2e9, 3.0)]):
        builder.add_odometry(odometry(time, (x, 0.0, 0.1 * k)))
    for _ in range(2):
        builder.add_loop(loop(1.0, 1.2, (1.0, 2.0, 0.3), np.diag([1e-12, 1e9, 1, 1, 1, 0.1])))
    assert builder.add_due_loops() == 2 and builder.graph.n_poses == 5
    record = GraphRecord(builder.graph, None, np.arange(5), builder.keyframe_stamps)
    write_graph_bag(tmp_path / 'bag', record)
    read = graph_from_bag(tmp_path / 'bag', None, DEFAULT_TOPICS)
    assert read.skipped == ()
    ours, theirs = builder.graph.between, read.graph.between
    assert_array_equal(read.stamps, builder.keyframe_stamps)
    assert_array_equal(np.sort(theirs.pairs, axis=0), np.sort(ours.pairs, axis=0))
    assert_allclose(theirs.measurement, ours.measurement, atol=1e-9)
    assert_allclose(theirs.sqrt_information, ours.sqrt_information, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize('name', ['intel.g2o', 'manhattan3500.g2o', 'city10000.g2o',
                                  'real/bicocca25b_0.150.g2o', 'real/bovisa06.g2o',
                                  'real/fr079.graph', 'real/kitti_00.g2o'])
def test_no_recorded_graph_is_taken_for_a_fault(datasets, name):
    """Its chain, a pose every .1 s and as fast as stamps can follow each other."""
    graph = read_graph_file(datasets / name).graph
    poses = odometry_poses(bridged(graph))
    for period in (0.1, 0.001):
        builder = GraphBuilder(se2, GraphBuilderOptions(KeyframeOptions(1e6, 0.0, 0.0)))
        for k, pose in enumerate(poses):
            builder.add_odometry(odometry(1.0 + k * period, pose))
        assert not builder.notes.refused and not builder.notes.warned
        assert not builder.robots[0].stream.held


@pytest.mark.parametrize('seed', range(30))
def test_whatever_comes_each_sample_is_used_held_or_counted(seed):
    """Stamps, poses and covariances of any size, also in a row and from the second message on."""
    rng = np.random.default_rng(seed)
    source = ('model', 'increment', 'twist')[seed % 3]
    options = GraphBuilderOptions(EVERY.keyframe, OdometryOptions(source))
    builder, old = GraphBuilder(se2, options), 0
    for k in range(200):
        time = 100.0 + k * PERIOD
        pose = (0.1 * k, 0.0, 0.0)
        kind = rng.random()
        if kind < 0.1:
            time += rng.choice((-1.0, 1.0)) * 10 ** rng.uniform(-1, 0)
        elif kind < 0.15:
            time += 10 ** rng.uniform(0.5, 9)
        elif kind < 0.25:
            pose = tuple(rng.normal(size=3) * 10 ** rng.uniform(0, 8))
        elif kind < 0.28:
            pose = (0.0, 0.0, 0.0)
        covariance = np.diag(10 ** rng.uniform(-300, 300, 6))
        try:
            builder.add_odometry(odometry(time, pose, covariance, covariance))
        except MessageError as error:
            assert error.cause == 'old_stamp'
            old += 1
        builder.add_loop(loop(time - 5.0, time, rng.normal(size=3), covariance))
        builder.add_due_loops()
    assert builder.notes.refused['jump'] + builder.notes.warned['new_part'] > 0
    lost = sum(builder.notes.refused[cause] for cause in ('stamp_ahead', 'jump', 'old_stamp'))
    assert builder.graph.n_poses + bool(builder.robots[0].stream.reason()) + lost + old == 200
    for part in np.split(builder.keyframe_stamps, builder.robots[0].track.gaps):
        assert (np.diff(part) > 0).all()
    factors = builder.graph.between
    assert np.isfinite(factors.sqrt_information).all() and np.isfinite(factors.measurement).all()
