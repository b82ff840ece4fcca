# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""When motion makes a keyframe, and what is known of the motion between two."""

from itertools import zip_longest

import heard
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from worlds import between, compose

import l1slam_ros as l1

MODEL = {'odometry.sigma_translation': 0.1, 'odometry.sigma_rotation': 0.2,
         'odometry.floor_translation': 0.03, 'odometry.floor_rotation': 0.04}


def after(increments, covariances=(), twists=(), source='model', period=1.0, **options):
    """Return the back end after increments (k, 3), one message each; only the last a keyframe."""
    backend = heard.begun(heard.EVERY, **MODEL, **{
        'keyframe.period': len(increments) * period, 'odometry.covariance_source': source,
        **options})
    poses = [np.zeros(3)]
    for increment in increments:
        poses.append(compose(poses[-1], np.array(increment, float)))
    stated = zip_longest(poses, [heard.UNKNOWN, *covariances], [heard.UNKNOWN, *twists],
                         fillvalue=heard.UNKNOWN)
    for k, sample in enumerate(stated):
        backend.add_odometry(heard.odometry(5.0 + k * period, *sample))
    return backend


@pytest.mark.parametrize('thresholds, increments, period, keyframes', [
    ((0.5, 0, 0), [(0.49, 0, 3.0)], 1, []), ((0.5, 0, 0), [(0.5, 0, 0)], 1, [1]),
    ((0.5, 0, 0), [(0.0, -0.3, 0)] * 5, 1, [2, 4]), ((0.5, 0, 0), [(0.3, 0.4, 0)], 1, [1]),
    ((0.5, 0, 0), [(0.4, 0, 0), (-0.4, 0, 0)] * 2, 1, []),  # there and back is nowhere
    ((0.5, 0, 0), [(0.05, 0, 0)] * 20, 1, [10, 20]),  # though their sum is a little less
    ((0, 0.2, 0), [(1.0, 0, 0.19)], 1, []), ((0, 0.2, 0), [(0.0, 0, -0.2)], 1, [1]),
    ((0, 0, 2), [(0.0, 0, 0)] * 7, 0.99, [3, 6]), ((1, 1, 1.5), [(0.9, 0, 0.9)], 1, []),
    ((1, 1, 1.5), [(0.0, 0, 1.1)], 1, [1]), ((1, 1, 0.9), [(0.0, 0, 0)], 1, [1]),
    ((0, 0, 0), [(0.0, 0, 0)] * 3, 1, [1, 2, 3])])
def test_any_threshold_that_is_on_makes_a_keyframe(thresholds, increments, period, keyframes):
    names = [f'keyframe.{name}' for name in ('translation', 'rotation', 'period')]
    backend = after(increments, period=period, **dict(zip(names, thresholds, strict=True)))
    expected = [heard.seconds(5.0 + k * period) for k in [0, *keyframes]]
    assert backend.snapshot().stamps.tolist() == expected


@pytest.mark.parametrize('increments, source, stated', [
    # 3 + 4 m and .5 + .25 rad travelled, not the 1 m and .25 rad between the ends.
    ([(3.0, 0, 0.5), (-4.0, 0, -0.25)], 'model', 2 * [np.eye(6)]),
    ([(0.0, 0, 0)] * 3, 'model', 3 * [np.eye(6)]),
    ([(0.0, 0, 0)] * 1100, 'increment', [heard.UNKNOWN, *[np.eye(6)] * 1099]),
    *(([(1.0, 0, 0.1)] * 3, source, [np.eye(6)] * place + [one] + [np.eye(6)] * (2 - place))
      for source in ('increment', 'twist') for one in heard.UNUSABLE for place in range(3))])
def test_the_model_grows_with_the_way_and_the_turn(increments, source, stated):
    """It speaks for the whole motion where it is asked to, or one covariance is unusable."""
    (covariance,) = heard.steps_of(after(increments, stated, stated, source))[1]
    way, turn = (np.abs(np.array(increments)[:, k]).sum() for k in (0, 2))
    expected = [(0.1 * way)**2 + 0.03**2] * 2 + [(0.2 * turn)**2 + 0.04**2]
    assert_allclose(covariance, np.diag(expected), atol=1e-12)


@pytest.mark.parametrize('source', ['increment', 'twist'])
@pytest.mark.parametrize('count', [5, 1100])
def test_what_messages_state_adds_up_to_first_order(rng, source, count):
    """Against the Jacobian of the product by differences: sum J_k S_k J_k'."""
    increments = rng.standard_normal((count, 3)) * (1.0 if count < 100 else 0.05)
    roots = 0.01 * rng.standard_normal((count, 3, 3))
    stated = roots @ roots.transpose(0, 2, 1) + 1e-5 * np.eye(3)
    period = 0.5
    backend = after(increments, [heard.covariance6(one) for one in stated],
                    [heard.covariance6(one / period**2) for one in stated], source, period=period)
    rest, h, expected = np.zeros(3), 1e-6, np.zeros((3, 3))
    for increment, covariance in zip(increments[::-1], stated[::-1], strict=True):
        ends = [compose(h * unit, rest) for unit in (*np.eye(3), *-np.eye(3))]
        J = np.array([between(rest, end) for end in ends])
        J = (J[:3] - J[3:]).T / (2 * h)
        expected += J @ covariance @ J.T
        rest = compose(increment, rest)
    (measurement,), (covariance,) = heard.steps_of(backend)
    assert_allclose(between(rest, measurement), 0, atol=1e-9)
    assert_allclose(covariance, expected, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize('variances, used, said', [
    ((0.01, 0.02, 0.0), (0.01, 0.02, 0.04**2), 'variance 0 of odometry at 6000000000 ns; '
     'expected 1e-08 to 10; 0.0016 is used'),
    ((1e-12, 0.02, 0.01), (0.1**2 + 0.03**2, 0.02, 0.01), '0.0109 is used'),
    ((0.01, 1e4, 0.01), (0.01, 10.0, 0.01), 'variance 10000 of odometry')])
def test_what_no_odometry_knows_so_well_or_so_badly_is_said(variances, used, said):
    """A planar front end leaves z, roll and pitch at zero; what it says of the rest counts."""
    backend = after([(1.0, 0, 0)], [heard.covariance6(np.diag(variances))], source='increment')
    assert_allclose(heard.steps_of(backend)[1], [np.diag(used)], atol=1e-12)
    (news,) = backend.news()
    assert said in news


@pytest.mark.parametrize(('dimension', 'slope', 'mounted', 'says'), [
    (2, 0.1, 0.0, 'has left the plane by 0.5'), (2, 0.0, 0.3, ''), (2, 0.01, 0.3, ''),
    (3, 0.1, 0.3, '')])
def test_a_slope_is_said_where_it_is_dropped(dimension, slope, mounted, says):
    """Of a sensor that is mounted high and tilted, what changes is; by then it is half a metre."""
    backend = l1.Backend(dimension=dimension)
    turn = Rotation.from_euler('ZY', [[0.1 * k, mounted - slope] for k in range(20)]).as_quat()
    for k in range(20):
        pose3 = np.array([k * np.cos(slope), 0.0, mounted + k * np.sin(slope), *turn[k]])
        backend.add_odometry(l1.OdometrySample(heard.seconds(k), pose3, np.eye(6), np.eye(6)))
    news = backend.news()
    assert len(news) == bool(says)
    if says:
        assert says in news[0] and 'dimension 3' in news[0]
