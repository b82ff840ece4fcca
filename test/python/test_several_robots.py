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
from backends import EVERY, loops_by, settled
from heard import pose3, seconds
from numpy.testing import assert_allclose, assert_array_equal
from team import Restarts, Team, fill, poses_of
from worlds import between, compose

import l1slam_ros as l1


def test_a_robot_that_nothing_joins_has_its_own_map_and_moves_whole_when_a_loop_is_believed():
    team, backend = Team(lies=0, n=160, edges=500), l1.Backend(EVERY)
    joins = []
    for robot, message in team.messages():
        if isinstance(message, l1.LoopClosure) and message.robots == (0, 1):
            joins.append((robot, message))
            continue
        fill(backend, [(robot, message)])
        if message.stamp == seconds(12):  # from its first second on
            settled(backend)
    backend.settle()
    one = backend.robot(1)
    assert backend.robot(0).joined and not one.joined
    poses = poses_of(backend, 1)
    assert_allclose(poses[0], [0.0, 0.0, 0.0], atol=1e-12)
    assert_allclose(compose(one.map_to_odom, one.odometry), poses[-1:], atol=1e-9)
    assert team.error(poses, 1, seen_from=80) < 0.5
    # In its own map a pose is known as that of another robot from where it began.
    own = [np.flatnonzero(backend.snapshot().graph.robot == robot) for robot in (0, 1)]
    known = [backend.marginal_covariance(int(some[-1]), int(some[0])) for some in own]
    assert_allclose(known[0], backend.marginal_covariance(int(own[0][-1])))
    assert backend.marginal_covariance(160) is None
    metres = [np.sqrt(np.trace(one[:2, :2])) for one in known]
    assert metres[0] / 4 < metres[1] < 4 * metres[0] < 1.0
    fill(backend, joins)
    backend.settle()
    one, poses = backend.robot(1), poses_of(backend, 1)
    assert one.joined and len(joins) > 5
    assert team.error(poses, 1) < 0.7
    assert_allclose(compose(one.map_to_odom, one.odometry), poses[-1:], atol=1e-9)


def test_a_map_of_two_robots_is_saved_and_goes_on():
    """What was found as messages came is found of the saved map, too."""
    team, backend = Team(n=120, edges=400, lies=40), l1.Backend(EVERY)
    messages = team.messages()
    for some in (messages[:300], messages[300:]):
        for robot, message in some:
            fill(backend, [(robot, message)])
            if isinstance(message, l1.OdometrySample):
                backend.update(0.0)
        backend.settle()
        before, backend = backend, l1.Backend(EVERY)
        backend.restore(before.saved())
        now, then = backend.snapshot().graph, before.snapshot().graph
        assert_array_equal(now.robot, then.robot)
        assert_array_equal(now.predecessor, then.predecessor)
        assert_allclose(backend.poses, before.poses, atol=1e-9)
        for state in ('accepted', 'suspect', 'rejected', 'waiting'):
            assert loops_by(backend, state) == loops_by(before, state)
        for robot in (0, 1):
            assert_allclose(poses_of(backend, robot), poses_of(before, robot), atol=1e-9)
            assert before.robot(robot).joined and backend.robot(robot) is None
    assert len(backend.poses) == 120
    with pytest.raises(l1.L1SlamError, match='a map of SE2, expected one of SE3'):
        l1.Backend(EVERY, 3).restore(before.saved())


def test_a_reset_by_one_robot_is_one_for_all():
    team = Team(n=40, edges=60, lies=0)
    backend = l1.Backend(l1.BackendOptions.from_mapping({'on_time_jump': 'reset'}))
    fill(backend, [(robot, team.sample(20 * robot + k)) for k in range(20) for robot in (0, 1)])
    backend.settle()
    fill(backend, [(0, team.sample(k)) for k in range(5)])  # its clock was set back
    assert backend.counts().told == {'reset': 1}
    assert set(backend.snapshot().graph.robot.tolist()) == {0} and len(backend.poses) < 10
    for k in range(15, 20):
        backend.add_odometry(replace(team.sample(20 + k), stamp=seconds(40 + k)), 1)
    backend.settle()
    now = backend.snapshot()
    assert set(now.graph.robot.tolist()) == {0, 1}
    # Its first keyframe is where its odometry has it.
    first = np.argmax(now.graph.robot == 1)
    assert_allclose(poses_of(backend, 1)[0], now.odometry[first], atol=1e-12)


@pytest.mark.parametrize('robot', [-1, 'r1', None, 0.5])
def test_no_number_of_a_robot(robot):
    sample = l1.OdometrySample(1, pose3((0.0, 0.0, 0.0)), np.eye(6), np.eye(6))
    with pytest.raises(l1.L1SlamError, match='the robot is'):
        l1.Backend(EVERY).add_odometry(sample, robot)


# Robots that begin their odometry again on the way


@pytest.mark.parametrize('joined_first', [0, 1])
def test_a_new_part_stands_where_its_robot_was_and_goes_with_it(joined_first):
    """Keyframes of others come between; what joins one part moves both."""
    at, joins = 37, ([], [])
    team, backend = Restarts(at, n=240, edges=840, lies=0), l1.Backend(EVERY)

    def guess():
        """Return the step from the end of the one part to the begin of the other."""
        poses = poses_of(backend, 2)
        return between(poses[at - 1], poses[at])

    fill(backend, [one for one in team.messages() if isinstance(one[1], l1.OdometrySample)])
    for i, j, found in team.loops():
        parts = {int(team.number(k) >= at) for k in (i, j) if team.robot[k] == 2}
        if 2 in found.robots and found.robots != (2, 2):
            joins[parts.pop()].append((2, found))
        elif len(parts) < 2:
            fill(backend, [(2, found)])
    backend.settle()
    assert_allclose(guess(), 0.0, atol=1e-9)
    assert not backend.robot(2).joined
    for message in joins[joined_first]:
        fill(backend, [message])
        backend.update(0.0)
    settled(backend)
    assert_allclose(guess(), 0.0, atol=1e-9)
    assert backend.robot(2).joined
    backend.settle()
    assert_allclose(guess(), 0.0, atol=1e-9)
    fill(backend, joins[1 - joined_first])
    settled(backend)
    truth = team.truth[team.robot == 2]
    assert_allclose(guess(), between(truth[at - 1], truth[at]), atol=0.2)
