# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""When motion makes a keyframe, and what its covariance is."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import UNKNOWN, covariance6, odometry, random_information

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.online.keyframes import (
    KeyframeMotion,
    KeyframeOptions,
    OdometryOptions,
)

OFF = {'translation': 0.0, 'rotation': 0.0, 'period': 0.0}
MODEL = OdometryOptions(sigma_translation=0.1, sigma_rotation=0.2, floor_translation=0.03,
                        floor_rotation=0.04)
INCREMENT = OdometryOptions('increment')
TWIST = OdometryOptions('twist')
UNUSABLE = [np.zeros((6, 6)), -np.eye(6), np.full((6, 6), -1.0), np.full((6, 6), np.nan),
            np.full((6, 6), 9999.0), np.full((6, 6), 1e308), covariance6(np.diag([1, 1, -1]))]
UNUSABLE_NAMES = ['0', 'diagonal -1', '-1', 'nan', '9999', '1e308', 'one negative']


def motion_of(increments, options, covariances=None, twists=None, period=0.1):
    """Return the motion of increments (k, 3), one message each."""
    pose = np.zeros((1, 3))
    motion = KeyframeMotion(se2, 0, pose)
    none = [UNKNOWN] * len(increments)
    for k, (increment, covariance, twist) in enumerate(
            zip(increments, covariances or none, twists or none, strict=True), 1):
        pose = se2.compose(pose, np.array([increment], float))
        motion.add(odometry(k * period, pose[0], covariance, twist), pose, options)
    return motion


def is_keyframe(increments, time=0.0, **options):
    motion = motion_of(increments, MODEL, period=time / len(increments))
    return motion.is_keyframe(KeyframeOptions(**{**OFF, **options}))


@pytest.mark.parametrize('option, increments, due', [
    ({'translation': 0.5}, [(0.49, 0, 0)], False),
    ({'translation': 0.5}, [(0.5, 0, 0)], True),
    ({'translation': 0.5}, [(0.0, -0.3, 0), (0.0, -0.3, 0)], True),
    ({'translation': 0.5}, [(0.3, 0.4, 0)], True),
    ({'translation': 0.5}, [(0.4, 0, 0), (-0.4, 0, 0)], False),  # there and back is nowhere
    ({'translation': 0.5}, [(0.0, 0, 3.0)], False),
    ({'rotation': 0.2}, [(0.0, 0, 0.19)], False),
    ({'rotation': 0.2}, [(0.0, 0, -0.2)], True),
    ({'rotation': 0.2}, [(0.0, 0, 0.15), (0, 0, 0.15)], True),
    ({'rotation': 0.2}, [(100.0, 0, 0)], False),
])
def test_each_threshold_alone(option, increments, due):
    assert is_keyframe(increments, time=1e6, **option) == due


@pytest.mark.parametrize('time, due', [(1.99, False), (2.0, True), (3.0, True)])
def test_time_alone(time, due):
    assert is_keyframe([(0.0, 0, 0)], time, period=2.0) == due


def test_any_one_threshold_is_enough():
    thresholds = {'translation': 1.0, 'rotation': 1.0, 'period': 1.0}
    assert not is_keyframe([(0.9, 0, 0.9)], 0.9, **thresholds)
    for increment, time in ((1.1, 0, 0), 0.0), ((0.0, 0, 1.1), 0.0), ((0.0, 0, 0), 1.1):
        assert is_keyframe([increment], time, **thresholds)


def test_with_all_off_any_message_is_a_keyframe():
    assert is_keyframe([(0.0, 0, 0)], 0.0)


# The model


@pytest.mark.parametrize('increments, way, turn', [
    # 3 + 4 m and .5 + .25 rad travelled, not the 1 m and .25 rad between the ends.
    ([(3.0, 0, 0.5), (-4.0, 0, -0.25)], 0.7, 0.15), ([(0.0, 0, 0)] * 3, 0.0, 0.0)])
def test_the_model_grows_with_the_way_and_the_turn_whatever_messages_say(increments, way, turn):
    stated = [np.eye(6)] * len(increments)
    motion = motion_of(increments, MODEL, stated, stated)
    assert_allclose(motion.covariance(MODEL), np.diag(
        [way**2 + 0.03**2] * 2 + [turn**2 + 0.04**2]))


# What messages say


def test_the_covariances_of_increments_add_up_to_first_order(rng):
    """Against the Jacobian of the product by differences: sum J_k S_k J_k'."""
    increments = rng.standard_normal((5, 3))
    covariances = 1e-4 * random_information(5, rng)
    motion = motion_of(increments, INCREMENT, [covariance6(c) for c in covariances])
    h, expected = 1e-6, np.zeros((3, 3))
    for k in range(5):
        J = np.zeros((3, 3))
        for column, unit in enumerate(np.eye(3)):
            ends = []
            for sign in (1, -1):
                moved = increments.copy()
                moved[k] = se2.retract(moved[k][None], sign * h * unit[None])[0]
                ends.append(motion_of(moved, INCREMENT).pose)
            J[:, column] = (se2.local(motion.pose, ends[0])
                            - se2.local(motion.pose, ends[1]))[0] / (2 * h)
        expected += J @ covariances[k] @ J.T
    assert_allclose(motion.covariance(INCREMENT), expected, rtol=1e-5, atol=1e-12)


def test_twist_covariances_add_up_as_increments_do(rng):
    increments = rng.standard_normal((4, 3))
    covariances = [covariance6(c) for c in random_information(4, rng)]
    by_twist = motion_of(increments, TWIST, None, covariances, period=0.1)
    by_increment = motion_of(increments, INCREMENT, [0.01 * c for c in covariances])
    assert_allclose(by_twist.covariance(TWIST), by_increment.covariance(INCREMENT))


@pytest.mark.parametrize('source', ['increment', 'twist'])
@pytest.mark.parametrize('unusable', UNUSABLE, ids=UNUSABLE_NAMES)
@pytest.mark.parametrize('place', [0, 1, 2])
def test_one_unusable_covariance_and_the_model_speaks_for_the_whole_motion(
        source, unusable, place):
    options = OdometryOptions(source, 0.1, 0.2, 0.03, 0.04)
    covariances = [np.eye(6)] * 3
    covariances[place] = unusable
    motion = motion_of([(1.0, 0, 0.1)] * 3, options, covariances, covariances)
    model = np.diag([0.3**2 + 0.03**2] * 2 + [0.06**2 + 0.04**2])
    assert_allclose(motion.covariance(options), model)


@pytest.mark.parametrize('source', ['increment', 'twist'])
def test_what_covariances_leave_unset_the_model_says(source):
    """A planar front end leaves z, roll and pitch at zero; what it says of the rest counts."""
    options = OdometryOptions(source, 0.1, 0.2, 0.03, 0.04)
    stated = [covariance6(np.diag([0.01, 0.02, 0]))] * 3
    motion = motion_of([(1.0, 0, 0)] * 3, options, stated, stated, period=1.0)
    assert_allclose(motion.covariance(options), np.diag([0.03, 0.06, 0.04**2]))
    assert motion.bounded == [(0.0, 0.04**2)]


def test_a_source_changed_on_the_way_falls_back_to_the_model():
    motion = KeyframeMotion(se2, 0, np.zeros((1, 3)))
    for k, options in enumerate([MODEL, INCREMENT], 1):
        motion.add(odometry(k, (k, 0, 0), np.eye(6)), np.array([[float(k), 0, 0]]), options)
    assert_allclose(motion.covariance(MODEL)[0, 0], 0.2**2 + 0.03**2)
