# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Wheels that count or turn too much, or too little, are corrected by what scans measured."""

import numpy as np
import pytest
from rooms import along, box, drive

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.scans.odometry import ScanOdometry
from l1slam_ros.core.scans.points import Mount, points_of
from l1slam_ros.core.scans.wheels import Calibration

# A corridor with door frames every 3 m as far as 20 m, and bare beyond.
WALLS = np.concatenate([box(0, 0, 80, 2)] + [
    box(x, 1.8, x + 0.3, 2.0) for x in np.arange(2.0, 20.0, 3.0)])


@pytest.mark.parametrize('scale', [0.9, 1.0, 1.04])
def test_scale_and_drift_are_learnt_forwards_and_backwards(rng, scale):
    learning = Calibration()
    for k in range(200):
        moved = np.array([0.5 * (-1) ** k, 0, 0.02])
        drift = np.array([0, 0, 0.05 * moved[0] / scale + 0.01 * rng.standard_normal()])
        counted = moved / (scale, scale, 1) * (1 + 0.05 * rng.standard_normal(), 1, 1) - drift
        learning.learn(learning.corrected(counted), moved, (True, True))
    step = learning.corrected(np.array([1.0, 0.5, 0.3]))
    np.testing.assert_allclose(step, (scale, 0.5 * scale, 0.35), atol=0.02)


def test_wheels_that_stand_teach_nothing_nor_what_scans_did_not_measure():
    learning = Calibration()
    learning.learn(np.zeros(3), np.array([0.5, 0, 0]), (True, True))
    learning.learn(np.array([0.5, 0, 0]), np.array([0.6, 0, 0.1]), (False, False))
    np.testing.assert_array_equal(learning.corrected(np.ones(3)), np.ones(3))


def test_a_slip_teaches_little():
    learning = Calibration()
    learning.learn(np.array([0.5, 0, 0]), np.array([0.1, 0, 1.0]), (True, True))
    assert 0.9 < learning.corrected(np.ones(3))[0] < 1
    assert 1 < learning.corrected(np.ones(3))[2] < 1.1


@pytest.mark.parametrize('wrong', [0.95, 1.05])
def test_a_bare_corridor_after_another_is_as_long_as_it_is(wrong):
    """Wheels 5% off would have it a metre longer or shorter."""
    true = along(np.array([(3.0, 1.0), (36.0, 1.0)]), 0.3)
    scans, _ = drive(true, 1, WALLS, lambda ranges, *_: np.where(ranges < 8, ranges, np.inf))
    odometry = ScanOdometry()
    wheels = true * (wrong, 1, 1)
    for scan, pose in zip(scans, wheels, strict=True):
        step = odometry.add(scan.stamp, points_of(scan, Mount(), None), pose)
    there = se2.between(true[:1], true[-1:])[0]
    assert abs(step.pose[0] - there[0]) < 0.3
