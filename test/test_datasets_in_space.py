# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Public graphs in space: the optima that are known, in both readings of the rotation's noise."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses, pair_key
from l1slam_ros.core.names import ANGLE, QUATERNION
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.exact import minimise_interior_point
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import Status, l1_cost
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS, insert_loops
from l1slam_ros.io.graphs.graph_file import read_graph_file

SPHERE = 'sphere2500'
GARAGE = 'parking-garage'
GRID = 'real/smallGrid3D'


@cache
def loaded(folder, name, reading=QUATERNION):
    record = read_graph_file(folder / f'{name}.g2o', reading)
    cholesky = cholesky_of(record.graph)
    return record, cholesky, seed_poses(record.graph, cholesky)


@pytest.mark.parametrize(('name', 'reading', 'chi2'), [
    (SPHERE, QUATERNION, 727.149667), (SPHERE, ANGLE, 1351.2157), (GARAGE, QUATERNION, 1.238691),
    (GRID, QUATERNION, 458.1538), (GRID, ANGLE, 1025.3981)])
def test_chi2_at_the_l2_optimum(datasets, name, reading, chi2):
    record, cholesky, seed = loaded(datasets, name, reading)
    for start in seed, record.poses:
        solution = minimise_l2(record.graph, start, LeastSquaresOptions(), cholesky)
        assert solution.cost == pytest.approx(chi2, rel=1e-6)


@pytest.mark.parametrize(('name', 'best', 'rotations'), [
    (SPHERE, 2931.76, 954.92), (GARAGE, 87.7602, 2.63)])
def test_l1_optima(datasets, name, best, rotations):
    """From both starts, each with its proof; and what the seed's rotations alone cost."""
    record, cholesky, seed = loaded(datasets, name)
    rows = whitened_residual(record.graph, seed).reshape(-1, 6)
    assert l1_cost(rows[:, 3:]) < 1.01 * rotations
    for start in seed, odometry_poses(record.graph):
        solution = minimise_interior_point(record.graph, start, OptimiserOptions(), cholesky)
        assert solution.status is Status.CONVERGED and solution.gap < 2e-3 * solution.cost
        assert solution.cost < best


@pytest.mark.parametrize(('kind', 'count', 'seed'), [
    ('random', 2450, 0), ('grouped', 272, (1, 56, 10))])
def test_a_sphere_is_alike_everywhere_and_lies_do_not_agree_by_it(datasets, kind, count, seed):
    """Half of all loops, or runs that agree: none is kept, no true one lost, nothing doubted."""
    graph = loaded(datasets, SPHERE)[0].graph
    best = minimise_l2(graph, loaded(datasets, SPHERE)[2], LeastSquaresOptions(),
                       cholesky_of(graph)).poses
    lies = FALSE_LOOPS[kind](graph, best, count, np.random.default_rng(seed))
    spoiled = insert_loops(graph, lies)
    judgement, _ = robust_solve(spoiled)
    n = graph.n_poses
    is_false = np.isin(pair_key(spoiled.between.i, spoiled.between.j, n),
                       pair_key(lies.i, lies.j, n))
    assert is_false.sum() == count and judgement.doubts == ()
    assert_array_equal(judgement.accepted, ~is_false)
