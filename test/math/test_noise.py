# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Covariance, information and its root, in NumPy; which matrices are covariances at all."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import random_information

from l1slam_ros.core.geometry.noise import (
    LEAST_VARIANCE,
    MOST_OF_ODOMETRY,
    MOST_VARIANCE,
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
    of_inverse = root_of_inverse(np.linalg.inv(information))
    assert_allclose(of_inverse, np.triu(of_inverse))
    assert_allclose(of_inverse, root, rtol=1e-7, atol=1e-9)


def test_the_squares_of_what_is_whitened_are_those_of_mahalanobis(rng):
    information = random_information(7, rng)
    root, vectors = square_root_information(information), rng.standard_normal((7, 3))
    squared = np.einsum('ki,kij,kj->k', vectors, information, vectors)
    assert_allclose((whiten(root, vectors)**2).sum(axis=1), squared)
    assert_allclose(whiten(root, vectors[:, :, None])[..., 0], whiten(root, vectors))


@pytest.mark.parametrize('covariance', [
    np.eye(3), 9999 * np.eye(3), 1e-9 * np.eye(3), np.diag([1e-6, 1e-6, 9999.0]),
    1e-300 * np.eye(3), 1e300 * np.eye(3), np.diag([0.1, 1e-300, 1e300])])
def test_a_covariance_may_be_of_any_size(covariance):
    assert usable(covariance[None])[0]


@pytest.mark.parametrize('covariance', [
    np.zeros((3, 3)), -np.eye(3), np.full((3, 3), -1.0), np.full((3, 3), np.nan),
    np.diag([1.0, np.inf, 1.0]), np.full((3, 3), 1e308), np.full((3, 3), 9999.0),
    np.diag([0.1, 0.1, 0.0]), np.diag([1.0, 1.0, -1.0]), ASYMMETRIC, INDEFINITE])
def test_what_is_no_covariance_is_known(covariance):
    assert not usable(covariance[None])[0]


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
