# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Loops that were refused because the odometry slipped agree; false ones do not."""

import numpy as np
import pytest
from lies import careful_world, is_false, slipped, spoilt

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import ends_in_time
from l1slam_ros.core.robust.odometry.slips import common_steps
from l1slam_ros.core.robust.pairwise_consistency import spanned, strongest_group
from l1slam_ros.core.robust.reasons import doubts
from l1slam_ros.core.robust.rounds.evidence import FEWEST_PLACES
from l1slam_ros.core.robust.rounds.growth import Growth

# The robot turned by 90 degrees more, there.
STEP, TURN = 200, (0, 0, np.pi / 2)


@pytest.fixture(scope='module')
def bad():
    return spoilt(careful_world(400, 800), 'random', 100)


def grown(graph):
    """Return the state in which nothing more can be accepted."""
    growth = Growth(graph)
    growth.begin()
    while len(news := growth.believable(growth.undecided())):
        growth.accepted[news] = True
        growth.solve()
    return growth


def test_loops_across_a_slip_agree(bad):
    growth = grown(slipped(bad.graph, STEP, TURN))
    group = strongest_group(growth, growth.undecided())
    assert growth.given.count_places(group) >= FEWEST_PLACES
    assert not is_false(bad, growth.given.factors)[group].any()
    assert ((growth.given.low[group] <= STEP) & (growth.given.high[group] > STEP)).all()
    steps = growth.given.low[common_steps(growth, group)]
    assert steps.min() <= STEP <= steps.max()


@pytest.mark.parametrize('kind', ['random', 'identity', 'grouped'])
def test_false_loops_agree_by_chance_at_most(kind):
    assert not doubts(grown(spoilt(careful_world(400, 800), kind, 400).graph))


def test_where_nothing_is_refused_nobody_agrees():
    growth = grown(careful_world(60, 100).graph)
    growth.accepted[:] = True
    assert not len(strongest_group(growth, growth.undecided()))


def test_spanned_counts_the_factors_across_each_step():
    rng = np.random.default_rng(0)
    ends = np.sort(rng.integers(0, 12, (30, 2)), axis=1)
    expected = [np.count_nonzero((ends[:, 0] <= k) & (ends[:, 1] > k)) for k in range(11)]
    np.testing.assert_array_equal(spanned(ends[:, 0], ends[:, 1], 12), expected)


def test_ends_are_in_the_order_of_time(bad):
    low, high, Z = ends_in_time(bad.graph)
    factors = bad.graph.between
    assert (low < high).all()
    turned = factors.i > factors.j
    np.testing.assert_array_equal(Z[~turned], factors.measurement[~turned])
    np.testing.assert_allclose(se2.inverse(Z[turned]), factors.measurement[turned], atol=1e-12)
