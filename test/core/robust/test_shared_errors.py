# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Loops of a place may err together: then they are worth one, and the noise stays what it is."""

import numpy as np
import pytest
from lies import position_error, roundabout
from problems import chain_of, graph_of, measure

from l1slam_ros.core.robust import batch_map
from l1slam_ros.core.robust.batch import judge, robust_solve
from l1slam_ros.core.robust.places import err_together


@pytest.mark.parametrize('shared, together', [(0.0, False), (0.5, True), (1.0, True)])
def test_sums_over_places_tell_whether_loops_err_together(shared, together):
    rng = np.random.default_rng(0)
    place = np.repeat(np.arange(9), 20)
    found = 0
    for _ in range(50):
        own, common = (rng.standard_normal((size, 3)) for size in (180, 9))
        residual = np.sqrt(1 - shared) * own + np.sqrt(shared) * common[place]
        found += err_together(place, residual, rng.standard_normal((180, 3, 24)))
    assert found == 50 * together


def test_loops_each_of_its_own_place_tell_nothing():
    rng = np.random.default_rng(0)
    assert not err_together(np.arange(30), rng.standard_normal((30, 3)),
                            rng.standard_normal((30, 3, 24)))


STEP, LOOP = np.array([0.03, 0.03, 0.0005]), np.array([1.0, 1.0, 0.1])
# Loops of each place.
COUNTS = np.array([50, *[8] * 7])


def rounds_of(seed, shared, stated=1.0):
    """Return two rounds with loops that share a part of their error by place, and the truth."""
    rng, truth = np.random.default_rng(seed), roundabout(400)
    first = np.concatenate([start + np.arange(count) for start, count in zip(
        (0, *range(64, 190, 18)), COUNTS, strict=True)])
    own, common = (rng.standard_normal((m, 3)) for m in (COUNTS.sum(), len(COUNTS)))
    error = LOOP * (np.sqrt(1 - shared) * own + np.sqrt(shared) * common.repeat(COUNTS, axis=0))
    noise = STEP * rng.standard_normal((399, 3))
    graph = graph_of(truth, chain_of(400), noise, np.diag(STEP**-2))
    measure(graph, truth, first, first + 200, error, np.diag((stated * LOOP) ** -2))
    return graph, truth


def solved(graph, robust):
    return batch_map.solve(graph, None, batch_map.SolveOptions(norm='l2', robust=robust))


def test_loops_that_err_together_are_worth_one_in_the_map():
    """And the cost is told by what the file says of the noise."""
    errors = np.zeros(2)
    for seed in range(3):
        graph, truth = rounds_of(seed, 0.9, stated=0.4)
        all_said, judged = solved(graph, False), solved(graph, True)
        assert judged.judgement.accepted.all() and not judged.judgement.is_noise_stated
        assert judged.solution.cost > all_said.solution.cost
        errors += [position_error(map_.solution.poses, truth) for map_ in (judged, all_said)]
    assert errors[0] < 0.9 * errors[1]


@pytest.mark.parametrize('shared, stated', [(0.0, 1.0), (0.0, 0.3), (0.9, 1.0)])
def test_loops_keep_the_optimum_they_state_unless_that_is_wrong_beyond_doubt(shared, stated):
    """Each errs for itself, or all by no more than they say."""
    graph, _ = rounds_of(0, shared, stated)
    all_said, judged = solved(graph, False), solved(graph, True)
    assert judged.judgement.is_noise_stated
    assert judged.solution.cost == pytest.approx(all_said.solution.cost, rel=1e-9)


def test_a_graph_judged_again_says_the_same_of_its_noise():
    """However often: else the scale of the odometry climbs as loops come."""
    graph, _ = rounds_of(0, 0.9)
    first, poses = robust_solve(graph)
    judgement = first
    for _ in range(10):
        judgement, poses = judge(graph, poses, judgement)
    assert judgement.variance == pytest.approx(first.variance, rel=0.05)
