# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Messages in: rosbags' and rclpy's alike; garbage is refused under its cause."""

import math

import numpy as np
import pytest
from messages import header, odometry, of_rosbags, pose_with_covariance

from l1slam_ros.core.errors import MessageError
from l1slam_ros.io.messages.conversion import (
    absolute_pose,
    loop_closure,
    odometry_sample,
    reference_frame_id,
    stamp_of,
)

NS = 10**9


def of_rclpy(name, **fields):
    package, _, leaf = name.split('/')
    return getattr(pytest.importorskip(f'{package}.msg'), leaf)(**fields)


@pytest.fixture(params=[of_rosbags, of_rclpy])
def new(request):
    """Return a function that makes a message of either library from its fields."""
    return request.param


def loop(new, frame='base_link@10.000000007', **pose):
    return new('geometry_msgs/msg/PoseWithCovarianceStamped', header=header(new, frame=frame),
               pose=pose_with_covariance(new, **pose))


def cause_of(call, *arguments):
    with pytest.raises(MessageError) as caught:
        call(*arguments)
    assert '\n' not in str(caught.value)
    assert 'expected' in str(caught.value)
    return caught.value.cause


def test_odometry(new):
    sample = odometry_sample(odometry(new))
    assert sample.stamp == 12 * NS + 5
    assert sample.pose3.tolist() == [1, 2, 0, 0, 0, 0, 1]
    assert sample.covariance.tolist() == np.arange(36.0).reshape(6, 6).tolist()
    assert sample.twist_covariance[1, 0] == -6.0


def test_how_fast_the_robot_is_by_its_twist(new):
    message = odometry(new)
    message.twist.twist.linear = new('geometry_msgs/msg/Vector3', x=3.0, y=-4.0, z=0.0)
    message.twist.twist.angular = new('geometry_msgs/msg/Vector3', x=0.0, y=0.0, z=-0.5)
    assert odometry_sample(message).speeds == (5.0, 0.5)
    message.twist.twist.linear.x, message.twist.twist.angular.z = math.nan, 1e308
    assert odometry_sample(message).speeds == (0.0, 0.0)


def test_a_sample_does_not_change_with_its_message(new):
    message = odometry(new)
    sample = odometry_sample(message)
    message.pose.covariance[0] = 99.0
    assert sample.covariance[0, 0] == 0.0


@pytest.mark.parametrize('trusted', [True, False])
def test_loop(new, trusted):
    closure = loop_closure(loop(new), 'base_link', trusted)
    assert (closure.reference_stamp, closure.stamp) == (10 * NS + 7, 12 * NS + 5)
    assert closure.trusted is trusted
    assert closure.pose3.tolist() == [1, 2, 0, 0, 0, 0, 1]
    assert closure.covariance[5, 5] == 35.0


def test_a_covariance_that_is_none_passes(new):
    message = odometry(new)
    message.pose.covariance[:] = math.nan
    message.twist.covariance[:] = math.inf
    sample = odometry_sample(message)
    assert np.isnan(sample.covariance).all()
    assert np.isinf(sample.twist_covariance).all()


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize('axis', range(7))
def test_a_pose_that_is_not_finite(new, value, axis):
    numbers = [1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    numbers[axis] = value
    pose = {'position': numbers[:3], 'quaternion': numbers[3:]}
    assert cause_of(odometry_sample, odometry(new, **pose)) == 'not_finite'
    assert cause_of(loop_closure, loop(new, **pose), '', False) == 'not_finite'


@pytest.mark.parametrize('position', [(1e308, 0.0, 0.0), (0.0, -2e9, 0.0)])
def test_a_pose_out_of_this_world(new, position):
    assert cause_of(odometry_sample, odometry(new, position=position)) == 'range'


@pytest.mark.parametrize('quaternion', [
    (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.8), (1.0, 1.0, 1.0, 1.0), (0.0, 0.0, 1e200, 1e200)])
def test_a_quaternion_that_is_none(new, quaternion):
    assert cause_of(odometry_sample, odometry(new, quaternion=quaternion)) == 'quaternion'


def test_a_quaternion_of_few_digits_is_normalised(new):
    sample = odometry_sample(odometry(new, quaternion=(0.0, 0.0, 0.7, 0.7)))
    np.testing.assert_allclose(sample.pose3[3:], [0, 0, np.sqrt(0.5), np.sqrt(0.5)], rtol=1e-15)


@pytest.mark.parametrize(('sec', 'nanosec'), [(0, 0), (-1, 5), (3, NS), (3, 2**32 - 1)])
def test_a_stamp_that_is_none(new, sec, nanosec):
    head = header(new, sec, nanosec)
    assert cause_of(stamp_of, head) == 'stamp'
    assert cause_of(odometry_sample, odometry(new, head)) == 'stamp'


@pytest.mark.parametrize('frame', [
    '', 'map', 'odom', 'base_link', 'base_link@', 'base_link@10', 'base_link@10.5',
    'base_link@10.0000000070', 'base_link@-1.000000000', 'base_link@1e1.000000000',
    'base_link@10.000000007 ', '@10.000000007', 'base_link@10,000000007',
    'base_link@9999999999.000000000', 'base_link@\u0661\u0660.000000007'])
@pytest.mark.parametrize('base_frame', ['base_link', ''])
def test_a_frame_that_names_no_time(new, frame, base_frame):
    assert cause_of(loop_closure, loop(new, frame), base_frame, False) == 'frame'


def test_the_frame_of_another_robot(new):
    message = loop(new, 'other/base@10.000000007')
    assert cause_of(loop_closure, message, 'base_link', False) == 'frame'
    assert loop_closure(message, '', False).reference_stamp == 10 * NS + 7
    assert loop_closure(message, 'other/base', False).reference_stamp == 10 * NS + 7


@pytest.mark.parametrize('reference', ['12.000000005', '12.000000006', '2000000000.000000000'])
def test_a_reference_that_is_not_earlier(new, reference):
    assert cause_of(loop_closure, loop(new, f'base_link@{reference}'), '', False) == 'order'


@pytest.mark.parametrize('stamp', [1, NS - 1, NS, 1305031102175300121])
def test_the_frame_says_the_stamp_exactly(new, stamp):
    frame = reference_frame_id('a@b', stamp)
    message = loop(new, frame)
    message.header = header(new, 2**31 - 1, 0, frame)
    assert loop_closure(message, 'a@b', False).reference_stamp == stamp
    assert reference_frame_id('base', 1000100000000) == 'base@1000.100000000'


def fix(new, frame='map', variances=(1.0, 1, 1, 0, 0, 0), **pose):
    message = new('geometry_msgs/msg/PoseWithCovarianceStamped', header=header(new, frame=frame),
                  pose=pose_with_covariance(new, **pose))
    message.pose.covariance = np.diag(np.array(variances, float)).ravel()
    return message


def test_an_absolute_pose_has_no_reference(new):
    found = absolute_pose(fix(new), 'map')
    assert found.is_absolute and found.stamps == (12 * NS + 5, 12 * NS + 5)
    assert found.pose3.tolist() == [1, 2, 0, 0, 0, 0, 1] and not found.trusted
    assert np.diag(found.covariance).tolist() == [1, 1, 1, 0, 0, 0]


@pytest.mark.parametrize('unsaid', [0.0, -1.0, math.inf, 1.1e6])
def test_without_a_heading_the_quaternion_may_be_none(new, unsaid):
    message = fix(new, variances=(1, 1, 1, *3 * [unsaid]), quaternion=(0.0, 0.0, 0.0, 0.0))
    assert absolute_pose(message, 'map').pose3[3:].tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize('fields, cause', [
    ({'frame': 'odom'}, 'frame'), ({'frame': ''}, 'frame'), ({'frame': 'a@1.000000000'}, 'frame'),
    ({'position': (math.nan, 0.0, 0.0)}, 'not_finite'), ({'position': (1e10, 0.0, 0.0)}, 'range'),
    ({'variances': (1, 1, 1, 0, 0, 1), 'quaternion': (0.0, 0.0, 0.0, 0.0)}, 'quaternion')])
def test_an_absolute_pose_that_cannot_be_used(new, fields, cause):
    with pytest.raises(MessageError) as caught:
        absolute_pose(fix(new, **fields), 'map')
    assert caught.value.cause == cause
