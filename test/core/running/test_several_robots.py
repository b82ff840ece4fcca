# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Several robots in one back end: their maps, what joins them, and what is saved of them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import seconds
from team import Team, believed_by

from l1slam_ros.core.errors import OptionError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.core.running.keeper import schedule
from l1slam_ros.core.running.robot_maps import Joins, map_ends
from l1slam_ros.io.graphs.saved_map import load_map, save_map

EVERY = BackendOptions.from_mapping({
    'keyframe': {'translation': 0.0, 'rotation': 0.0}, 'on_time_jump': 'ignore',
    'odometry': {'covariance_source': 'increment'}})

@pytest.mark.parametrize('late', [0, 5])
def test_the_loops_that_batch_believes_are_believed_interleaved(late):
    team, backend = Team(), Backend(EVERY)
    team.fill(backend, late)
    backend.settle()
    now = backend.snapshot()
    assert now.graph.n_poses == 400 and len(now.graph.firsts) == 1
    assert np.count_nonzero(np.diff(now.graph.robot)) > 300
    expected, found = team.believed(), believed_by(now)
    assert len(expected) > 200 and len(expected ^ found) <= 0.01 * len(expected)
    assert all(one.joined for one in now.robot_maps.values())
    for robot in (0, 1):
        keyframes, poses = now.poses_in_map(robot)
        truth = se2.between(np.tile(team.truth[:1], (200, 1)), team.truth[team.robot == robot])
        assert np.abs(poses - truth)[:, :2].max() < 0.7


def test_a_robot_that_nothing_joins_has_its_own_map_and_moves_whole_when_a_loop_is_believed():
    team, backend = Team(lies=0, n=160, edges=500), Backend(EVERY)
    joins = []
    for robot, message in team.messages():
        if isinstance(message, OdometrySample):
            backend.add_odometry(message, robot)
            if message.stamp == seconds(12):  # from its first second on
                while backend.update(1.0) is not None:
                    pass
        elif message.robots == (0, 1):
            joins.append(message)
        else:
            backend.add_loop(message)
    backend.settle()
    now, one = backend.snapshot(), backend.robot(1)
    assert backend.robot(0).joined and not one.joined
    keyframes, poses = now.poses_in_map(1)
    assert_allclose(poses[0], [0.0, 0.0, 0.0], atol=1e-12)
    assert_allclose(se2.compose(one.map_to_odom, one.odometry), poses[-1:], atol=1e-9)
    shape = se2.between(np.tile(team.truth[80:81], (80, 1)), team.truth[80:])
    assert np.abs(poses - shape)[:, :2].max() < 0.5
    # In its own map a pose is known as that of another robot from where it began.
    known = [backend.marginal_covariance(int(own[-1]), int(own[0])) for own in (
        now.poses_in_map(0)[0], keyframes)]
    assert_allclose(known[0], backend.marginal_covariance(now.poses_in_map(0)[0][-1]))
    metres = [np.sqrt(np.trace(one[:2, :2])) for one in known]
    assert metres[0] / 4 < metres[1] < 4 * metres[0] < 1.0
    for loop in joins:
        backend.add_loop(loop)
    backend.settle()
    now, one = backend.snapshot(), backend.robot(1)
    assert one.joined and len(joins) > 5
    poses = now.poses_in_map(1)[1]
    truth = se2.between(np.tile(team.truth[:1], (80, 1)), team.truth[80:])
    assert np.abs(poses - truth)[:, :2].max() < 0.7
    assert_allclose(se2.compose(one.map_to_odom, one.odometry), poses[-1:], atol=1e-9)
    assert_array_equal(keyframes, now.poses_in_map(1)[0])


def test_what_joins_robots_is_the_same_found_as_it_comes_and_found_anew(monkeypatch):
    """Three robots, with lies: tables grow, and are judged anew."""
    found, ends = [], Joins.ends

    def both(self, seen, table, poses, front):
        goes_on = self._table is not None and table.continues(self._table)
        quick, slow = ends(self, seen, table, poses, front), map_ends(
            seen, poses, front, table.accepted)
        assert {k: one.joined for k, one in quick.items()} == {
            k: one.joined for k, one in slow.items()}
        assert_array_equal(*(np.concatenate([one.pose for one in all_.values()])
                             for all_ in (quick, slow)))
        found.append((sum(one.joined for one in quick.values()), goes_on))
        return quick

    monkeypatch.setattr(Joins, 'ends', both)
    team, backend = Team(n=180, edges=600, lies=60, robots=3), Backend(EVERY)
    messages = team.messages()
    for k, (robot, message) in enumerate(messages):
        if k in (len(messages) // 10, len(messages) // 2):
            backend.settle()
        if isinstance(message, OdometrySample):
            backend.add_odometry(message, robot)
            backend.update(0.0)
        else:
            backend.add_loop(message)
    backend.settle()
    assert {1, 3} <= {joined for joined, _ in found}
    assert {True, False} == {goes_on for _, goes_on in found[1:]}


def test_a_front_takes_nothing_of_more_than_it_would_take_while_that_is_judged(monkeypatch):
    """As when two robots meet: what it took would be gone with it."""
    team, backend = Team(lies=0, n=160, edges=500), Backend(EVERY)
    messages = team.messages()
    for robot, message in messages[:200]:
        if isinstance(message, OdometrySample):
            backend.add_odometry(message, robot)
        else:
            backend.add_loop(message)
    backend.settle()
    front, judge = backend._keeper._front, backend._updates._workers.judge
    known = front.rows
    robot, sample = next((robot, message) for robot, message in messages[200:]
                         if isinstance(message, OdometrySample))
    backend.add_odometry(sample, robot)
    monkeypatch.setattr(schedule, 'MOST_ROWS', 0)
    judge.busy = True
    backend.update(0.0)
    assert backend._keeper._front is front and front.rows == known
    judge.busy = False
    backend.update(0.0)
    assert front.rows == known + 1
    backend.close()


def test_a_map_of_two_robots_is_saved_and_goes_on(tmp_path):
    team, backend = Team(n=120, edges=400, lies=40), Backend(EVERY)
    messages = team.messages()
    for some in (messages[:300], messages[300:]):
        for robot, message in some:
            if isinstance(message, LoopClosure):
                backend.add_loop(message)
            else:
                backend.add_odometry(message, robot)
        backend.settle()
        save_map(tmp_path / 'map.g2o', backend.saved())
        before, backend = backend, Backend(EVERY)
        backend.restore(load_map(tmp_path / 'map.g2o')[0])
        now, then = backend.snapshot(), before.snapshot()
        assert_array_equal(now.graph.robot, then.graph.robot)
        assert_array_equal(now.graph.predecessor, then.graph.predecessor)
        assert_allclose(now.poses, then.poses, atol=1e-9)
        for robot in (0, 1):
            assert_allclose(now.poses_in_map(robot)[1], then.poses_in_map(robot)[1], atol=1e-9)
        assert_array_equal(now.loop_robots[0], then.loop_robots[0])
        assert_array_equal(now.loop_states().state, then.loop_states().state)
    assert now.graph.n_poses == 120


def test_a_robot_comes_late_and_may_be_any(tmp_path):
    """The second one alone, too: what the map is of is said by its number."""
    team, backend = Team(lies=0, n=80, edges=240), Backend(EVERY)
    for k in range(40, 80):
        backend.add_odometry(team.sample(k), 1)
    backend.settle()
    assert backend.robot() is None and backend.robot(1) is not None
    save_map(tmp_path / 'map.g2o', backend.saved())
    backend = Backend(EVERY)
    backend.restore(load_map(tmp_path / 'map.g2o')[0])
    assert (backend.snapshot().graph.robot == 1).all()
    for k in range(40):
        backend.add_odometry(team.sample(k), 0)
    for _, _, loop in team.loops():
        backend.add_loop(loop)
    backend.settle()
    now = backend.snapshot()
    assert backend.robot(0).joined and now.robot_maps[1].joined
    poses = now.poses_in_map(0)[1]
    assert_allclose(poses[0], [0.0, 0.0, 0.0], atol=1e-12)
    for robot in (0, 1):
        truth = se2.between(np.tile(team.truth[:1], (40, 1)), team.truth[team.robot == robot])
        assert np.abs(now.poses_in_map(robot)[1] - truth)[:, :2].max() < 0.7


def test_a_reset_by_one_robot_is_one_for_all():
    reset = BackendOptions.from_mapping({'on_time_jump': 'reset'})
    team, backend = Team(n=40, edges=60, lies=0), Backend(reset)
    for k in range(20):
        backend.add_odometry(team.sample(k), 0)
        backend.add_odometry(team.sample(20 + k), 1)
    backend.settle()
    for k in range(5):  # its clock was set back
        backend.add_odometry(team.sample(k), 0)
    now = backend.snapshot()
    assert set(now.graph.robot.tolist()) == {0} and len(now.poses) == now.graph.n_poses < 10
    for k in range(15, 20):
        backend.add_odometry(replace(team.sample(20 + k), stamp=seconds(40 + k)), 1)
    backend.settle()
    now = backend.snapshot()
    assert set(now.graph.robot.tolist()) == {0, 1}
    # Its first keyframe is where its odometry has it.
    keyframes, poses = now.poses_in_map(1)
    assert_allclose(poses[0], now.odometry[keyframes[0]], atol=1e-12)


@pytest.mark.parametrize('robot', [-1, 'r1', None, 0.5])
def test_no_number_of_a_robot(robot):
    team = Team(n=4, edges=4, lies=0)
    with pytest.raises(OptionError, match='the robot is'):
        Backend(EVERY).add_odometry(team.sample(0), robot)
