# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Point-to-line matching of a scan with a map, and how certain it is.

The step of a pose is in the axes of the moving scan (x, y, heading), as everywhere in this
package. Minimised is

    sum rho(e_k / sigma) / KAPPA + |t2v(prior^-1 pose)|^2_W,

e_k the distance of point k from the line through the map's nearest one, rho Cauchy's. Neighbouring
points say nearly the same (the surface between them is one), so KAPPA of them count as one.

Source: Censi, "An ICP variant using a point-to-line metric", 2008; the count of points: ours.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans import kernels
from l1slam_ros.core.scans.field import REACH, RESOLUTION, Field
from l1slam_ros.core.scans.points import turn

# [m] Noise of a point off its line, in a map of several scans; where Cauchy's weight turns over.
SIGMA = 0.03
_SCALE = 3 * SIGMA
# [m] No laser, and no map of it, is taken to be better than this.
FINEST = 0.02
# So many points along a surface count as one. From simulated drives, with `FINEST` and the floor
# of the odometry: the squared error of a step, over its variance, is 1 in x, y and heading.
KAPPA = 1.5
_VARIANCE = KAPPA * SIGMA**2
# What a step is held by where neither points nor a prior hold it.
_LEAST = 1e-9 * np.eye(3)
# [rad] Normals are off by so much: what they say of the way along a wall is noise.
_OFF_NORMAL = 0.05
# [m] Points farther than this do not match: by rounds, narrower each time.
_WIDEST = REACH
_NARROWEST = 0.15
_SHRINK = 0.75
_MOST_ITERATIONS = 20
# [m], [rad] A step that is no step any more.
_STILL = 1e-4
# Number of the sums; where they have the entries of H.
_SUMS = 17
_SYMMETRIC = np.array(((0, 1, 2), (1, 3, 4), (2, 4, 5)))
# Points of so many in a row, about half a metre, may be off by one cause.
_TOGETHER = 10


@dataclass(frozen=True)
class Match:
    """
    Where a scan lies in a map.

    pose : (3,); information : (3, 3) of the matched points alone, in the axes of the pose, see
    `_information`; matched : part of the points that found the map; curvature : the least
    eigenvalue of H over the number of matches, lengths measured in the scan's radius: 0 where a
    direction is not held
    """

    pose: Array
    information: Array
    matched: float
    curvature: float


def match(field: Field, xy: Array, normals: Array, start: Array, prior: Array | None = None,
          prior_information: Array | None = None, widest: float = _WIDEST) -> Match:
    """
    Match points (n, 2) that have normals (n, 2) with a map, from a pose (3,) on.

    prior : (3,) pose that is expected, with `prior_information` (3, 3) in its axes; widest : gate
    of the first round [m]
    """
    pose = start.astype(float)
    gate = widest
    H = np.zeros((3, 3))
    sums = np.zeros(_SUMS)
    radius = float(np.sqrt((xy**2).sum(axis=1).mean())) if len(xy) else 1.0
    units = np.array([1.0, 1.0, 1.0 / max(radius, 0.1)])
    for _ in range(_MOST_ITERATIONS):
        H, g, sums = _sums(field, xy, normals, pose, gate)
        H, g = _held(H, g, units)
        A, b = H / _VARIANCE, g / _VARIANCE
        if prior is not None and prior_information is not None:
            expected = se2.between(prior[None], pose[None])[0]
            J = np.eye(3)
            J[:2, :2] = turn(expected[2]).T
            weighted = J.T @ prior_information
            A = A + weighted @ J
            b = b + weighted @ expected
        step = np.negative(np.linalg.solve(A + _LEAST, b))
        pose = se2.retract(pose[None], step[None])[0]
        narrow = gate <= _NARROWEST
        gate = max(gate * _SHRINK, _NARROWEST)
        if narrow and abs(step).max() < _STILL:
            break
    count = sums[15]
    curvature = float(np.linalg.eigvalsh(H * np.outer(units, units))[0] / max(count, 1.0))
    square = max(FINEST**2, sums[16] / max(count, 1.0))
    information = _information(H, sums[6 + _SYMMETRIC], KAPPA * square)
    return Match(pose, information, count / max(len(xy), 1), curvature)


def _sums(field: Field, xy: Array, normals: Array, pose: Array, gate: float
          ) -> tuple[Array, Array, Array]:
    sums = np.zeros(_SUMS)
    kernels.normal_equations(
        xy, normals, field.xy, field.normals, field.nearest, field.origin, RESOLUTION, pose, gate,
        _SCALE, _TOGETHER, sums)
    return sums[_SYMMETRIC], sums[12:15], sums


def _held(H: Array, g: Array, units: Array) -> tuple[Array, Array]:
    """
    Return the sums without what is said of a direction by the errors of normals alone.

    units : (3,) in which directions are compared
    """
    values, axes = np.linalg.eigh(H * np.outer(units, units))
    noise = _OFF_NORMAL**2 * (H[0, 0] + H[1, 1])
    part = np.maximum(1 - noise / np.maximum(values, 1e-12), 0.0)
    V = axes / units[:, None]
    return (V * (part * values)) @ V.T, V @ (part * (axes.T @ (units * g)))


def _information(H: Array, scatter: Array, variance: float) -> Array:
    """
    Return the information of matched points, (3, 3): H over a variance [m^2], or less.

    Where neighbours are off together (what has moved, normals of what is bent, a map whose scans
    disagree) the gradient's covariance is `scatter`, the sum of the squares of its parts, and not
    the variance times H. Of each direction the greater of both counts.

    Source: White, "Maximum likelihood estimation of misspecified models", 1982; groups: Liang and
    Zeger, "Longitudinal data analysis using generalized linear models", 1986.
    """
    L = np.linalg.cholesky(H + _LEAST)
    values, axes = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, scatter).T) / variance)
    root = H @ np.linalg.solve(L.T, axes)
    return (root / np.maximum(values, 1.0)) @ root.T / variance
