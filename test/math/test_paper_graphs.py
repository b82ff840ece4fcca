# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The solvers on the paper's own graphs: each ends at the lowest L1 cost that is known."""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import pytest

from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, minimise
from l1slam_ros.core.solvers.optimality import Status, l1_cost
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import AUTO, INTERIOR_POINT, choose, minimise_by
from l1slam_ros.io.graphs.graph_file import read_graph_file


@dataclass(frozen=True)
class Known:
    """Of a dataset: the lowest L1 cost known; how many steps of Algorithm 4 come within .1%."""

    name: str
    best: float
    outer: int = 15


INTEL = Known('intel', 961.77375)
MANHATTAN = Known('manhattan3500', 971.66316)
CITY = Known('city10000', 3772.00977, outer=8)


class Dataset:
    """A graph file, read once, and what was computed from it, once."""

    def __init__(self, folder, known):
        record = read_graph_file(folder / f'{known.name}.g2o')
        self.known = known
        self.graph = record.graph
        self.stored = record.poses

    @cached_property
    def odometry(self):
        return odometry_poses(self.graph)

    @cached_property
    def method(self):
        return choose(AUTO, self.graph)

    @cached_property
    def seed(self):
        return seed_poses(self.graph, self.method.cholesky)

    def cost(self, poses):
        return l1_cost(whitened_residual(self.graph, poses))


@cache
def loaded(folder, known):
    return Dataset(folder, known)


@pytest.fixture(params=[INTEL, MANHATTAN, CITY], ids=lambda known: known.name)
def dataset(request, datasets):
    return loaded(datasets, request.param)


@pytest.mark.parametrize('start', ['stored', 'odometry', 'seed'])
def test_from_every_start_it_ends_at_the_lowest_cost_known(dataset, start):
    poses = getattr(dataset, start)
    solution, solver = minimise_by(dataset.method, dataset.graph, poses, OptimiserOptions())
    assert (solver, solution.status) == (INTERIOR_POINT, Status.CONVERGED)
    assert (np.diff(solution.history) <= 0).all()
    assert solution.history[0] == dataset.cost(poses)
    assert solution.cost == dataset.cost(solution.poses)
    assert (1 - 1e-7) * dataset.known.best <= solution.cost <= (1 + 1e-5) * dataset.known.best


# Algorithm 4


def check_near_optimum(dataset, start):
    known = dataset.known
    options = OptimiserOptions(outer_iterations=known.outer)
    solution = minimise(dataset.graph, start, options, dataset.method.cholesky)
    assert (np.diff(solution.history) <= 0).all()
    assert solution.cost == dataset.cost(solution.poses)
    assert (1 - 1e-6) * known.best <= solution.cost <= (1 + 1e-3) * known.best
    return solution


def test_algorithm_4_from_the_seed_ends_there_too(dataset):
    solution = check_near_optimum(dataset, dataset.seed)
    assert solution.history[0] < 1.25 * dataset.known.best
    assert 0 <= solution.gap < 1e-2 * solution.cost


@pytest.mark.parametrize('dataset', [INTEL, MANHATTAN], indirect=True, ids=lambda k: k.name)
@pytest.mark.parametrize('start', ['stored', 'odometry'])
def test_algorithm_4_from_other_starts_ends_there_too(dataset, start):
    check_near_optimum(dataset, getattr(dataset, start))


@pytest.mark.parametrize('dataset', [INTEL], indirect=True, ids=lambda k: k.name)
def test_with_the_dual_returned_it_goes_on_where_it_was(dataset):
    cholesky = dataset.method.cholesky
    first = minimise(dataset.graph, dataset.seed, OptimiserOptions(), cholesky)
    again = minimise(dataset.graph, first.poses, OptimiserOptions(), cholesky, first.dual)
    assert again.status is Status.CONVERGED
    assert again.outer_iterations <= 10
    assert first.cost - again.cost <= 5e-5 * first.cost
