# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Where odometry does not go on from where it was, a part of the map begins that loops join."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from lies import position_error
from numpy.testing import assert_allclose, assert_array_equal
from problems import (
    EVERY,
    PERIOD,
    curve,
    drive_on,
    hear,
    loop,
    loops_of,
    messages,
    odometry,
    seconds,
    straight,
)

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.graph.parts import odometry_gaps
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.online.keyframes import KeyframeOptions
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.running.snapshot import ACCEPTED, REJECTED
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

N, HALF = 200, 100


@pytest.fixture(scope='module')
def world():
    return simulate_world(N, 420, WorldOptions(), np.random.default_rng(3))


@pytest.fixture(scope='module')
def recording(world):
    """Samples and loops of the world, keyframe k at 1 s + k `PERIOD`."""
    return [*messages(world.graph, start=1.0)]


def fed(backend, found):
    hear(backend, found)
    backend.update(0.01)
    backend.settle()
    return backend


def moved(found, frame, back=0.0):
    """Let odometry be in another frame from the middle on, its stamps set back by some seconds."""
    start = se2.from_pose3(found[0].pose3[None])
    for message in found:
        late = message.stamp >= seconds(1.0 + HALF * PERIOD)
        if late and not isinstance(message, LoopClosure):
            pose = se2.from_pose3(message.pose3[None])
            start = pose if message.stamp == seconds(1.0 + HALF * PERIOD) else start
            pose = se2.compose(np.array([frame]), se2.between(start, pose))
            message = replace(message, pose3=se2.to_pose3(pose)[0])
        stamp = message.stamp - late * seconds(back)
        if not isinstance(message, LoopClosure):
            yield replace(message, stamp=stamp)
        elif not late or message.reference_stamp < seconds(1.0 + HALF * PERIOD - back):
            # One of a time that the second part has, too, would be of that.
            yield replace(message, stamp=stamp)


@pytest.fixture(scope='module')
def undisturbed(recording):
    return fed(Backend(EVERY), recording).poses


@pytest.mark.parametrize('frame, back', [((0.0, 0, 0), 0.0), ((5e8, 1e5, 1.0), 0.0),
                                         ((0.0, 0, 0), 5.0)],
                         ids=['restart', 'teleport', 'clock'])
def test_the_map_is_that_of_an_undisturbed_drive(world, recording, undisturbed, frame, back):
    backend = fed(Backend(EVERY), moved(recording, frame, back))
    now = backend.snapshot()
    assert now.graph.firsts.tolist() == [HALF] and odometry_gaps(now.graph).tolist() == [HALF - 1]
    assert len(now.poses) == N and (np.diff(now.stamps) < 0).sum() == (back > 0)
    assert np.bincount(backend.loop_states().state)[ACCEPTED] > 100
    # What the odometry knew of that step is lost.
    error, least = (position_error(poses, world.truth) for poses in (now.poses, undisturbed))
    assert error < 1.3 * least + 0.02


def test_played_twice_it_is_one_map_with_twice_the_odometry(world, recording, undisturbed):
    """The loops are known, and what they say is in the first part; the second is odometry."""
    backend = fed(Backend(EVERY), recording + recording)
    now, loops = backend.snapshot(), len(world.graph.between) - N + 1
    assert now.graph.firsts.tolist() == [N] and len(now.graph.between) == 2 * (N - 1) + loops
    assert backend.counts()[1] == {'repeated': loops}
    assert_allclose(now.poses[:N], undisturbed, atol=0.05)
    assert_allclose(now.poses[N], now.poses[N - 1], atol=0.05)
    steps = se2.between(now.poses[N:-1], now.poses[N + 1:])
    assert_allclose(steps, now.graph.between.measurement[now.graph.between.is_odometry][N - 1:],
                    atol=1e-6)


def test_until_loops_join_it_a_part_begins_where_the_last_one_ends():
    poses = curve(60)
    builder = GraphBuilder(se2, EVERY)
    drive_on(builder, poses[:40], start=100.0)
    drive_on(builder, poses[40:], start=101.0)
    assert builder.notes.warned == {'new_part': 1} and not +builder.notes.refused
    assert builder.robots[0].track.gaps.tolist() == [40] and builder.graph.n_poses == 60
    assert len(builder.graph.between) == 58
    expected = se2.compose(poses[39:40], se2.between(np.repeat(poses[40:41], 20, 0), poses[40:]))
    assert_allclose(builder.keyframe_poses[40:], expected, atol=1e-9)
    assert builder.keyframe_stamps[40] == seconds(101.0)
    # Each part is told of, not only the first.
    assert builder.notes.news()[0].endswith('a new part of the map begins where the last one ends')
    drive_on(builder, poses[40:], start=101.0)
    assert len(builder.notes.news()) == 1 and builder.notes.warned == {'new_part': 2}


@pytest.mark.parametrize('reference, stamp, ends', [
    (101.2, 102.4, (42, 54)), (100.3, 102.4, (3, 54)), (100.3, 100.9, (3, 9))])
def test_a_stamp_is_of_the_part_that_the_robot_is_in_if_that_goes_back_so_far(
        reference, stamp, ends):
    builder = GraphBuilder(se2, EVERY)
    drive_on(builder, curve(40), start=100.0)
    drive_on(builder, curve(20), start=101.0)
    builder.add_loop(loop(reference, stamp, (1.0, 0.0, 0.0)))
    assert builder.add_due_loops() == 1
    assert loops_of(builder)[:2] == ([ends[0]], [ends[1]])


def test_loops_that_came_before_the_clock_was_set_back_are_of_their_time():
    """Also one that waits then for a time that never comes, until the second part has it."""
    builder = GraphBuilder(se2, EVERY)
    drive_on(builder, curve(20), start=100.0)
    builder.add_loop(loop(100.1, 101.5, (1.0, 0.0, 0.0)))
    builder.add_loop(loop(100.1, 102.5, (1.0, 0.0, 0.0)))
    drive_on(builder, curve(30), start=100.0)
    builder.add_due_loops()
    assert loops_of(builder)[:2] == ([1, 21], [15, 45])


def test_near_a_gap_nothing_is_carried_across_it():
    """The time is nearer to the first keyframe of the second part than to its own."""
    builder = GraphBuilder(se2, replace(EVERY, keyframe=KeyframeOptions(0.5, 0.0, 0.0)))
    poses = straight(30, 0.1)
    poses[14:, 0] += 1e6
    drive_on(builder, poses, start=1.0)
    builder.add_loop(loop(1.0, 2.3, (1.3, 0.0, 0.0)))
    builder.add_due_loops()
    assert builder.keyframe_stamps[[2, 3]].tolist() == [seconds(2.0), seconds(2.4)]
    i, j, measurement = loops_of(builder)
    assert (i, j) == ([0], [2])
    assert_allclose(measurement, [[1.0, 0, 0]], atol=1e-9)


def test_one_old_stamp_is_dropped_and_two_near_ones_too():
    """Messages that overtook each other are no clock that was set back."""
    builder = GraphBuilder(se2, EVERY)
    refused = 0
    for time in (10.0, 10.1, 10.2, 5.0, 10.3, 9.9, 10.0, 10.4):
        try:
            builder.add_odometry(odometry(time, (time, 0.0, 0.0)))
        except MessageError as error:
            refused += error.cause == 'old_stamp'
    assert builder.notes.refused == {'old_stamp': 1} and refused == 2
    assert_array_equal(builder.keyframe_stamps, [seconds(10 + k / 10) for k in range(5)])
    assert not builder.robots[0].track.gaps.size


@pytest.mark.parametrize('choice, poses, x', [
    ('new_segment', 60, 39.0), ('reset', 20, 0.0), ('ignore', 40, None)])
def test_what_becomes_of_the_map_is_the_users_to_say(choice, poses, x):
    backend = Backend(replace(EVERY, on_time_jump=choice))
    for count in 40, 20:
        for k, pose in enumerate(straight(count)):
            refused = choice == 'ignore' and count == 20
            with pytest.raises(MessageError) if refused else nullcontext():
                backend.add_odometry(odometry(100.0 + k * PERIOD, pose))
        backend.settle()
    assert len(backend.poses) == poses
    if x is not None:
        assert_allclose(backend.poses[-20], [x, 0, 0], atol=1e-9)
        robot = backend.robot()
        assert_allclose(se2.compose(robot.map_to_odom, robot.odometry)[0, 0], x + 19, atol=1e-9)


def test_a_saved_map_keeps_its_parts(recording):
    one, second = fed(Backend(EVERY), moved(recording, (0.0, 0.0, 0.0), 5.0)), Backend(EVERY)
    first = one.snapshot()
    second.restore(one.saved())
    assert second.snapshot().graph.firsts.tolist() == [HALF]
    assert_array_equal(second.snapshot().stamps, first.stamps)
    # The odometry of the second part goes on, in its frame.
    last = one.robot()
    there = se2.compose(last.odometry, np.array([[0.1, 0.0, 0.0]]))
    second.add_odometry(odometry(last.stamp / 1e9 + PERIOD, there[0]))
    assert_allclose(second.poses[N], se2.compose(last.map_to_odom, there)[0], atol=1e-9)
    assert second.snapshot().graph.firsts.tolist() == [HALF]
    # Another recording, made earlier, is a part of its own.
    drive_on(second, straight(5), start=0.5)
    assert second.snapshot().graph.firsts.tolist() == [HALF, N + 1]
    assert_allclose(second.poses[N + 1], second.poses[N], atol=1e-9)


@pytest.mark.parametrize('choice, gaps', [
    ('new_segment', [HALF]), ('reset', []), ('ignore', [])])
def test_a_robot_carried_off_while_its_map_was_saved_is_where_loops_say(
        world, recording, choice, gaps):
    """What begins elsewhere begins a part; or, by the user's word, where the robot was."""
    unseen, found = 40, list(moved(recording, (50.0, 60.0, 1.0)))
    first, last = seconds(1.0 + HALF * PERIOD), seconds(1.0 + (HALF + unseen) * PERIOD)
    # Times that nobody saw no loop can be of.
    def seen(message):
        stamps = (getattr(message, 'reference_stamp', message.stamp), message.stamp)
        return not any(first <= stamp < last for stamp in stamps)

    one = fed(Backend(EVERY), (message for message in found if message.stamp < first))
    second = Backend(replace(EVERY, on_time_jump=choice))
    second.restore(one.saved())
    fed(second, (message for message in found if message.stamp >= last and seen(message)))
    now = second.snapshot()
    assert now.graph.firsts.tolist() == gaps and len(now.poses) == N - unseen
    if gaps:
        truth = np.delete(world.truth, np.s_[HALF:HALF + unseen], axis=0)
        assert position_error(now.poses, truth) < 0.2


# A person's hand


def struck(one):
    return replace(one, struck=True)


@pytest.mark.parametrize('when', ['before', 'after'])
@pytest.mark.parametrize('robust', [True, False])
def test_a_loop_that_is_struck_out_is_never_used(recording, when, robust):
    backend = Backend(replace(EVERY, robust=replace(EVERY.robust, enabled=robust)))
    loops = [one for one in recording if isinstance(one, LoopClosure)]
    victim = loops[40]
    if when == 'before':
        backend.add_loop(struck(victim))
    fed(backend, recording)
    if when == 'after':
        before = backend.poses
        backend.add_loop(struck(victim))
        assert backend.update(1.0) is not None
    states, ends = backend.loop_states(), [victim.reference_stamp, victim.stamp]
    row = int(np.flatnonzero((states.stamps == ends).all(axis=1))[0])
    assert states.state[row] == REJECTED
    assert (states.state == ACCEPTED).sum() >= len(loops) - 10
    assert backend.snapshot().graph.between.struck[states.rows[row]]
    if when == 'after':
        assert 0 < np.abs(backend.poses - before)[:, :2].max() < 1
    # The last word counts, though it was said before.
    for word, state in ('trusted', ACCEPTED), ('struck', REJECTED), ('trusted', ACCEPTED):
        backend.add_loop(replace(victim, **{word: True}))
        assert backend.update(1.0) is not None
        assert backend.loop_states().state[row] == state


def test_whoever_vouches_after_the_fact_adds_no_second_factor(recording):
    absurd = loop(2.0, 9.0, (50.0, 0.0, 0.0), 1e-2 * np.eye(6))
    backend = fed(Backend(EVERY), [*recording[:200], absurd])
    count = len(backend.snapshot().graph.between)
    assert backend.loop_states().state[-1] == REJECTED
    for _ in range(2):
        backend.add_loop(replace(absurd, trusted=True))
    backend.settle()
    assert backend.loop_states().state[-1] == ACCEPTED
    assert len(backend.snapshot().graph.between) == count
    backend.add_loop(absurd)
    assert backend.counts()[1] == {'repeated': 1}
