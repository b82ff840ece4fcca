# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Covariance, information and its root: values, and what is refused and how it is said."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import random_information

from l1slam_ros.core.errors import L1SlamError, NoiseError
from l1slam_ros.core.geometry.noise import (
    LEAST_VARIANCE,
    MOST_OF_ODOMETRY,
    MOST_VARIANCE,
    distinct,
    root_of_inverse,
    square_root_information,
    usable,
    whiten,
    within_bounds,
)

ASYMMETRIC = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
INDEFINITE = np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def test_the_root_is_upper_triangular_and_gives_back_the_information(rng):
    information = random_information(50, rng)
    root = square_root_information(information)
    assert_allclose(root, np.triu(root))
    assert_allclose(root.transpose(0, 2, 1) @ root, information, atol=1e-12)
    assert (np.diagonal(root, axis1=1, axis2=2) > 0).all()


def test_whitening_of_vectors_and_of_matrices(rng):
    root = square_root_information(random_information(7, rng))
    vectors, matrices = rng.standard_normal((7, 3)), rng.standard_normal((7, 3, 6))
    for k in range(7):
        assert_allclose(whiten(root, vectors)[k], root[k] @ vectors[k])
        assert_allclose(whiten(root, matrices)[k], root[k] @ matrices[k])
    squared = np.einsum('ki,kij,kj->k', vectors, root.transpose(0, 2, 1) @ root, vectors)
    assert_allclose((whiten(root, vectors) ** 2).sum(axis=1), squared)


def test_no_matrix_at_all_is_none_wrong():
    assert square_root_information(np.zeros((0, 3, 3))).shape == (0, 3, 3)
    assert root_of_inverse(np.zeros((0, 6, 6))).shape == (0, 6, 6)


@pytest.mark.parametrize('bad, said', [
    (np.diag([1.0, np.nan, 1.0]), 'matrix 2 is not finite: [1 0 0; 0 nan 0; 0 0 1]'),
    (np.diag([1.0, np.inf, 1.0]), 'matrix 2 is not finite: [1 0 0; 0 inf 0; 0 0 1]'),
    (ASYMMETRIC, 'matrix 2 is not symmetric: [1 0.5 0; 0 1 0; 0 0 1]'),
    (INDEFINITE, 'matrix 2 is not positive definite: [1 2 0; 2 1 0; 0 0 1]'),
    (np.zeros((3, 3)), 'matrix 2 is not positive definite: [0 0 0; 0 0 0; 0 0 0]'),
    (-np.eye(3), 'matrix 2 is not positive definite: [-1 -0 -0; -0 -1 -0; -0 -0 -1]'),
])
def test_the_first_bad_matrix_is_named(bad, said):
    stack = np.array([np.eye(3), np.eye(3), bad, bad])
    with pytest.raises(NoiseError) as caught:
        square_root_information(stack)
    assert str(caught.value) == said
    assert isinstance(caught.value, L1SlamError)


def test_the_print_of_a_file_may_be_a_little_asymmetric():
    printed = np.array([[[50.0, 1.00001], [1.00002, 20.0]]])
    assert np.isfinite(square_root_information(printed)).all()


@pytest.mark.parametrize('covariance', [
    np.eye(3), 9999 * np.eye(3), 0.1 * np.eye(3), 1e-9 * np.eye(3), np.diag([1e-6, 1e-6, 9999.0]),
    1e-300 * np.eye(3), 1e300 * np.eye(3), np.diag([0.1, 1e-300, 1e300]),
], ids=['1', '9999', '.1', '1e-9', 'heading unknown', '1e-300', '1e300', 'from 1e-300 to 1e300'])
def test_usable_covariances(covariance):
    assert usable(covariance[None])[0]


@pytest.mark.parametrize('covariance', [
    np.zeros((3, 3)), -np.eye(3), np.full((3, 3), -1.0), np.full((3, 3), np.nan),
    np.diag([1.0, np.inf, 1.0]), np.full((3, 3), 1e308), np.full((3, 3), 9999.0),
    np.diag([0.1, 0.1, 0.0]), np.diag([1.0, 1.0, -1.0]), ASYMMETRIC, INDEFINITE,
], ids=['0', 'diagonal -1', '-1', 'nan', 'inf', '1e308', '9999', 'no heading', 'flag',
        'asymmetric', 'indefinite'])
def test_unusable_covariances(covariance):
    assert not usable(covariance[None])[0]


def test_a_root_of_the_inverse_whitens_as_that_of_the_information(rng):
    covariance = random_information(50, rng)
    root = root_of_inverse(covariance)
    assert_allclose(root, np.triu(root))
    assert_allclose(root, square_root_information(np.linalg.inv(covariance)), rtol=1e-7,
                    atol=1e-9)


MODEL = np.diag([0.4, 0.5, 0.6])


@pytest.mark.parametrize('stated, of_loop, of_odometry', [
    (1e300, MOST_VARIANCE, 0.5), (1e-300, 0.5, 0.5), (1e-9, 0.5, 0.5),
    (1.1 * MOST_VARIANCE, MOST_VARIANCE, 0.5), (MOST_VARIANCE, MOST_VARIANCE, MOST_OF_ODOMETRY),
    (LEAST_VARIANCE,) * 3])
def test_variances_are_bounded_and_the_others_stay(stated, of_loop, of_odometry):
    """One component, correlated with the others by a half."""
    def correlated(variance, by):
        sigma = np.array([2.0, np.sqrt(variance), 3.0])
        return np.outer(sigma, sigma) * ([1, by, 0.5], [by, 1, by], [0.5, by, 1])

    for used, bounds in ((of_loop, (MOST_VARIANCE,)), (of_odometry, (MOST_OF_ODOMETRY,
                                                                     MOST_VARIANCE))):
        found, bounded = within_bounds(correlated(stated, 0.5)[None], MODEL, *bounds)
        assert_allclose(found[0], correlated(used, 0.0 if used == 0.5 else 0.5), rtol=1e-12)
        assert_allclose(np.reshape(bounded, (-1, 2)),
                        [(stated, used)] if stated != used else np.zeros((0, 2)))


@pytest.mark.parametrize('kinds, count', [(3, 100), (50, 100), (1, 0)])
def test_equal_matrices_are_found(kinds, count, rng):
    each = rng.standard_normal((kinds, 3, 3))
    matrices = each[rng.integers(kinds, size=count)]
    rows, which = distinct(matrices)
    assert_array_equal(matrices[rows][which], matrices)
    assert len(rows) == (min(kinds, count) if kinds <= count / 10 else count)
