# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A robust map: the solver's own, of what is believed, and a true account of it."""

from dataclasses import replace

import numpy as np
import pytest
from lies import careful_world, is_false, position_error, spoilt
from numpy.testing import assert_array_equal

from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.robust.batch import minimise_robustly
from l1slam_ros.core.robust.judgement import NORM, Doubt
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import l1_cost, l2_cost
from l1slam_ros.core.solvers.solve import AUTO, choose, minimise_by


def in_l1(graph, poses):
    return minimise_by(choose(AUTO, graph), graph, poses, OptimiserOptions())[0]


def in_l2(graph, poses):
    return minimise_l2(graph, poses, LeastSquaresOptions(), cholesky_of(graph))


@pytest.fixture(scope='module')
def world():
    return careful_world(200, 400)


@pytest.fixture(scope='module')
def bad(world):
    return spoilt(world, 'grouped', 90)


@pytest.fixture(scope='module')
def found(bad):
    return minimise_robustly(bad.graph, in_l1)


def test_false_loops_are_refused_and_the_map_is_that_of_the_clean_graph(world, bad, found):
    false = is_false(bad, bad.graph.between)
    assert not found.judgement.accepted[false].any()
    assert np.count_nonzero(~found.judgement.accepted[~false]) <= 2
    clean = in_l1(world.graph, world.odometry)
    assert position_error(found.solution.poses, clean.poses) < 0.05
    assert position_error(in_l1(bad.graph, bad.odometry).poses, clean.poses) > 1


def test_its_cost_counts_the_accepted_factors_only(bad, found):
    residual = whitened_residual(bad.graph, found.solution.poses).reshape(-1, 3)
    believed = residual[found.judgement.accepted]
    assert found.solution.cost == pytest.approx(np.abs(believed).sum(), rel=1e-12)
    assert l1_cost(residual) > 2 * found.solution.cost


@pytest.mark.parametrize('minimise, cost', [(in_l1, l1_cost), (in_l2, l2_cost)])
def test_the_map_is_an_optimum_of_the_norm_asked_for(bad, minimise, cost):
    found = minimise_robustly(bad.graph, minimise)
    part = bad.graph.subset(found.judgement.accepted)
    best = cost(whitened_residual(part, found.solution.poses))
    again = minimise(part, found.solution.poses)
    assert best == pytest.approx(found.solution.cost) == pytest.approx(again.cost, rel=1e-4)
    assert best <= cost(whitened_residual(part, found.seed)) * (1 + 1e-12)


def test_the_choice_does_not_hang_on_the_norm(bad, found):
    other = minimise_robustly(bad.graph, in_l2)
    assert_array_equal(other.judgement.accepted, found.judgement.accepted)


def test_the_solver_is_asked_once_and_from_the_seed(bad):
    asked = []

    def minimise(graph, poses):
        asked.append((len(graph.between), poses))
        return in_l2(graph, poses)

    found = minimise_robustly(bad.graph, minimise)
    (count, poses), = asked
    assert count == found.judgement.accepted.sum()
    assert_array_equal(poses, found.seed)


def test_the_seed_is_the_l2_map_of_what_is_accepted(bad, found):
    part = bad.graph.subset(found.judgement.accepted)
    best = in_l2(part, found.seed)
    assert l2_cost(whitened_residual(part, found.seed)) <= best.cost + 1


@pytest.mark.parametrize('minimise', [in_l1, in_l2])
def test_a_map_that_leaves_the_least_squares_map_further_than_noise_explains_is_doubtful(
        world, minimise):
    assert not minimise_robustly(world.graph, minimise).judgement.doubts

    def bent(graph, poses):
        solution, turned = minimise(graph, poses), world.graph.manifold.identity(len(poses))
        turned[:, 2] = np.linspace(0, 1, len(poses))
        return replace(solution, poses=world.graph.manifold.compose(turned, solution.poses))

    doubt, = minimise_robustly(world.graph, bent).judgement.doubts
    assert doubt == Doubt(NORM, int((~world.graph.between.is_odometry).sum()), 0, 199)


def test_progress_is_reported(bad):
    said = []
    found = minimise_robustly(bad.graph, in_l2, lambda *news: said.append(news))
    rounds, loops = zip(*said, strict=True)
    assert rounds == tuple(range(1, len(said) + 1))
    assert abs(loops[-1] - (found.judgement.accepted & ~bad.graph.between.is_odometry).sum()) <= 2
