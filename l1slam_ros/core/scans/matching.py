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

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans.field import REACH, RESOLUTION, Field

# [m] Noise of a point off its line, in a map of several scans; where Cauchy's weight turns over.
SIGMA = 0.03
_SCALE = 3 * SIGMA
# [m] No laser, and no map of it, is taken to be better than this.
FINEST = 0.02
# So many points along a surface count as one. From simulated drives, with `FINEST` and the floor
# of the odometry: the squared error of a step, over its variance, is 1 in x, y and heading.
KAPPA = 1.5
_VARIANCE = KAPPA * SIGMA**2
# [rad] Normals are off by so much: what they say of the way along a wall is noise.
_OFF_NORMAL = 0.05
# [m] Points farther than this do not match in the first round; the gate of later ones is narrower.
_WIDEST = REACH
# Of no prior.
_NOTHING = np.zeros((3, 3))


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

    All rounds of Gauss-Newton are one call. What noisy normals say of the way along a wall is
    taken out of H and g in each, direction by direction.
    """
    radius = float(np.sqrt((xy**2).sum(axis=1).mean())) if len(xy) else 1.0
    # In which directions are compared.
    units = np.array([1.0, 1.0, 1.0 / max(radius, 0.1)])
    if prior is None or prior_information is None:
        prior, prior_information = start, _NOTHING
    pose, H, least, sums = native.scan_matching.match(
        xy, normals, field.xy, field.normals, field.nearest, field.origin, RESOLUTION, start,
        prior, prior_information, units, widest, _SCALE, _VARIANCE, _OFF_NORMAL)
    count = float(sums[15])
    square = max(FINEST**2, float(sums[16]) / max(count, 1.0))
    information = _information(H, sums[6:12], KAPPA * square)
    return Match(pose, information, count / max(len(xy), 1), least / max(count, 1.0))


def _information(H: Array, scatter: Array, variance: float) -> Array:
    """
    Return the information of matched points, (3, 3): H over a variance [m^2], or less.

    Where neighbours are off together (what has moved, normals of what is bent, a map whose scans
    disagree) the gradient's covariance is `scatter`, the sum of the squares of its parts (6,), and
    not the variance times H. Of each direction the greater of both counts.

    Source: White, "Maximum likelihood estimation of misspecified models", 1982; groups: Liang and
    Zeger, "Longitudinal data analysis using generalized linear models", 1986.
    """
    return native.scan_matching.information(H, scatter, variance)
