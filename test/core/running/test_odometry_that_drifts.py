# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""While driving, too, odometry that drifts is corrected once loops agree on it."""

import numpy as np
import pytest
from lies import careful_world, position_error, spoilt
from problems import EVERY

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.robust.odometry.drift import straightened
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.paper.updates import Drive

DRIFT = 0.05


@pytest.fixture(scope='module')
def bad():
    return spoilt(careful_world(400, 800), 'random', 100)


def test_it_is_corrected_while_driving_and_at_rest(bad):
    backend, errors = Backend(EVERY), []
    for sample, loops in Drive.of(straightened(bad.graph, -DRIFT)).messages:
        backend.add_odometry(sample)
        for loop in loops:
            backend.add_loop(loop)
        backend.update(0.05)
        errors.append(position_error(backend.poses, bad.truth))
        if len(errors) == 200:
            backend.settle()
    backend.settle()
    found = backend.snapshot().judgement
    assert found.drift == pytest.approx(DRIFT, abs=2e-3)
    assert position_error(backend.poses, bad.truth) < 0.5
    # Once it is known, what comes is corrected before any loop of it is judged.
    assert max(errors[:200]) > 5.0 > 1.0 > max(errors[200:])


def test_a_front_takes_it_corrected(bad):
    straight = bad.graph
    drive, backend = list(Drive.of(straightened(straight, -DRIFT)).messages), Backend(EVERY)
    for sample, loops in drive[:200]:
        backend.add_odometry(sample)
        for loop in loops:
            backend.add_loop(loop)
    backend.settle()
    while backend.update(0.1):
        pass
    drift = backend.snapshot().judgement.drift
    for sample, _ in drive[200:215]:
        backend.add_odometry(sample)
    backend._keeper.take_what_has_come(np.inf)
    poses = backend.poses
    chain = odometry_poses(straightened(straight, drift - DRIFT))
    np.testing.assert_allclose(se2.between(poses[199:200], poses[214:215]),
                               se2.between(chain[199:200], chain[214:215]), atol=1e-6)


def test_a_map_that_is_loaded_goes_on_with_it(bad):
    drive = list(Drive.of(straightened(bad.graph, -DRIFT)).messages)
    first, second = Backend(EVERY), Backend(EVERY)
    for sample, loops in drive[:300]:
        first.add_odometry(sample)
        for loop in loops:
            first.add_loop(loop)
    first.settle()
    second.restore(first.saved())
    second.update()
    np.testing.assert_allclose(second.poses, first.poses, atol=1e-6)
    assert second.snapshot().judgement.drift == first.snapshot().judgement.drift != 0
