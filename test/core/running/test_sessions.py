# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A map that is loaded, and a drive that begins elsewhere on another day."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from problems import EVERY, seconds
from team import Team, believed_by

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.measurements import OdometrySample
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.io.graphs.saved_map import load_map, save_map

_DAY = seconds(86400)
_FAR = np.array([[500.0, 300.0, 1.0]])
# Loops of one day that agree on a turned and moved map, between keyframes of it.
_LIES, _MOVED = [(k, 80 + k) for k in range(6)], np.array([[0.9, -0.6, 0.06]])


class Days:
    """The two halves of a world as drives of one robot, the second one on the next day."""

    def __init__(self):
        self.team = Team(n=240, edges=840, lies=100)

    def stamps(self, loop):
        return tuple(stamp + _DAY * robot
                     for robot, stamp in zip(loop.robots, loop.stamps, strict=True))

    def drive(self, backend, day):
        """Let the odometry of a day come, and the loops that have an end there, as they do."""
        for robot, found in self.team.messages():
            if isinstance(found, OdometrySample):
                if robot == day:
                    pose3 = se2.to_pose3(se2.compose(
                        _FAR if day else se2.identity(1), se2.from_pose3(found.pose3[None])))[0]
                    backend.add_odometry(replace(
                        found, stamp=found.stamp + _DAY * day, pose3=pose3))
                    backend.update(0.0)
            # Of the first day only what it says falsely is told.
            elif day == max(found.robots) > 0:
                reference, stamp = self.stamps(found)
                backend.add_loop(replace(found, reference_stamp=reference, stamp=stamp, robot=0,
                                         reference_robot=None))

    def lies(self):
        """Return the loops of the first day that agree on a false map, as they are sent."""
        team, (*_, (_, _, like)) = self.team, self.team.loops()
        for i, j in _LIES:
            Z = se2.between(team.truth[i][None], se2.compose(_MOVED, team.truth[j][None]))
            yield replace(like, reference_stamp=team.stamp(i), stamp=team.stamp(j),
                          pose3=se2.to_pose3(Z)[0], robot=0, reference_robot=None)

    def is_false(self, stamps):
        return {(self.team.stamp(i), self.team.stamp(j)) for i, j in _LIES} & stamps


def test_a_drive_from_elsewhere_joins_the_loaded_map_and_what_that_believed_is_doubted(tmp_path):
    days, backend = Days(), Backend(EVERY)
    days.drive(backend, 0)
    for loop in days.lies():
        backend.add_loop(loop)
    backend.settle()
    believed = {found[2:] for found in believed_by(backend.snapshot())}
    assert len(days.is_false(believed)) == len(_LIES)
    save_map(tmp_path / 'map.g2o', backend.saved())
    first, backend = backend.snapshot().poses, Backend(EVERY)
    backend.restore(load_map(tmp_path / 'map.g2o')[0])
    assert_allclose(backend.poses, first, atol=1e-9)
    days.drive(backend, 1)
    backend.settle()
    now, believed = backend.snapshot(), {found[2:] for found in believed_by(backend.snapshot())}
    assert now.graph.n_poses == 240 and now.graph.firsts.tolist() == [120]
    assert backend.counts().told == {'new_part': 1}
    assert len(believed) > 300 and not days.is_false(believed)
    truth = se2.between(np.tile(days.team.truth[:1], (240, 1)), days.team.truth)
    assert np.abs(now.poses - truth)[:, :2].max() < 0.7
    save_map(tmp_path / 'map.g2o', backend.saved())
    backend = Backend(EVERY)
    backend.restore(load_map(tmp_path / 'map.g2o')[0])
    assert_allclose(backend.poses, now.poses, atol=1e-9)
