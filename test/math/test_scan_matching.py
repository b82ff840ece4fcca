# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Matching: a known motion comes back, and what surfaces do not say is not claimed."""

import numpy as np
import pytest
from rooms import WALLS, box, scan_at
from worlds import compose

from l1slam_ros.core.scans.field import Field
from l1slam_ros.core.scans.matching import match
from l1slam_ros.core.scans.points import points_of

CORRIDOR = np.array([(-50, -1, 50, -1), (50, 1, -50, 1)], float)
HERE = np.array([1.5, 1.5, 0.3])


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def surface(pose, rng, walls=WALLS, noise=0.01, farthest=30.0):
    return points_of(scan_at(pose, rng, walls, noise, farthest)).surface


@pytest.mark.parametrize('motion', [(0.3, 0.1, 0.2), (-0.2, 0.25, -0.15), (0.0, 0.0, 0.3)])
@pytest.mark.parametrize(('noise', 'off'), [(0.0, 2e-3), (0.01, 6e-3)])
def test_a_known_motion_comes_back_to_millimetres(rng, motion, noise, off):
    field = Field.of(*surface(HERE, rng, noise=noise))
    there = compose(HERE, np.array(motion))
    found = match(field, *surface(there, rng, noise=noise), np.zeros(3))
    assert found.pose == pytest.approx(motion, abs=off)
    assert found.matched > 0.8 and found.curvature > 0.05


def test_a_corridor_says_nothing_along_itself(rng):
    heading = 0.4
    field = Field.of(*surface(np.array([0, 0, heading]), rng, CORRIDOR, farthest=8.0))
    ahead = 0.3 * np.array([np.cos(heading), -np.sin(heading), 0])
    found = match(field, *surface(np.array([0.3, 0, heading]), rng, CORRIDOR, farthest=8.0),
                  np.zeros(3))
    sigma = 1 / np.sqrt(np.linalg.eigvalsh(found.information[:2, :2]))
    assert sigma[0] > 5 * sigma[1] and found.curvature < 0.02
    values, vectors = np.linalg.eigh(found.information[:2, :2])
    assert abs(vectors[:, 0] @ ahead[:2]) == pytest.approx(0.3, abs=0.01), 'along, in its axes'
    box_field = Field.of(*surface(np.zeros(3), rng, box(-4, -1, 4, 1)))
    held = match(box_field, *surface(np.zeros(3), rng, box(-4, -1, 4, 1)), np.zeros(3))
    assert held.curvature > 5 * found.curvature


@pytest.mark.parametrize('seed', range(3))
def test_what_noisy_normals_say_along_a_corridor_is_nothing(seed):
    """A metre on, with 2 cm of noise, so that normals are off by some hundredths of a radian."""
    rng = np.random.default_rng(seed)
    field = Field.of(*surface(np.zeros(3), rng, CORRIDOR, 0.02, 8.0))
    wheels = np.array([1.0, 0.05, 0.02])
    W = np.diag(np.full(3, 0.4**-2))
    seen = surface(np.array([1.2, 0.0, 0.0]), rng, CORRIDOR, 0.02, 8.0)
    found = match(field, *seen, wheels, wheels, W)
    sigma = np.sqrt(np.diag(np.linalg.inv(found.information + W)))
    assert found.pose == pytest.approx((1.0, 0.0, 0.0), abs=0.02)
    assert sigma[0] == pytest.approx(0.4, abs=0.02) and (sigma[1:] < 0.05).all()


def test_where_nothing_matches_nothing_is_claimed(rng):
    field = Field.of(*surface(HERE, rng))
    found = match(field, np.array([[100.0, 100.0]]), np.array([[1.0, 0.0]]), np.zeros(3))
    assert found.matched == 0 and not found.information.any() and found.curvature == 0


def test_worse_fits_are_less_certain(rng):
    """The same shapes, what was measured three times as rough as a point is taken to be."""
    field = Field.of(*surface(HERE, rng))
    xy, normals = surface(HERE, rng)
    rough = xy + 0.09 * rng.standard_normal(len(xy))[:, None] * normals
    good, bad = match(field, xy, normals, np.zeros(3)), match(field, rough, normals, np.zeros(3))
    assert (np.linalg.eigvalsh(bad.information) < 0.7 * np.linalg.eigvalsh(good.information)).all()


def test_neighbours_that_are_off_together_say_less_than_noise(rng):
    """As much off, either each point by itself, or stretches of wall of more than a metre."""
    field = Field.of(*surface(HERE, rng))
    xy, normals = surface(HERE, rng)
    along_wall = np.arange(len(xy)) // 25 % 2 * 2.0 - 1.0
    off = 0.04 * np.stack((rng.permutation(along_wall), along_wall))
    noise, bent = (match(field, xy + each[:, None] * normals, normals, np.zeros(3)).information
                   for each in off)
    assert (np.linalg.eigvalsh(bent) < 0.75 * np.linalg.eigvalsh(noise)).all()
