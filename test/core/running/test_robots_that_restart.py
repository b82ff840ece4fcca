# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Three robots, in the plane and in space, of which some begin their odometry again on the way."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import EVERY, seconds
from team import Team, believed_by

from l1slam_ros.core.graph.factor_graph import NO_PREDECESSOR
from l1slam_ros.core.graph.measurements import OdometrySample
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.running.backend import Backend

# Stamps begin here, so that a clock may be set back.
_BEGIN, _BACK = seconds(2000), seconds(1000)


class Restarts:
    """
    A team whose robots 1 and 2 begin again at some keyframe of theirs, far off in their odometry.

    The clock of robot 2 is set back by then, if it is to be.
    """

    def __init__(self, at, back=False, **of_team):
        self.team = Team(robots=3, **of_team)
        self.at = at
        self.back = back
        manifold = self.manifold = self.team.manifold
        far = np.linspace(0.3, 0.1, manifold.TANGENT_SIZE)
        far[:2] = 300.0, 200.0
        self.far = manifold.retract(manifold.identity(1), far[None])
        self.firsts = [int(np.argmax(self.team.robot == robot)) + at for robot in (1, 2)]

    def number(self, stamp):
        """Return which keyframe of its robot a message of the team is of."""
        return stamp // seconds(1) - 10

    def stamp(self, robot, stamp):
        back = self.back and robot == 2 and self.number(stamp) >= self.at
        return stamp + _BEGIN - _BACK * back

    def messages(self):
        """Yield robot and message as they come; nobody names times of a clock that is no more."""
        now = 0
        for robot, message in self.team.messages():
            if isinstance(message, OdometrySample):
                now, pose3 = self.number(message.stamp), message.pose3
                if robot and now >= self.at:
                    pose3 = self.manifold.to_pose3(self.manifold.compose(
                        self.far, self.manifold.from_pose3(pose3[None])))[0]
                yield robot, replace(message, pose3=pose3, stamp=self.stamp(robot, message.stamp))
            elif not (self.back and now >= self.at and any(
                    one == 2 and self.number(stamp) < self.at
                    for one, stamp in zip(message.robots, message.stamps, strict=True))):
                one, other = map(self.stamp, message.robots, message.stamps)
                yield robot, replace(message, reference_stamp=one, stamp=other)

    def believed(self):
        """Return what the batch believes of all, where nothing is known of the restarts."""
        factors, robot = self.team.factors, self.team.robot
        known = np.ones(len(factors), bool)
        known[factors.step_to[self.firsts]] = False
        graph = self.team.graph.subset(known)
        graph.follow(np.array(self.firsts), NO_PREDECESSOR)
        rows = robust_solve(graph)[0].accepted & ~graph.between.is_odometry
        return {(int(robot[i]), int(robot[j]), self.stamp(robot[i], self.team.stamp(i)),
                 self.stamp(robot[j], self.team.stamp(j)))
                for i, j in zip(graph.between.i[rows], graph.between.j[rows], strict=True)}


def add(backend, robot, message):
    if isinstance(message, OdometrySample):
        backend.add_odometry(message, robot)
    else:
        backend.add_loop(message)


@pytest.mark.parametrize(('world', 'most'), [('streets', 0.5), ('building', 0.8)])
def test_three_robots_that_restart_have_the_loops_of_the_batch(world, most):
    drive = Restarts(30, back=True, n=180, edges=630, lies=60, world=world)
    team, manifold = drive.team, drive.manifold
    backend = Backend(EVERY, 2 if world == 'streets' else 3)
    for robot, message in drive.messages():
        add(backend, robot, message)
        if isinstance(message, OdometrySample) and robot == 0:
            backend.update(0.0)
    backend.settle()
    now = backend.snapshot()
    assert now.graph.robot[now.graph.firsts].tolist() == [1, 2, 1, 2]
    assert backend.counts().told == {'new_part': 2}
    came = {(*robots, *stamps) for robots, stamps in zip(
        now.loop_robots[0].tolist(), now.loop_states().stamps.tolist(), strict=False)}
    expected = drive.believed() & came
    assert len(expected) > 300 and len(expected ^ believed_by(now)) <= 0.01 * len(expected)
    for robot in range(3):
        poses, truth = now.poses_in_map(robot)[1], team.truth[team.robot == robot]
        truth = manifold.between(np.broadcast_to(team.truth[:1], truth.shape), truth)
        assert now.robot_maps[robot].joined and len(poses) == 60
        assert np.abs(manifold.positions(poses) - manifold.positions(truth)).max() < most


@pytest.mark.parametrize('joined_first', [0, 1])
def test_a_new_part_stands_where_its_robot_was_and_goes_with_it(joined_first):
    """Keyframes of others come between; what joins one part moves both."""
    drive = Restarts(37, n=240, edges=840, lies=0)
    backend = Backend(EVERY)
    at = 37
    joins = ([], [])

    def guess():
        """Return the step from the end of the one part to the begin of the other."""
        poses = backend.snapshot().poses_in_map(2)[1]
        return drive.manifold.between(poses[at - 1:at], poses[at:at + 1])[0]

    def join(part):
        """Let the loops come that join a part, and each be used at once."""
        for robot, message in joins[part]:
            add(backend, robot, message)
            backend.update(0.05)
        while backend.update(1.0):
            pass

    for robot, message in drive.messages():
        if isinstance(message, OdometrySample):
            add(backend, robot, message)
            backend.update(0.0)
            continue
        parts = {int(drive.number(stamp - _BEGIN) >= at) for one, stamp in zip(
            message.robots, message.stamps, strict=True) if one == 2}
        if 2 in message.robots and {*message.robots} != {2}:
            joins[parts.pop()].append((robot, message))
        elif len(parts) < 2:
            add(backend, robot, message)
    backend.settle()
    assert_allclose(guess(), 0.0, atol=1e-9)
    assert not backend.robot(2).joined
    join(joined_first)
    assert_allclose(guess(), 0.0, atol=1e-9)
    assert backend.robot(2).joined
    backend.settle()
    assert_allclose(guess(), 0.0, atol=1e-9)
    join(1 - joined_first)
    truth = drive.team.truth[drive.team.robot == 2]
    assert_allclose(guess(), drive.manifold.between(truth[at - 1:at], truth[at:at + 1])[0],
                    atol=0.2)
