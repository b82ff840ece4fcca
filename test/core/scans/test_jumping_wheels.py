# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Where the driver of the wheels begins anew the robot goes on."""

import numpy as np
import pytest
from rooms import along, drive

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.scans.front_end import ScanFrontEnd
from l1slam_ros.core.scans.wheels import Wheels

# A robot at 2 m/s, five times a second.
STAMPS = np.arange(20) * 200_000_000
WAY = np.column_stack((0.4 * np.arange(20), np.zeros(20), np.zeros(20)))


def began_anew(wheels, k):
    """Return poses (n, 3) of which those from number k on begin at the origin."""
    back = np.broadcast_to(se2.inverse(wheels[k][None]), wheels[k:].shape)
    later = se2.compose(back, wheels[k:])
    return np.concatenate((wheels[:k], later))


def followed(stamps, poses):
    """Return the poses of the way without jumps, and what was said of each."""
    wheels = Wheels()
    found, said = [], []
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        said.append(wheels.follow(stamp, pose))
        found.append(wheels.pose)
    return np.array(found), said


@pytest.mark.parametrize('k', [2, 10])
def test_a_driver_that_begins_anew_is_no_motion(k):
    away = se2.compose(np.broadcast_to(np.array([[30.0, 2.0, 1.0]]), WAY.shape), WAY)
    found, said = followed(STAMPS, began_anew(away, k))
    assert ['jump' in one for one in said] == [number == k for number in range(20)]
    # At the jump the robot goes on as fast as before.
    np.testing.assert_allclose(se2.between(np.broadcast_to(away[:1], found.shape), found), WAY,
                               atol=1e-12)


@pytest.mark.parametrize('stamps, poses', [
    (STAMPS, WAY), (STAMPS, WAY[::-1]), (STAMPS * 10, 5 * WAY),
    # Standing, then off at 4 m/s; turns on the spot; stamps that came in a heap; a world where a
    # step of 2 m and a quarter turn take .2 s.
    (STAMPS, np.maximum(WAY - WAY[10], 0) * 2), (STAMPS, se2.wrap(WAY[:, ::-1] * 2)),
    (STAMPS // 10**6, WAY), (STAMPS, 5 * WAY + (0, 0, 1.5) * (WAY > 4).any(axis=1)[:, None])])
def test_what_a_robot_does_is_no_jump(stamps, poses):
    found, said = followed(stamps, poses)
    np.testing.assert_allclose(se2.local(found, poses), 0, atol=1e-12)
    assert not any(said)


def test_scans_carry_a_robot_over_a_jump():
    true = along(np.array([(1.5, 1.5), (10.5, 1.5), (10.5, 6.5)]))
    scans, wheels = drive(true)
    wheels = began_anew(wheels, 70)  # 2 m behind the corner
    front_end = ScanFrontEnd()
    steps = [front_end.add(scan, pose) for scan, pose in zip(scans, wheels, strict=True)]
    assert sum('jump' in step.said for step in steps) == 1
    assert {keyframe.part for keyframe in front_end.keyframes} == {0}
    found = np.array([step.pose for step in steps])
    assert absolute_trajectory_error(found[:, :2], true[:, :2]) < 0.05
