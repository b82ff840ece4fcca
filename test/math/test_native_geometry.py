# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Residuals, Jacobians and curvature of factors as compiled, against NumPy and SciPy."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from l1slam_ros.core import native
from l1slam_ros.core.geometry import se2, se3

pytestmark = pytest.mark.usefixtures('level')
MANIFOLDS = pytest.mark.parametrize('manifold', [se2, se3], ids=lambda manifold: manifold.NAME)
M = 37
H = 1e-5  # of a central difference


def poses_of(manifold, rng):
    quaternion = Rotation.from_quat(rng.standard_normal((M, 4))).as_quat()
    return manifold.from_pose3(np.concatenate((rng.standard_normal((M, 3)), quaternion), axis=1))


def kernels_of(manifold):
    return getattr(native, manifold.NAME.lower())


def residual(manifold, z, x_i, x_j):
    """Return Z^-1 Xi^-1 Xj by rotation matrices, its turn as an angle or as 2 q_v, qw >= 0."""
    R_z, R_i, R_j = (manifold.rotation(x) for x in (z, x_i, x_j))
    t_z, t_i, t_j = (manifold.positions(x) for x in (z, x_i, x_j))
    seen = np.einsum('nba,nb->na', R_i, t_j - t_i) - t_z
    t, R = np.einsum('nba,nb->na', R_z, seen), (R_i @ R_z).transpose(0, 2, 1) @ R_j
    if manifold is se2:
        turn = np.arctan2(R[:, 1, 0], R[:, 0, 0])[:, None]
    else:
        q = Rotation.from_matrix(R).as_quat()
        turn = 2 * q[:, :3] * np.where(q[:, 3:] < 0, -1, 1)
    return np.concatenate((t, turn), axis=1)


def step(manifold, x, axis, length):
    tangent = np.zeros((len(x), manifold.TANGENT_SIZE))
    tangent[:, axis] = length
    return manifold.retract(x, tangent)


@MANIFOLDS
def test_steps_are_products_of_matrices(manifold, rng):
    """None, short ones, and turns beyond pi."""
    x, d = poses_of(manifold, rng), 3 * rng.standard_normal((M, manifold.TANGENT_SIZE))
    d[:9] *= np.array([0, 1e-300, 1e-160, 1e-9, 1e-8, 1e-4, 0.1, 1, 2])[:, None]
    t, turn = d[:, manifold.TRANSLATION], d[:, manifold.ROTATION]
    about = turn if manifold is se3 else turn * [0, 0, 1]
    size = manifold.positions(x).shape[1]
    R = Rotation.from_rotvec(about).as_matrix()[:, :size, :size]
    moved = kernels_of(manifold).retract(x, d)
    assert_allclose(manifold.rotation(moved), manifold.rotation(x) @ R, atol=1e-13)
    assert_allclose(manifold.positions(moved), manifold.positions(x) + np.einsum(
        'nab,nb->na', manifold.rotation(x), t), atol=1e-13)


@MANIFOLDS
def test_poses_are_products_along_their_trees(manifold, rng):
    """Of two trees, whose nodes come in any order; a ring is none."""
    relative, name = poses_of(manifold, rng), rng.permutation(M)
    parent = np.empty(M, np.int64)
    parent[name] = name[[0, 1, *(rng.integers(0, k) for k in range(2, M))]]
    poses = native.spanning_tree.compose(parent, relative)
    for k in range(M):
        expected, v = relative[[k]], k
        while parent[v] != v:
            v = parent[v]
            expected = manifold.compose(relative[[v]], expected)
        assert_allclose(manifold.local(poses[[k]], expected), 0, atol=1e-12)
    parent[name[[0, 1]]] = name[[1, 0]]
    with pytest.raises(TypeError, match='parent must be that of trees'):
        native.spanning_tree.compose(parent, relative)


def test_trees_are_breadth_first(rng):
    n = 40
    i, j = rng.integers(0, n - 3, (2, 60))  # the last three are joined with none
    roots = np.array([5, n - 1, 5])
    parent = native.spanning_tree.parents(i, j, n, roots)
    expected, reached = {5: 5}, [5]
    for v in reached:
        for other in [*np.sort(j[i == v]), *np.sort(i[j == v])]:
            if other not in expected:
                expected[other] = v
                reached.append(other)
    expected[n - 1] = n - 1
    assert parent.tolist() == [expected.get(v, -1) for v in range(n)]
    with pytest.raises(TypeError, match='nodes below n'):
        native.spanning_tree.parents(i, j, int(j.max()), roots[:1])


@MANIFOLDS
def test_residuals_are_those_of_matrices(manifold, rng):
    z, x_i, x_j = (poses_of(manifold, rng) for _ in range(3))
    assert_allclose(kernels_of(manifold).residual(z, x_i, x_j), residual(manifold, z, x_i, x_j),
                    atol=1e-13)


@MANIFOLDS
def test_jacobians_are_differences_of_residuals(manifold, rng):
    z, x_i, x_j = (poses_of(manifold, rng) for _ in range(3))
    z = manifold.retract(manifold.between(x_i, x_j), 0.1 * rng.standard_normal(
        (M, manifold.TANGENT_SIZE)))
    J = kernels_of(manifold).jacobians(z, x_i, x_j)
    for axis in range(manifold.TANGENT_SIZE):
        for side in range(2):
            more, less = ((step(manifold, x_i, axis, h), x_j) if side == 0 else
                          (x_i, step(manifold, x_j, axis, h)) for h in (H, -H))
            change = residual(manifold, z, *more) - residual(manifold, z, *less)
            assert_allclose(J[:, side, :, axis], change / (2 * H), atol=1e-8)


@MANIFOLDS
def test_curvature_is_the_difference_of_gradients(manifold, rng):
    """Of a step of both keyframes at once, along the diagonal and across it, alike either way."""
    k, kernels = manifold.TANGENT_SIZE, kernels_of(manifold)
    x_i, x_j = (poses_of(manifold, rng) for _ in range(2))
    z = manifold.retract(manifold.between(x_i, x_j), 0.1 * rng.standard_normal((M, k)))
    dual = rng.standard_normal((M, k))
    C, turns = kernels.curvature(z, x_i, x_j, dual), k // 2
    whole = np.zeros((M, 2 * k, 2 * k))
    for side in range(2):
        rows = slice(side * k + k - turns, side * k + k)
        whole[:, rows] = C[:, side]
        whole[:, :, rows] = C[:, side].transpose(0, 2, 1)

    def value(length, d):
        moved = (manifold.retract(x, length * d[:, part]) for x, part in
                 ((x_i, slice(0, k)), (x_j, slice(k, 2 * k))))
        return np.einsum('nk,nk->n', kernels.residual(z, *moved), dual)

    h = 1e-4
    for _ in range(3):
        d = rng.standard_normal((M, 2 * k))
        second = (value(h, d) - 2 * value(0, d) + value(-h, d)) / h**2
        assert_allclose(np.einsum('na,nab,nb->n', d, whole, d), second, atol=1e-5)


@MANIFOLDS
def test_arrays_that_do_not_fit_are_refused_by_name(manifold, rng):
    z, x_i, x_j = (poses_of(manifold, rng) for _ in range(3))
    for kernel in kernels_of(manifold).residual, kernels_of(manifold).jacobians:
        with pytest.raises(TypeError, match='x_i must be'):
            kernel(z, x_i[1:], x_j)
        with pytest.raises(TypeError, match='z must be a C-contiguous float64'):
            kernel(z[::2], x_i, x_j)
    with pytest.raises(TypeError, match='dual must be'):
        kernels_of(manifold).curvature(z, x_i, x_j, z[1:])
