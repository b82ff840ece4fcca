# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A search finds a scan from far, and is silent where two places look the same."""

import numpy as np
import pytest
from rooms import WALLS, box, scan_at
from scipy.spatial import KDTree
from worlds import between

from l1slam_ros.core.scans.field import Field
from l1slam_ros.core.scans.points import points_of
from l1slam_ros.core.scans.search import search

# [m] Cells and how far the look-up reaches; [rad] from one turn to the next; a likelihood of 1.
RESOLUTION, REACH, TURN, CERTAIN = 0.1, 0.6, 0.025, 255

HERE = np.array([1.5, 1.5, 0.3])


def surface(pose, walls=WALLS, seed=0):
    return points_of(scan_at(pose, np.random.default_rng(seed), walls)).surface


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


@pytest.mark.parametrize('there', [(2.2, 1.1, 2.0), (3.0, 1.2, -1.5), (1.0, 2.0, 0.3)])
def test_a_scan_is_found_from_far(there):
    field = Field.of(*surface(HERE))
    expected = between(HERE, np.array(there))
    peak = search(field, surface(there, seed=1)[0], np.array([1.5, -1, 0]), 4.0, np.pi, 0.3, 0.85)
    off = between(expected, peak.pose)
    assert np.hypot(*off[:2]) < 1.5 * RESOLUTION and abs(off[2]) < 1.5 * TURN
    assert peak.second < 0.85 * peak.score


def test_it_is_the_best_of_all_shifts_and_turns():
    """Branch and bound leaves out nothing: it agrees with trying each."""
    field = Field.of(*surface(HERE))
    xy = surface((2.0, 1.3, 0.8), seed=1)[0][::4]
    peak = search(field, xy, np.zeros(3), 1.0, 0.7, 0.05, 0.85)
    best = 0.0
    for turn in np.arange(-28, 29) * TURN:
        c, s = np.cos(turn), np.sin(turn)
        turned = xy @ np.array([[c, s], [-s, c]])
        cells = np.floor((turned - field.origin) / RESOLUTION).astype(int)
        for dx in range(-10, 11):
            for dy in range(-10, 11):
                a, b = (cells + (dx, dy)).T
                inside = (a >= 0) & (b >= 0) & (a < field.likelihood.shape[0]) & (
                    b < field.likelihood.shape[1])
                score = field.likelihood[a[inside], b[inside]].sum(dtype=int) / len(xy)
                best = max(best, float(score) / CERTAIN)
    assert peak.score == pytest.approx(best, abs=1e-6)


def test_a_search_looks_beyond_the_edges_of_the_map():
    """Where part of a scan, or all of it, is off the map, what is on it counts as ever."""
    field = Field.of(*surface(HERE))
    xy = surface((2.0, 1.3, 0.8), seed=1)[0]
    near = search(field, xy, np.zeros(3), 1.0, 0.7, 0.3, 0.85)
    for off in ((7.5, 0), (-7.5, 3), (0, -7.5), (5, 7.5)):
        far = search(field, xy, np.array([*off, 0.0]), 8.0, 0.7, 0.3, 0.85)
        assert far.score == pytest.approx(near.score, abs=0.02)
        assert np.allclose(far.pose, near.pose, atol=RESOLUTION + 1e-9)
        assert search(field, xy, np.array([300.0, *off[:1], 0.0]), 8.0, 0.7, 0.3, 0.85) is None


def test_of_two_equal_rooms_it_cannot_tell_which():
    rooms = np.concatenate((box(0, 0, 3, 2), box(4, 0, 7, 2)))
    xy, normals = (np.concatenate(parts) for parts in zip(
        *(surface((x, 1.0, 0.0), rooms) for x in (1.5, 5.5)), strict=True))
    # The second scan in the frame of the first: it was 4 m ahead.
    half = len(surface((1.5, 1.0, 0.0), rooms)[0])
    xy[half:, 0] += 4.0
    peak = search(Field.of(xy, normals), surface((1.7, 1.1, 0.0), rooms, 1)[0],
                  np.array([2.0, 0, 0]), 3.0, 0.5, 0.3, 0.85)
    assert peak.second > 0.85 * peak.score
    alone = search(Field.of(xy[:half], normals[:half]), surface((1.7, 1.1, 0.0), rooms, 1)[0],
                   np.array([2.0, 0, 0]), 3.0, 0.5, 0.3, 0.85)
    assert alone.second < 0.85 * alone.score


def test_what_fits_nowhere_is_not_found():
    field = Field.of(*surface(HERE))
    noise = np.random.default_rng(0).uniform(-3, 3, (100, 2))
    assert search(field, noise, np.zeros(3), 2.0, 1.0, 0.6, 0.85) is None
    nothing = np.zeros((0, 2))
    assert search(field, nothing, np.zeros(3), 1.0, 1.0, 0.1, 0.85) is None
    assert search(Field.of(nothing, nothing), noise, np.zeros(3), 1.0, 1.0, 0.1, 0.85) is None
