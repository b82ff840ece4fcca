# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Points of scans: where they are, how far apart, and which way their surfaces look."""

import numpy as np
import pytest
from rooms import WALLS, box, ranges_at, ranges_on_the_way, scan_at
from worlds import compose

from l1slam_ros.core.scans.points import Mount, Scan, points_of, transformed

ROOM = box(-3, -2, 5, 4)
POSE = np.array([1.0, 0.5, 0.7])


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def off_walls(xy, walls):
    """Return how far points (n, 2) are from the nearest of some walls, (n,)."""
    a, d = walls[:, :2], walls[:, 2:] - walls[:, :2]
    part = np.clip(((xy[:, None] - a) * d).sum(axis=2) / (d**2).sum(axis=1), 0, 1)
    return np.hypot(*np.moveaxis(xy[:, None] - a - part[..., None] * d, 2, 0)).min(axis=1)


def test_points_lie_on_the_walls_and_apart(rng):
    points = points_of(scan_at(POSE, rng, noise=0.0))
    assert off_walls(transformed(POSE, points.xy), WALLS).max() < 1e-9
    assert np.hypot(*np.diff(points.xy, axis=0).T).min() >= 0.05


@pytest.mark.parametrize('noise, most, part', [(0.01, 5, 0.9), (0.05, 8, 0.8)])
def test_normals_are_square_to_the_walls_and_look_at_the_robot(rng, noise, most, part):
    points = points_of(Scan(0, ranges_at(POSE, rng, ROOM, noise, 360), 0.0, 2 * np.pi / 360, 0.05,
                            30.0))
    xy, normals = points.surface
    assert len(xy) > 0.9 * len(points.xy)
    assert np.hypot(*normals.T) == pytest.approx(1)
    assert ((normals * xy).sum(axis=1) < 0).all()
    angle = np.arctan2(*normals.T[::-1]) + POSE[2]
    off = abs(angle - np.round(angle / (np.pi / 2)) * np.pi / 2)
    assert np.degrees(np.quantile(off, part)) < most


def test_a_point_of_no_surface_has_no_normal():
    ranges = np.full(90, np.inf)
    ranges[40] = 2.0
    points = points_of(Scan(0, ranges, 0.0, 0.02, 0.1, 30.0))
    assert len(points.xy) == 1 and not points.normals.any() and not len(points.surface[0])


def test_no_point_is_made_of_what_is_no_range():
    ranges = np.array([np.nan, 0.0, 0.05, np.inf, 31.0, 2.0])
    points = points_of(Scan(0, ranges, 0.0, 0.5, 0.1, 30.0))
    assert points.xy == pytest.approx(2.0 * np.array([[np.cos(2.5), np.sin(2.5)]]))


def test_the_view_tells_what_was_far_from_what_was_not_looked_at():
    ranges = np.full(91, 2.0)
    ranges[:30] = np.inf
    view = points_of(Scan(0, ranges, 0.0, np.pi / 90, 0.1, 30.0)).view
    degrees = (np.arange(len(view)) + 0.5) * 360 / len(view)
    assert np.isposinf(view[(degrees > 1) & (degrees < 57)]).all()
    assert (view[(degrees > 61) & (degrees < 179)] == 2.0).all()
    assert np.isnan(view[degrees > 184]).all()


def test_where_the_laser_is_goes_into_the_points(rng):
    mount = Mount(0.3, -0.1, 2.0)
    at = compose(POSE, np.array([0.3, -0.1, 2.0]))
    points = points_of(scan_at(at, rng, noise=0.0), mount)
    assert off_walls(transformed(POSE, points.xy), WALLS).max() < 1e-9
    assert points.centre.tolist() == [0.3, -0.1]


def test_a_laser_that_hangs_sees_its_rays_go_clockwise(rng):
    ranges = np.roll(ranges_at(POSE, rng, noise=0.0)[::-1], 1)
    points = points_of(Scan(0, ranges, 0.0, 2 * np.pi / len(ranges)), Mount(upside_down=True))
    assert off_walls(transformed(POSE, points.xy), WALLS).max() < 1e-9


def test_motion_within_a_scan_is_taken_out(rng):
    velocity, period = np.array([0.8, 0.0, 1.0]), 0.1
    ranges = ranges_on_the_way(POSE, velocity, period, rng, noise=0.0)
    scan = Scan(0, ranges, 0.0, 2 * np.pi / len(ranges), time_increment=period / len(ranges))
    off = [off_walls(transformed(POSE, points_of(scan, velocity=v).xy), WALLS)
           for v in (velocity, None)]
    assert off[0].max() < 0.01 < 0.1 < off[1].max()


def test_stray_rays_do_not_cut_a_wall_to_pieces(rng):
    ranges = ranges_at(np.array([1.5, 1.5, 0.0]), rng, rays=720)
    angles = 2 * np.pi * np.arange(720) / 720
    whole = points_of(Scan(0, ranges, 0.0, angles[1], 0.05, 30.0))
    through = rng.random(720) < 0.2
    spoilt = np.where(through, ranges + 1 + 5 * rng.random(720), ranges)
    points = points_of(Scan(0, spoilt, 0.0, angles[1], 0.05, 30.0))
    assert len(points.surface[0]) > 0.75 * 0.8 * len(whole.surface[0])
    # What went through is seen, and of no surface.
    far = np.hypot(*points.xy.T)
    assert np.isin(np.round(spoilt[through], 6), np.round(far, 6)).mean() > 0.9
