# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The occupancy grid agrees with the room, and others read its files as it is meant."""

import numpy as np
import pytest
import yaml
from PIL import Image
from rooms import WALLS, along, scan_at
from scipy.spatial import KDTree

from l1slam_ros.core.scans.occupancy.grid import Grid, draw
from l1slam_ros.core.scans.points import Points, points_of
from l1slam_ros.io.scans.grid_file import write_grid

ROUND = along(np.array([(1.5, 1.5), (10.5, 1.5), (10.5, 6.5), (1.5, 6.5), (1.5, 1.8)]), 0.5)


def seen_from(poses, seed=0, noise=0.01):
    rng = np.random.default_rng(seed)
    return [points_of(scan_at(pose, rng, noise=noise)) for pose in poses]


@pytest.fixture(scope='module')
def grid():
    return draw(seen_from(ROUND), ROUND)


def centres(grid):
    """Return the centres of all cells, (a, b, 2) [m]."""
    return grid.origin + grid.resolution * (0.5 + np.stack(np.meshgrid(
        *map(np.arange, grid.log_odds.shape), indexing='ij'), axis=2))


def test_cells_agree_with_the_one_drawn_by_truth(grid):
    """Poses as wrong as a good map: of the cells known to both 97% are the same."""
    rng = np.random.default_rng(1)
    wrong = ROUND + rng.standard_normal(ROUND.shape) * (0.01, 0.01, 0.002)
    ours = draw(seen_from(ROUND, seed=2), wrong)
    shift = np.round((ours.origin - grid.origin) / grid.resolution).astype(int)
    a, b = grid.occupancy, ours.occupancy
    low = np.maximum(shift, 0)
    high = np.minimum(a.shape, shift + b.shape)
    a = a[low[0]:high[0], low[1]:high[1]]
    b = b[low[0] - shift[0]:high[0] - shift[0], low[1] - shift[1]:high[1] - shift[1]]
    both = (a >= 0) & (b >= 0)
    assert both.sum() > 0.9 * (a >= 0).sum() and (a == b)[both].mean() >= 0.97


def test_what_is_occupied_is_wall_and_what_is_free_is_not(grid):
    """Walls sampled each centimetre, for an independent drawing of the room."""
    part = np.linspace(0, 1, 1200)[:, None, None]
    walls = KDTree((WALLS[:, :2] + part * (WALLS[:, 2:] - WALLS[:, :2])).reshape(-1, 2))
    distance = walls.query(centres(grid))[0]
    occupancy = grid.occupancy
    assert (distance[occupancy == 100] < 0.08).mean() > 0.97
    assert (distance[occupancy == 0] > 0.02).mean() > 0.97
    x, y = np.moveaxis(centres(grid), 2, 0)
    block = (x > 3.2) & (x < 8.8) & (y > 3.2) & (y < 4.8)
    outside = (x < -0.2) | (x > 12.2) | (y < -0.2) | (y > 8.2)
    assert (occupancy[block] == -1).all(), 'nothing looked into the block'
    assert (occupancy[outside] == -1).all()
    free = (x > 0.5) & (x < 11) & (y > 0.9) & (y < 1.9)
    assert (occupancy[free] == 0).mean() > 0.99


def test_rays_into_the_open_are_free_and_end_at_nothing():
    view = np.full(720, np.inf)
    alone = Points(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(2), view)
    occupancy = draw([alone] * 3, np.zeros((3, 3))).occupancy
    assert not (occupancy == 100).any()
    assert (occupancy == 0).sum() * 0.05**2 == pytest.approx(np.pi * 8**2, rel=0.05)


def test_of_nothing_there_is_a_grid_of_nothing():
    grid = draw([], np.zeros((0, 3)))
    assert (grid.occupancy == -1).all()


def test_a_map_server_reads_the_files_as_the_grid(grid, tmp_path):
    """As nav2's map_io.cpp has it: occupancy by shade, the lower left pixel at the origin."""
    write_grid(tmp_path / 'room.pgm', grid)
    document = yaml.safe_load((tmp_path / 'room.yaml').read_text())
    shade = np.array(Image.open(tmp_path / document['image'])).astype(float)
    assert document['mode'] == 'trinary' and document['negate'] == 0
    probability = (255 - shade) / 255
    read = np.where(probability > document['occupied_thresh'], 100,
                    np.where(probability < document['free_thresh'], 0, -1))
    assert (grid.occupancy == read[::-1].T).all()
    assert document['origin'] == pytest.approx([*grid.origin, 0.0], abs=1e-6)
    assert document['resolution'] == grid.resolution
    # A wall stands where these say: the left one, at x = 0.
    row, column = np.nonzero(read == 100)
    assert document['origin'][0] + 0.05 * column.min() == pytest.approx(0, abs=0.11)
    assert document['origin'][1] + 0.05 * (len(read) - row.max() - 1) == pytest.approx(0, abs=0.11)


def test_cells_have_the_thresholds_of_a_map_saver():
    """In log odds: what is more than .65 is occupied, less than .25 free."""
    odds = np.log(np.array([0.64, 0.66, 0.26, 0.24]) / np.array([0.36, 0.34, 0.74, 0.76]))
    grid = Grid(odds[None].astype(np.float32), np.zeros(2), 0.05)
    assert grid.occupancy.tolist() == [[-1, 100, -1, 0]]
