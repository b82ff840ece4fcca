# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The cosines and sines of the plane's loops, beside those of the mathematical library."""

import numpy as np
import pytest

from l1slam_ros.core import kernels
from l1slam_ros.core.geometry.manifold import Array

EPS = np.finfo(float).eps


def turns(angle: Array) -> tuple[Array, Array]:
    """Return cosine and sine as the Jacobian with respect to pose j has them, (m,) each."""
    start = np.zeros((len(angle), 3))
    end = start.copy()
    end[:, 2] = angle
    J = kernels.se2.jacobians(start, start, end)
    return J[:, 1, 0, 0], J[:, 1, 1, 0]


@pytest.mark.parametrize('largest', [1e-9, 1.0, 10.0, 1e4, 1e8])
def test_turns_are_as_exact_as_the_angle(largest: float) -> None:
    angle = np.random.default_rng(1).uniform(-largest, largest, 10_001)
    c, s = turns(angle)
    bound = 2 * EPS + np.spacing(np.abs(angle))
    assert (np.abs(c - np.cos(angle)) <= bound).all()
    assert (np.abs(s - np.sin(angle)) <= bound).all()


def test_turns_of_quarters() -> None:
    """Where one polynomial takes over from the other, and on both sides of it."""
    eighths = np.arange(-40, 41) * np.pi / 4
    angle = np.concatenate((eighths, np.nextafter(eighths, 99), np.nextafter(eighths, -99)))
    c, s = turns(angle)
    bound = 2 * EPS + np.spacing(np.abs(angle))
    assert (np.abs(c - np.cos(angle)) <= bound).all()
    assert (np.abs(s - np.sin(angle)) <= bound).all()


def test_small_angles_keep_all_digits() -> None:
    angle = np.array([1e-300, -3e-17, 2e-8, 0.0])
    c, s = turns(angle)
    assert np.allclose(s, np.sin(angle), rtol=2 * EPS, atol=0)
    assert np.allclose(c, np.cos(angle), rtol=EPS, atol=0)


def test_no_angle_is_no_turn() -> None:
    """NaN stays NaN, infinity has no turn, and what is far too large remains a rotation."""
    c, s = turns(np.array([np.nan, np.inf, -np.inf]))
    assert np.isnan(c).all()
    assert np.isnan(s).all()
    c, s = turns(np.array([1e17, -1e30, 1e300]))
    assert np.allclose(c**2 + s**2, 1)


def test_the_residual_turns_alike() -> None:
    """t2v(Z^-1 Xi^-1 Xj) of turns in all quadrants, beside matrices."""
    rng = np.random.default_rng(2)
    z, x_i, x_j = rng.uniform(-7, 7, (3, 500, 3))
    T = []
    for pose in z, x_i, x_j:
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        rows = [[c, -s, pose[:, 0]], [s, c, pose[:, 1]], [0 * c, 0 * c, 0 * c + 1]]
        T.append(np.array(rows).transpose(2, 0, 1))
    E = np.linalg.inv(T[0]) @ np.linalg.inv(T[1]) @ T[2]
    e = kernels.se2.residual(z, x_i, x_j)
    assert np.allclose(e[:, :2], E[:, :2, 2], atol=1e-13)
    assert np.allclose(np.sin(e[:, 2]), E[:, 1, 0], atol=1e-13)
