# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""An occupancy grid against the cells that each ray passes, found by its crossings of lines."""

import numpy as np
from rooms import scan_at

from l1slam_ros.core.scans.occupancy.grid import draw
from l1slam_ros.core.scans.points import points_of, transformed

# [log odds] Of one ray, and of all; [m] of a ray into the open, and before what it ends at.
FREE, OCCUPIED, MOST, OPEN, SHORT = 0.4, 0.85, 100.0, 8.0, 0.1


def passed(start, end):
    """Return the cells that a ray passes and the one it ends in, (k, 2), the last one last."""
    crossings = [np.zeros(1), np.ones(1)]
    for a, b in zip(start, end, strict=True):
        lines = np.arange(np.ceil(min(a, b)), np.floor(max(a, b)) + 1)
        crossings.append((lines - a) / (b - a))
    t = np.sort(np.concatenate(crossings))
    between = start + (t[:-1] + np.diff(t) / 2)[:, None] * (end - start)
    return np.floor(between).astype(int)


def test_each_ray_tells_the_cells_it_passes_and_the_one_it_ends_in():
    """Three scans of a room, of a laser that sees 6 m and is open beyond."""
    rng = np.random.default_rng(0)
    poses = np.array([(1.511, 1.523, 0.3), (2.013, 1.437, 0.9), (10.021, 1.609, -2.0)])
    seen = [points_of(scan_at(pose, rng, farthest=6.0)) for pose in poses]
    grid = draw(seen, poses)
    expected = np.zeros(grid.log_odds.shape)
    for points, pose in zip(seen, poses, strict=True):
        angles = (np.arange(len(points.view)) + 0.5) * 2 * np.pi / len(points.view)
        reach = np.where(np.isinf(points.view), OPEN, points.view - SHORT)
        free = reach[:, None] * np.column_stack((np.cos(angles), np.sin(angles)))
        ends = np.concatenate((free[~np.isnan(points.view)], points.xy))
        cells = (transformed(pose, ends) - grid.origin) / grid.resolution
        start = (pose[:2] - grid.origin) / grid.resolution
        for k, end in enumerate(cells):
            *free_cells, last = passed(start, end)
            expected[tuple(np.array(free_cells).T)] -= FREE
            expected[tuple(last)] += OCCUPIED * (k >= len(cells) - len(points.xy))
    np.testing.assert_allclose(grid.log_odds, np.maximum(expected, -MOST), rtol=1e-5, atol=1e-4)
    # With the thresholds of nav2's map saver.
    probability = 1 / (1 + np.exp(-expected))
    assert (grid.occupancy == np.where(
        probability > 0.65, 100, np.where(probability < 0.25, 0, -1))).all()
    assert grid.resolution == 0.05 and (grid.occupancy == 0).any()
    assert np.isinf(np.concatenate([points.view for points in seen])).any()


def test_of_nothing_there_is_a_grid_of_nothing():
    assert (draw([], np.zeros((0, 3))).occupancy == -1).all()
