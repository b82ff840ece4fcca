# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A field finds the nearest point by a look-up."""

import numpy as np
from scipy.spatial import KDTree

from l1slam_ros.core.scans.field import CERTAIN, REACH, RESOLUTION, Field
from l1slam_ros.core.scans.search_kernels import ACROSS, WIDTH


def test_what_is_looked_up_is_the_nearest_point():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-3, 4, (120, 2))
    field = Field.of(xy, np.ones_like(xy))
    a, b = field.nearest.shape
    centres = field.origin + RESOLUTION * (np.stack(
        np.meshgrid(np.arange(a), np.arange(b), indexing='ij'), axis=2) + 0.5)
    distance, nearest = KDTree(xy).query(centres)
    near = distance < REACH - 1e-9
    assert (field.nearest[near] == nearest[near]).all()
    assert (field.nearest[distance > REACH + 1e-9] == -1).all()
    expected = np.where(near, np.exp(-distance**2 / (2 * RESOLUTION**2)), 0)
    assert np.allclose(field.likelihood / CERTAIN, expected, atol=0.5 / CERTAIN + 1e-6)


def test_a_level_bounds_what_is_in_its_cells():
    rng = np.random.default_rng(1)
    field = Field.of(rng.uniform(0, 4, (20, 2)), np.ones((20, 2)))
    levels = field.levels
    for height, level in enumerate(levels):
        width = 1 << height
        for a, b in rng.integers(0, np.array(level.shape) - width, (50, 2)):
            assert level[a, b] == levels[0][a : a + width, b : b + width].max()
        assert not level[[0, -1]].any() and not level[:, [0, -1]].any()
    assert (levels[0][WIDTH:-1, WIDTH:-1] == field.likelihood).all()


def test_blocks_are_the_widest_level():
    rng = np.random.default_rng(2)
    field = Field.of(rng.uniform(0, 6, (20, 2)), np.ones((20, 2)))
    last = field.levels[-1]
    blocks = field.blocks[..., ACROSS:-ACROSS]
    for a, b in rng.integers(0, last.shape, (100, 2)):
        assert blocks[a % WIDTH, b % WIDTH, a // WIDTH, b // WIDTH] == last[a, b]
    assert blocks.sum(dtype=int) == field.blocks.sum(dtype=int) == last.sum(dtype=int)


def test_a_field_of_nothing_has_nothing():
    field = Field.of(np.zeros((0, 2)), np.zeros((0, 2)))
    assert (field.nearest == -1).all() and not field.likelihood.any()
