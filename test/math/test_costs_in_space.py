# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The exact solver on public graphs in space: the lowest L1 costs that are known."""

import pytest

from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.exact import minimise_interior_point
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import Status, l1_cost
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.io.graphs.graph_file import read_graph_file


@pytest.mark.parametrize(('name', 'best', 'rotations'), [
    ('sphere2500', 2931.76, 954.92), ('parking-garage', 87.7602, 2.63)])
def test_l1_optima(datasets, name, best, rotations):
    """From both starts, each with its proof; and what the seed's rotations alone cost."""
    record = read_graph_file(datasets / f'{name}.g2o')
    cholesky = cholesky_of(record.graph)
    seed = seed_poses(record.graph, cholesky)
    rows = whitened_residual(record.graph, seed).reshape(-1, 6)
    assert l1_cost(rows[:, 3:]) < 1.01 * rotations
    for start in seed, odometry_poses(record.graph):
        solution = minimise_interior_point(record.graph, start, OptimiserOptions(), cholesky)
        assert solution.status is Status.CONVERGED and solution.gap < 2e-3 * solution.cost
        assert solution.cost < best
