# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Noise that is stated 1e-4 to 1e4 times what it is, of odometry or of loops: judged the same."""

import numpy as np
import pytest
from lies import careful_world, is_false, laps, position_error, spoilt
from numpy.testing import assert_allclose
from problems import graph_of, retold, straight

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.robust.batch import judge, robust_solve
from l1slam_ros.core.robust.innovation import LEAST_RATIO, stated_variance, within_ratio
from l1slam_ros.core.worlds.simulate import WorldOptions

# Odometry far better than the loops: the weights of the one are lost in those of the other.
SHARP = WorldOptions(odometry_sigma_translation=1e-3, odometry_sigma_rotation=1e-4)
USUAL = WorldOptions(odometry_sigma_translation=0.02, odometry_sigma_rotation=0.003)


@pytest.fixture(scope='module', params=[SHARP, USUAL], ids=['sharp odometry', 'usual odometry'])
def bad(request):
    """Five laps of a city block with 400 true loops, and 170 false ones."""
    return spoilt(laps(2000, 5, 400, request.param, np.random.default_rng(1)), 'random', 170)


@pytest.mark.parametrize('times', [1e-4, 1e-2, 1e2, 1e4])
@pytest.mark.parametrize('odometry', [True, False], ids=['odometry', 'loops'])
def test_no_lie_is_believed_and_at_most_one_true_loop_in_fifty_is_refused(bad, odometry, times):
    factors = bad.graph.between
    graph = retold(bad.graph, times=np.where(factors.is_odometry == odometry, times, 1.0))
    found, poses = robust_solve(graph)
    lies = is_false(bad, factors)
    assert not found.doubts and not (found.accepted & lies).any()
    assert np.count_nonzero(~found.accepted & ~lies) <= 400 / 50
    assert position_error(poses, bad.truth) < 0.5
    stated = stated_variance(graph.between)
    effective = found.variance * stated
    assert effective.min() >= LEAST_RATIO * effective.max() * (1 - 1e-12)


@pytest.mark.parametrize('count, accepted', [(2, 0), (16, 14)])
def test_loops_that_fit_as_they_say_come_in_where_enough_of_them_stand_apart(count, accepted):
    """Off by 6 to 12 sigmas, stated four times too large: the tail of the noise, and not lies."""
    world = careful_world(400, 800)
    bad = spoilt(world, 'random', 400)
    factors = bad.graph.between
    rng = np.random.default_rng(0)
    lies = is_false(bad, factors)
    far = rng.choice(np.flatnonzero(~factors.is_odometry & ~lies), count, replace=False)
    along = rng.standard_normal((count, 3))
    along *= rng.uniform(6, 12, (count, 1)) / np.linalg.norm(along, axis=1, keepdims=True)
    step = np.linalg.solve(factors.sqrt_information[far], along[:, :, None])[:, :, 0]
    factors.measurement[far] = se2.retract(factors.measurement[far], step)
    found, _ = robust_solve(retold(bad.graph, times=4.0))
    assert not (found.accepted & lies).any()
    assert found.accepted[~factors.is_odometry & ~lies].sum() >= 401 - count + accepted
    assert np.count_nonzero(found.accepted[far]) in range(accepted, count * (accepted > 0) + 1)


def test_of_noise_stated_far_too_large_the_tails_are_not_taken_for_lies():
    """As the parking garage states its: for the noise found, 135 of 4,615 true loops were lost."""
    bad = spoilt(careful_world(400, 800), 'random', 100)
    factors = bad.graph.between
    rng = np.random.default_rng(0)
    lies = is_false(bad, factors)
    loops = np.flatnonzero(~factors.is_odometry & ~lies)
    tails = rng.standard_normal((len(loops), 3)) * np.sqrt(2 / rng.chisquare(2, (len(loops), 1)))
    step = np.linalg.solve(factors.sqrt_information[loops], tails[:, :, None])[:, :, 0]
    factors.measurement[loops] = se2.retract(factors.measurement[loops], step)
    found, _ = robust_solve(retold(bad.graph, times=1e3))
    assert not (found.accepted & lies).any()
    assert np.count_nonzero(~found.accepted & ~lies) <= 4


@pytest.mark.parametrize('times, judged', [(2.0, 1), (6.0, 1), (1e3, 2)])
def test_overstated_noise_is_judged_once_more_only_where_loops_may_fit_by_it(times, judged):
    bad = spoilt(careful_world(300, 420), 'random', 100)
    first = []

    def report(number, accepted):
        first.append(number == 1)

    found, _ = robust_solve(retold(bad.graph, times=times), report)
    assert sum(first) == judged
    np.testing.assert_array_equal(found.accepted, ~is_false(bad, bad.graph.between))


def test_what_is_stated_is_the_median_by_determinant():
    graph = graph_of(straight(5), [(0, 1), (1, 2), (2, 3), (3, 4), (0, 2), (1, 4)])
    variance = np.array([[1.0, 4.0, 16.0]] * 5 + [[1e4, 1e4, 1e4]])
    roots = np.eye(3) / np.sqrt(variance)[:, :, None]
    graph = graph.subset(np.arange(6))
    graph.between.sqrt_information[:] = roots
    assert_allclose(stated_variance(graph.between), [4.0, (4.0 + 1e4) / 2])
    assert_allclose(stated_variance(graph.subset(np.arange(4)).between), [4.0, 4.0])


def test_only_the_smaller_variance_is_raised_and_only_beyond_the_ratio():
    assert_allclose(within_ratio(np.array([1e-9, 1.0]), np.ones(2)), [LEAST_RATIO, 1.0])
    assert_allclose(within_ratio(np.array([1e-9, 1.0]), np.array([1e5, 1.0])), [1e-9, 1.0])
    assert_allclose(within_ratio(np.array([1.0, 1e-3]), np.array([1.0, 1e-4])), [1.0, 1e-1])


@pytest.mark.parametrize('seed', [0, 3])
def test_of_the_identity_what_a_turn_is_worth_is_found_and_weighs_the_map(seed):
    """A radian is no metre: as if it were, right loops make a map that is twice as far off."""
    bad = spoilt(laps(600, 3, 90, USUAL, np.random.default_rng(seed)), 'random', 60)
    factors = bad.graph.between
    says_nothing = retold(bad.graph)
    says_nothing.between.sqrt_information[:] = np.eye(3)
    judgement, poses = robust_solve(says_nothing)
    lies = is_false(bad, factors)
    assert not judgement.doubts
    np.testing.assert_array_equal(judgement.accepted, ~lies)
    as_stated = robust_solve(bad.graph)[1]
    assert position_error(poses, bad.truth) < 1.1 * position_error(as_stated, bad.truth)
    turns = judgement.meant[:, 2] / judgement.meant[:, 0]
    assert (turns < 0.1).all()
    again, _ = judge(says_nothing, poses, judgement)
    np.testing.assert_array_equal(again.accepted, judgement.accepted)
    assert_allclose(again.variance, judgement.variance, rtol=0.3)
