# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How far an estimated trajectory is from the truth, once both are of the same times and frame.

In: poses, or positions [m]. Out: the truth at the times of the estimate; the error.
"""

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold


def poses_at(
    manifold: Manifold, times: Indices, poses: Array, at: Indices, longest: int, tolerance: int
) -> tuple[Indices, Array]:
    """
    Return which of some times have poses between those known, and these: (k,) and (k, p).

    Linear in position and along the shorter arc in heading; nothing is extrapolated.

    Parameters
    ----------
    times, poses : (n,) ascending and (n, p), n >= 2, what is known
    at : (m,) the times that are asked about
    longest : between known times further apart nothing is interpolated
    tolerance : so near to a known time the pose is known

    """
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    since = at - times[after - 1]
    until = times[after] - at
    gap = since + until
    inside = (since >= 0) & (until >= 0) & (gap <= longest)
    rows = np.flatnonzero(inside | (np.minimum(np.abs(since), np.abs(until)) <= tolerance))
    part = np.clip(since[rows] / gap[rows], 0.0, 1.0)
    later = after[rows]
    return rows, manifold.interpolate(poses[later - 1], poses[later], part)


def align(estimate: Array, truth: Array) -> tuple[Array, Array]:
    """
    Return the rigid motion R, t that minimises sum |R estimate + t - truth|^2.

    Parameters
    ----------
    estimate, truth : (..., n, k) positions [m] of the same times, k = 2 or 3

    Returns
    -------
    R : (..., k, k) rotation, never a reflection; t : (..., k) [m].

    Raises
    ------
    GraphError : no position at all, or not as many of one as of the other.

    Source
    ------
    Umeyama, "Least-squares estimation of transformation parameters between two point patterns"
    (1991), equations 40, 41 and 43, with scale 1.

    """
    if estimate.shape != truth.shape or not estimate.shape[-2]:
        raise GraphError(f'{len(estimate)} positions of {estimate.shape[-1]} coordinates to align '
                         f'with {len(truth)} of {truth.shape[-1]}, expected as many, 1 or more')
    mean_estimate = estimate.mean(axis=-2, keepdims=True)
    mean_truth = truth.mean(axis=-2, keepdims=True)
    spread = np.swapaxes(truth - mean_truth, -1, -2) @ (estimate - mean_estimate)
    U, _, Vt = np.linalg.svd(spread)
    U[..., -1] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]
    R: Array = U @ Vt
    t: Array = (mean_truth - mean_estimate @ np.swapaxes(R, -1, -2))[..., 0, :]
    return R, t


def aligned_positions(estimate: Array, truth: Array) -> Array:
    """Return the estimated positions (n, k) [m] in the frame of the truth; see `align`."""
    R, t = align(estimate, truth)
    return estimate @ R.T + t


def absolute_trajectory_error(estimate: Array, truth: Array) -> float:
    """Return the RMSE of the positions (n, k) [m] after alignment; see `align`."""
    distance = np.linalg.norm(aligned_positions(estimate, truth) - truth, axis=1)
    return float(np.sqrt(np.mean(distance**2)))
