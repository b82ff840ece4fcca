# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Where in a map a scan fits best, without a guess; and whether it fits nearly as well elsewhere.

Branch and bound over shifts and turns (Hess et al. 2016), on the likelihood of a field.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans.field import ACROSS, CERTAIN, RESOLUTION, WIDTH, Field

# [rad] Step of the turns: at 4 m a cell.
TURN = 0.025
# So many points are enough to tell a place.
_MOST_POINTS = 160
# [m], [rad] Nearer than this another peak is the same one.
_SAME, _SAME_TURN = 0.6, 0.3


@dataclass(frozen=True)
class Peak:
    """Where a scan fits: pose (3,), score from 0 to 1; second : that of the best other place."""

    pose: Array
    score: float
    second: float


def search(field: Field, xy: Array, centre: Array, reach: float, turn: float, least: float,
           rival: float) -> Peak | None:
    """
    Return where points fit best around a pose; None: nowhere better than `least`.

    centre : (3,) pose to search around; reach, turn : so far [m], [rad]; rival : of another place
    it is found out only whether its score is above so much of the best
    """
    if not len(xy) or not len(field.xy):
        return None
    points = xy[np.linspace(0, len(xy) - 1, min(len(xy), _MOST_POINTS)).astype(np.int64)]
    turns = np.arange(-int(turn / TURN), int(turn / TURN) + 1) * TURN + centre[2]
    most = int(reach / RESOLUTION)
    if 2 * most >= WIDTH * ACROSS:
        raise ValueError(f'a search reaches {WIDTH * ACROSS * RESOLUTION / 2} m at most')
    # Where the points would be without a turn at the lowest shift, in cells of the levels.
    start = (centre[:2] - field.origin) / RESOLUTION + WIDTH - most
    certain = CERTAIN * len(points)
    # Around a peak so many turns, which begin anew after a whole one, and cells are the same one.
    same = np.array([_SAME_TURN / TURN, _SAME / RESOLUTION, 2 * np.pi / TURN])
    best, at, column, row, second = native.branch_and_bound.search(
        field.levels, field.blocks, points / RESOLUTION,
        np.column_stack((np.cos(turns), np.sin(turns))), start, 2 * most, least * certain, rival,
        same)
    if at < 0:
        return None
    shift = RESOLUTION * (np.array([column, row]) - most)
    return Peak(np.array([*(centre[:2] + shift), turns[at]]), best / certain, second / certain)
