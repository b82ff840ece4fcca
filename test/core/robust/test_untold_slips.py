# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A loop that is refused is a lie, or shows a slip of which no other loop tells."""

import numpy as np
import pytest
from lies import slipped
from problems import chain_of, graph_of, retold
from test_pairwise_consistency import grown

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.robust.odometry.motion import usual_motion
from l1slam_ros.core.robust.odometry.slips import SURE
from l1slam_ros.core.robust.odometry.untold import LEAST, shown_slips, untold_slip

SIDE = 20
FAR = 4 * SIDE - 1


@pytest.fixture(scope='module')
def block():
    """Return once round a block, with one loop of its ends and three along the way."""
    heading = np.cumsum(np.pi / 2 * (np.arange(FAR + 1) % SIDE == 0)) - np.pi / 2
    steps = np.column_stack((np.cos(heading), np.sin(heading)))[:-1]
    way = np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0)))
    pairs = np.concatenate((chain_of(FAR + 1), [[0, FAR], [1, 3], [5, 8], [70, 74]]))
    sure = np.diag([400.0, 400.0, 1e4])
    noise = np.random.default_rng(1).standard_normal((len(pairs), 3)) / np.sqrt(np.diag(sure))
    return graph_of(np.column_stack((way, heading)), pairs, noise, sure)


def odds_of(graph):
    growth = grown(graph)
    return untold_slip(
        growth, shown_slips(growth, usual_motion(growth)))


@pytest.mark.parametrize('step, off', [(45, [0.0, 0.0, -np.pi / 2]), (30, [5.0, 0.0, 0.0]),
                                       (35, [5.0, 0.0, 0.0])])
def test_one_loop_shows_a_slip_where_the_robot_moved_on_as_ever(block, step, off):
    """To turn by a right angle is nothing unusual there, so nothing else tells of it."""
    graph = slipped(block, [step], off)
    (named, odds), = odds_of(graph).items()
    assert named == step and odds > LEAST
    judgement, _ = robust_solve(graph)
    assert graph.between.i[judgement.slips].tolist() == [step] and not judgement.doubts
    assert judgement.accepted[FAR]


@pytest.mark.parametrize('seed', range(3))
def test_a_lie_is_no_slip(block, seed):
    """After a slip that fits it, the robot would have moved as it never does."""
    Z = block.between.measurement.copy()
    Z[FAR] = np.random.default_rng(seed).normal(0.0, [8.0, 8.0, 2.0])
    graph = retold(block, Z)
    (odds,) = odds_of(graph).values()
    assert odds < -2 * SURE
    judgement, _ = robust_solve(graph)
    assert not judgement.accepted[FAR] and not judgement.doubts


def test_no_refused_loop_no_slip(block):
    growth = grown(block)
    assert growth.accepted.all() and untold_slip(
        growth, shown_slips(growth, usual_motion(growth))) == {}


def test_a_step_that_an_accepted_loop_spans_is_not_untold(block):
    """It says what the odometry does."""
    graph = slipped(block, [30], [0.0, 0.0, np.pi / 2])
    steps = graph.between.measurement[:FAR]
    graph.append_between(np.array([30]), np.array([32]), se2.compose(steps[[30]], steps[[31]]),
                         graph.between.sqrt_information[:1])
    growth = grown(graph)
    assert growth.accepted[-1] and not growth.accepted[FAR]
    assert not {30, 31} & set(untold_slip(
        growth, shown_slips(growth, usual_motion(growth))))
