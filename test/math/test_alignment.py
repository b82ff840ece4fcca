# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Alignment and trajectory error, against hand-made cases, a search, and known graphs."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error, align, poses_at


def rotation(k, rng):
    if k == 3:
        return Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@pytest.mark.parametrize('k', [2, 3])
def test_a_rigid_motion_is_found(k, rng):
    for _ in range(20):
        estimate = rng.normal(size=(30, k))
        R = rotation(k, rng)
        t = 100 * rng.normal(size=k)
        truth = estimate @ R.T + t
        found_R, found_t = align(estimate, truth)
        np.testing.assert_allclose(found_R, R, atol=1e-12)
        np.testing.assert_allclose(found_t, t, atol=1e-10)
        assert absolute_trajectory_error(estimate, truth) < 1e-10


@pytest.mark.parametrize('k', [2, 3])
def test_no_motion_does_better(k, rng):
    estimate = rng.normal(size=(15, k))
    truth = estimate @ rotation(k, rng).T + rng.normal(size=k) + 0.3 * rng.normal(size=(15, k))

    def error(parameters):
        vector = parameters[:-k] if k == 3 else [0, 0, parameters[0]]
        R = Rotation.from_rotvec(vector).as_matrix()[:k, :k]
        return ((estimate @ R.T + parameters[-k:] - truth) ** 2).sum()

    starts = rng.normal(size=(6, 3 if k == 2 else 6))
    best = min(minimize(error, start, tol=1e-12).fun for start in starts)
    assert absolute_trajectory_error(estimate, truth) == pytest.approx(np.sqrt(best / 15))


@pytest.mark.parametrize('k', [2, 3])
def test_poor_geometry_still_gives_a_rotation(k):
    line = np.outer(np.arange(5.0), np.eye(k)[0])
    for estimate, truth in (line, line[:, ::-1]), (line * 0, line), (line[:1], line[1:2]):
        R, t = align(estimate, truth)
        np.testing.assert_allclose(R.T @ R, np.eye(k), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1) and np.isfinite(t).all()
    assert absolute_trajectory_error(line, line[:, ::-1]) < 1e-12
    # A mirror image is not matched by a reflection.
    corner = np.concatenate((line, np.eye(k), -2 * np.eye(k)))
    mirrored = corner * np.append(np.ones(k - 1), -1.0)
    assert np.linalg.det(align(corner, mirrored)[0]) == pytest.approx(1)
    assert absolute_trajectory_error(corner, mirrored) > 0.5


def test_poses_between_are_interpolated_and_neither_extrapolated_nor_bridged():
    times, poses = np.array([10, 20, 30, 90, 100]), np.arange(15.0).reshape(5, 3) / 10
    at = np.array([8, 9, 10, 25, 30, 31, 32, 60, 88, 89, 90, 95, 100, 101, 102])
    rows, found = poses_at(se2, times, poses, at, 20, 1)
    assert at[rows].tolist() == [9, 10, 25, 30, 31, 89, 90, 95, 100, 101]
    np.testing.assert_allclose(found[2, :2], poses[1:3, :2].mean(axis=0), atol=1e-12)
    # What lies beyond the end by rounding alone is at the end.
    np.testing.assert_allclose(found[[0, -1]], poses[[0, -1]], atol=1e-12)
