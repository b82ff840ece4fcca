# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The houses along streets, and what a laser sees of them."""

import numpy as np
import pytest

from l1slam_ros.core.worlds.houses import Laser, houses, ranges, scans

STREETS = np.array([(0.0, 0.0), (5.0, 0.0), (5.0, 5.0), (10.0, 5.0)])


@pytest.fixture
def walls(rng):
    return houses(STREETS, 5.0, rng)


def test_a_ray_ends_at_the_first_wall_and_without_one_nowhere():
    walls = np.array([(2.0, -1.0, 2.0, 1.0), (3.0, -1.0, 3.0, 1.0)])
    np.testing.assert_allclose(
        ranges(np.zeros(2), np.array([0.0, 0.3, np.pi]), walls),
        (2.0, 2 / np.cos(0.3), np.inf))
    assert np.isinf(ranges(np.zeros(2), np.zeros(1), walls[:0])).all()


def test_a_scan_lies_on_the_walls_from_where_the_robot_is(walls, rng):
    laser, pose = Laser(rays=90, sigma=0.0, farthest=4.0), np.array([5.0, 2.0, 1.0])
    (scan,) = scans(pose[None], np.array([7]), walls, laser, rng)
    angles = pose[2] + scan.angle_min + scan.angle_increment * np.arange(90)
    exact = ranges(pose[:2], angles, walls)
    assert scan.stamp == 7 and np.isinf(scan.ranges[exact >= 4.0]).all()
    assert (exact < 4.0).sum() > 45
    np.testing.assert_allclose(scan.ranges[exact < 4.0], exact[exact < 4.0], atol=0.0051)
