# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""How often maps that looked like this one were right, and what that hangs on."""

import numpy as np
import pytest
from lies import careful_world
from problems import chain_of, graph_of

from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.robust.batch import robust_solve, rounds
from l1slam_ros.core.robust.forecast import CONFIDENT, forecast, terms_of
from l1slam_ros.core.robust.judgement import DRIFTS, WEAK, judgement_of
from l1slam_ros.core.robust.reasons import doubts
from l1slam_ros.core.robust.rounds.growth import Growth
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS, insert_loops


def out_and_back(drift, legs=3, length=60, seed=0):
    """Return a way along corridors and back, each metre of whose odometry turns too much."""
    rng = np.random.default_rng(seed)
    heading = np.repeat(np.cumsum(np.pi / 2 * rng.choice([-1, 1], legs)), length)
    there = np.cumsum(np.column_stack((np.cos(heading), np.sin(heading))), axis=0)
    truth = np.column_stack((np.concatenate((there, there[::-1] + 0.1)), np.unwrap(
        np.concatenate((heading, heading[::-1] + np.pi)))))
    first = rng.choice(len(there) - 10, 30, replace=False)
    chain = chain_of(len(truth))
    pairs = np.concatenate((chain, np.column_stack((first, len(truth) - 1 - first))))
    noise = rng.standard_normal((len(pairs), 3)) * [0.05, 0.05, 0.005]
    noise[: len(chain), 2] += drift
    return graph_of(truth, pairs, noise, np.diag([400.0, 400.0, 4e4]))


@pytest.mark.parametrize('seed', range(3))
def test_a_drift_that_passes_for_noise_is_taken_out_and_noise_is_none(seed):
    found, _ = robust_solve(out_and_back(0.007, seed=seed))
    assert found.drift == pytest.approx(-0.007, rel=0.3) and not found.doubts
    assert found.confidence > CONFIDENT
    straight, _ = robust_solve(out_and_back(0.0, seed=seed))
    assert not straight.drift and not straight.doubts


def test_a_drift_that_is_not_taken_out_is_a_doubt():
    growth = Growth(out_and_back(0.007), lambda: None)
    growth.begin()
    *_, last = rounds(growth)
    doubt, = doubts(last)
    assert doubt.kind == DRIFTS and float(doubt.detail) == pytest.approx(0.007, rel=0.3)
    assert judgement_of(last, (doubt,)).confidence < CONFIDENT


def test_a_drift_that_dense_loops_hold_is_none():
    world = careful_world(300, 800)
    graph = world.graph.copy()
    graph.between.measurement[graph.between.is_odometry, 2] += 0.004
    assert DRIFTS not in [doubt.kind for doubt in robust_solve(graph)[0].doubts]


def test_a_map_without_an_accepted_loop_is_hardly_ever_right():
    graph = out_and_back(0.0)
    factors = graph.between
    turned = ~factors.is_odometry
    factors.measurement[turned, :2] += np.random.default_rng(0).uniform(
        20, 60, (np.count_nonzero(turned), 2))
    found, _ = robust_solve(graph)
    assert [doubt.kind for doubt in found.doubts] == [WEAK]
    assert found.confidence < 0.2 and forecast(found.terms) == found.confidence


@pytest.mark.parametrize('seed, noisier', [(0, 10), (3, 6), (6, 10), (7, 6)])
def test_a_vague_map_is_doubtful_though_it_has_all_true_loops(seed, noisier):
    """It is unsure of itself for the odometry, which no loop that is left out would mend."""
    rng = np.random.default_rng(seed)
    graph = out_and_back(0.0, seed=seed)
    steps = graph.between.is_odometry
    noise = rng.normal(0, 1, (np.count_nonzero(steps), 3)) * [0.05, 0.05, 0.005]
    graph.between.measurement[steps] += noisier * noise
    true = np.concatenate((np.flatnonzero(steps), rng.choice(np.flatnonzero(~steps), 14, False)))
    graph = graph.subset(np.sort(true))
    lies = FALSE_LOOPS['random'](graph, odometry_poses(graph), 5, rng)
    found, _ = robust_solve(insert_loops(graph, lies))
    assert found.accepted.sum() == len(true)
    assert found.confidence < CONFIDENT and [doubt.kind for doubt in found.doubts] == [WEAK]


def test_each_reason_lowers_the_forecast():
    sure = forecast(terms_of(True, 0.5, False, False, False))
    assert sure > 0.95
    assert forecast(terms_of(True, 5.0, False, False, False)) < sure
    assert forecast(terms_of(False, 0.5, False, False, False)) < sure
    for reason in np.eye(3, dtype=bool):
        assert forecast(terms_of(True, 2.0, *reason)) < 0.9


def test_where_no_loop_is_there_nothing_is_recorded():
    graph = out_and_back(0.0)
    alone = graph.subset(np.flatnonzero(graph.between.is_odometry))
    assert np.isnan(robust_solve(alone)[0].confidence)
