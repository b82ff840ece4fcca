# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A heading that drifts is found by loops, the map is made without it; where none is, none is."""

import numpy as np
import pytest
from lies import careful_world, is_false, laps, position_error, spoilt
from problems import chain_of, graph_of, retold

from l1slam_ros.core.names import KINDS_OF_FALSE_LOOPS
from l1slam_ros.core.robust import batch_map
from l1slam_ros.core.robust.forecast import forecast
from l1slam_ros.core.robust.odometry.drift import straightened
from l1slam_ros.core.robust.odometry.drift_likelihood import likely_drifts
from l1slam_ros.core.worlds.false_loops import random_false_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world, with_false_loops

DRIFT = 0.05
WORLD = careful_world(400, 800)


@pytest.mark.parametrize('drift', [DRIFT, -0.02])
def test_loops_agree_on_the_drift_that_there_is(drift):
    found = likely_drifts(straightened(WORLD.graph, -drift))[0]
    assert found == pytest.approx(drift, abs=2e-3)


def test_laps_that_are_circles_fit_by_a_turn_more_on_each_so_that_the_map_is_less_sure(rng):
    n = 300
    metres = 2 * np.pi * 48
    angle = 2 * np.pi * np.arange(2 * n) / n
    truth = np.column_stack((48 * np.cos(angle), 48 * np.sin(angle), angle))
    chain, back = chain_of(2 * n), np.arange(0, n, 10)
    pairs = np.concatenate((chain, np.column_stack((back, back + n))))
    noise = rng.normal(0, (0.05, 0.05, 0.005), (len(pairs), 3))
    graph = straightened(graph_of(truth, pairs, noise, np.diag([400.0, 400.0, 4e4])), -DRIFT)
    judgement = batch_map.solve(graph, None, batch_map.SolveOptions()).judgement
    turns = (judgement.drift - DRIFT) * metres / (2 * np.pi)
    assert turns == pytest.approx(round(turns), abs=0.1)
    assert judgement.confidence < 0.95 < forecast(judgement.terms[:3])


@pytest.mark.parametrize('seed', range(3))
def test_of_laps_that_are_no_circles_the_drift_that_leaves_the_least_noise_is_taken(seed):
    """By a turn less on each lap all loops fit, too, in a map that is 40 m off."""
    world = laps(600, 3, 90, WorldOptions(odometry_sigma_rotation=0.01),
                 np.random.default_rng(seed))
    drift = 2 * np.pi / 200
    bad = spoilt(world, 'random', 40)
    outcome = batch_map.solve(straightened(bad.graph, -drift), None, batch_map.SolveOptions())
    assert outcome.judgement.drift == pytest.approx(drift, abs=1e-3)
    assert position_error(outcome.solution.poses, bad.truth) < 1
    assert not outcome.judgement.doubts


@pytest.mark.parametrize('kind', KINDS_OF_FALSE_LOOPS)
def test_lies_do_not_hide_it(kind):
    found = likely_drifts(straightened(spoilt(WORLD, kind, 300).graph, -DRIFT))[0]
    assert found == pytest.approx(DRIFT, abs=2e-3)


def test_odometry_that_does_not_drift_is_left_as_it_is():
    assert not len(likely_drifts(WORLD.graph))
    bad = spoilt(WORLD, 'random', 400)
    assert batch_map.solve(bad.graph, None, batch_map.SolveOptions()).judgement.drift == 0


def test_a_drift_beyond_what_the_odometry_states_is_taken_though_no_place_is_won():
    graph = straightened(spoilt(WORLD, 'random', 100).graph, -0.004)
    outcome = batch_map.solve(retold(graph, times=3.0), None, batch_map.SolveOptions(norm='l2'))
    assert outcome.judgement.drift == pytest.approx(0.004, abs=1e-3)


@pytest.mark.parametrize('lies', [0, 100])
def test_a_drift_within_what_the_odometry_states_is_left_with_lies_as_without(lies):
    """Without lies nobody asks for it; by it no place is won."""
    graph = straightened(spoilt(WORLD, 'random', lies).graph if lies else WORLD.graph, -0.002)
    outcome = batch_map.solve(retold(graph, times=3.0), None, batch_map.SolveOptions(norm='l2'))
    assert outcome.judgement.drift == 0
    assert position_error(outcome.solution.poses, WORLD.truth) < 0.07


def test_what_no_loop_can_tell_over_all_of_the_way_is_no_drift(rng):
    """Of a long way, chance alone prefers some drift of micro-radians to none."""
    world = simulate_world(25_000, 50_000, WorldOptions(), np.random.default_rng(1))
    lies = random_false_loops(world.graph, world.truth, 7_500, rng)
    assert not len(likely_drifts(with_false_loops(world, lies).graph))


@pytest.mark.parametrize('norm', ['l1', 'l2'])
def test_the_map_is_made_without_it(norm):
    bad = spoilt(WORLD, 'random', 300)
    graph = straightened(bad.graph, -DRIFT)
    before = graph.between.measurement.copy()
    outcome = batch_map.solve(graph, None, batch_map.SolveOptions(norm=norm))
    assert outcome.judgement.drift == pytest.approx(DRIFT, abs=2e-3)
    assert position_error(outcome.solution.poses, bad.truth) < 0.5
    assert not (outcome.judgement.accepted & is_false(bad, graph.between)).any()
    np.testing.assert_array_equal(graph.between.measurement, before)


def test_odometry_that_is_corrected_and_corrected_back_is_as_it_was():
    back = straightened(straightened(WORLD.graph, DRIFT), -DRIFT).between
    np.testing.assert_allclose(back.measurement, WORLD.graph.between.measurement, atol=1e-12)
    assert straightened(WORLD.graph, 0.0) is WORLD.graph
