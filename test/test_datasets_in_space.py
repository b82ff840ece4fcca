# SPDX-License-Identifier: Apache-2.0
"""Public graphs in space: the optima that are known, in both readings of the rotation's noise."""

from functools import cache

import pytest

from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.names import ANGLE, QUATERNION
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.exact import minimise_interior_point
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import Status, l1_cost
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.io.graphs.graph_file import read_graph_file

SPHERE, GARAGE, GRID = 'sphere2500', 'parking-garage', 'real/smallGrid3D'


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
