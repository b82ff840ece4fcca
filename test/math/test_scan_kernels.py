# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The compiled loops of the scan front end, on each SIMD level, against the same in NumPy."""

from importlib import import_module

import numpy as np
import pytest
from rooms import scan_at
from worlds import between, compose

from l1slam_ros.core import native
from l1slam_ros.core.scans.field import Field
from l1slam_ros.core.scans.points import points_of

# [m] Cells of a look-up; where Cauchy's weight turns over; [m^2] of a residual; [rad] of normals.
RESOLUTION, SCALE, VARIANCE, OFF_NORMAL = 0.1, 0.09, 1.35e-3, 0.05
HERE = np.array([1.5, 1.5, 0.3])
UPPER = np.triu_indices(3)


@pytest.fixture(params=native.LEVELS)
def core(request):
    """Return the compiled core of a level, if this processor runs it."""
    portable = import_module('l1slam_ros.core.native._portable')
    if request.param == 'avx2' and not portable.has_avx2():
        pytest.skip('no AVX2')
    return import_module(f'l1slam_ros.core.native._{request.param}')


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def read_only(*arrays):
    for array in arrays:
        array.setflags(write=False)
    return arrays


def scene(rng):
    """Return the surface of a scan, a field, and the arguments of both for a kernel."""
    xy, normals = points_of(scan_at(compose(HERE, np.array([0.2, 0.1, 0.1])), rng)).surface
    field = Field.of(*points_of(scan_at(HERE, rng)).surface)
    return read_only(xy, normals, field.xy, field.normals, field.nearest, field.origin)


def turned(angle, vectors):
    c, s = np.cos(angle), np.sin(angle)
    return vectors @ np.array([[c, s], [-s, c]])


def sums_of(xy, normals, map_xy, map_normals, nearest, origin, pose, gate):
    """Return H, the sum over tens of points of their part of g times itself, g, and two more."""
    world = turned(pose[2], xy) + pose[:2]
    cell = np.floor((world - origin) / RESOLUTION).astype(int)
    inside = ((cell >= 0) & (cell < nearest.shape)).all(axis=1)
    m = np.where(inside, nearest[tuple(np.where(inside[:, None], cell, 0).T)], -1)
    off = world - map_xy[m]
    u = turned(-pose[2], map_normals[m])
    fits = (m >= 0) & (np.hypot(*off.T) <= gate) & ((u * normals).sum(axis=1) >= 0.7071)
    e = (map_normals[m] * off).sum(axis=1)
    w = fits / (1 + (e / SCALE) ** 2)
    J = np.column_stack((u, u[:, 1] * xy[:, 0] - u[:, 0] * xy[:, 1]))
    part = np.zeros((-(-len(xy) // 10), 3))
    np.add.at(part, np.arange(len(xy)) // 10, (w * e)[:, None] * J)
    return J.T @ (w[:, None] * J), part.T @ part, part.sum(axis=0), fits.sum(), (w * e**2).sum()


def held(H, g, units):
    """Return H and g without what noisy normals say, and the least eigenvalue of H in units."""
    values, axes = np.linalg.eigh(H * np.outer(units, units))
    noise = OFF_NORMAL**2 * (H[0, 0] + H[1, 1])
    part = np.maximum(1 - noise / np.maximum(values, 1e-12), 0)
    V = axes / units[:, None]
    return (V * (part * values)) @ V.T, V @ (part * (axes.T @ (units * g))), min(part * values)


def test_the_sums_of_a_step_are_those_of_its_matches(core, rng):
    given = scene(rng)
    pose, gate = np.array([0.15, 0.12, 0.07]), 0.2
    sums = core.scan_matching.normal_equations(*given, RESOLUTION, pose, gate, SCALE)
    H, scatter, g, count, square = sums_of(*given, pose, gate)
    assert count > 100
    expected = np.concatenate((H[UPPER], scatter[UPPER], g, [count, square]))
    np.testing.assert_allclose(sums, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize('certain', [0.0, 400.0])
def test_a_match_is_so_many_rounds_of_gauss_newton(core, rng, certain):
    given = scene(rng)
    prior, information = np.array([0.3, 0.0, 0.2]), certain * np.eye(3)
    units = np.array([1.0, 1.0, 0.5])
    pose, gate, steps = np.zeros(3), 0.6, []
    for _ in range(20):
        H, scatter, gradient, *rest = sums_of(*given, pose, gate)
        kept, g, least = held(H, gradient, units)
        off = between(prior, pose)
        J = np.eye(3)
        J[:2, :2] = turned(off[2], np.eye(2)).T
        steps.append(-np.linalg.solve(kept / VARIANCE + J.T @ information @ J + 1e-9 * np.eye(3),
                                      g / VARIANCE + J.T @ information @ off))
        pose = compose(pose, steps[-1])
        if gate <= 0.15 and abs(steps[-1]).max() < 1e-4:
            break
        gate = max(0.75 * gate, 0.15)
    assert 5 < len(steps) < 20
    found = core.scan_matching.match(*given, RESOLUTION, np.zeros(3), prior, information, units,
                                     0.6, SCALE, VARIANCE, OFF_NORMAL)
    np.testing.assert_allclose(found[0], pose, atol=1e-10)
    np.testing.assert_allclose(found[1], kept, rtol=1e-8, atol=1e-8)
    assert found[2] == pytest.approx(least, rel=1e-8)
    np.testing.assert_allclose(
        found[3], np.concatenate((H[UPPER], scatter[UPPER], gradient, rest)), rtol=1e-8, atol=1e-8)


def test_what_scatters_more_than_noise_is_less_certain(core, rng):
    A, B = rng.standard_normal((2, 3, 3))
    H, scatter = A @ A.T + np.eye(3), np.diag((9.0, 0.5, 3.0)) + B @ B.T
    found = core.scan_matching.information(H, scatter[UPPER], 0.7)
    L = np.linalg.cholesky(H)
    values, axes = np.linalg.eigh(np.linalg.inv(L) @ scatter @ np.linalg.inv(L.T) / 0.7)
    assert values[0] < 1 < values[2]
    root = L @ axes
    np.testing.assert_allclose(found, root / np.maximum(values, 1) @ root.T / 0.7, rtol=1e-6)
    assert not core.scan_matching.information(np.zeros((3, 3)), np.zeros(6), 0.7).any()


def test_each_cell_knows_its_nearest_point(core, rng):
    xy, origin = read_only(rng.uniform(-2, 3, (25, 2)), np.array([-1.53, -1.9]))
    nearest, best = np.full((40, 37), -1, np.int32), np.full((40, 37), 0.36)
    core.likelihood_field.nearest_points(xy, origin, RESOLUTION, 0.6, nearest, best)
    centres = origin + RESOLUTION * (np.moveaxis(np.indices((40, 37)), 0, 2) + 0.5)
    square = ((centres[:, :, None] - xy) ** 2).sum(axis=3)
    is_near = square.min(axis=2) < 0.36
    assert is_near.any() and not is_near.all()
    np.testing.assert_array_equal(nearest, np.where(is_near, square.argmin(axis=2), -1))
    np.testing.assert_allclose(best, np.minimum(square.min(axis=2), 0.36), rtol=1e-9)


@pytest.mark.parametrize('most', [24, 150])
def test_a_search_finds_the_best_shift_and_the_best_elsewhere(core, rng, most):
    """As by trying each shift and turn; twice the map, so that there is another."""
    likelihood = np.zeros((70, 60), np.uint8)
    likelihood[10:30, 20:40] = likelihood[40:60, 20:40] = rng.integers(0, 256, (20, 20))
    likelihood[45] = 0
    field = Field(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((70, 60), np.int32),
                  np.zeros((70, 60)), np.zeros(2))
    field.__dict__['likelihood'] = likelihood
    points = rng.uniform(0, 12, (40, 2))
    turns = np.array([0.0, 0.2, 0.4])
    start = np.array([18.0 - most // 3, 25.5 - most // 3])
    scores = np.zeros((3, most + 1, most + 1), int)
    level = np.pad(field.levels[0], most + 60)
    for t, angle in enumerate(turns):
        cells = np.floor(turned(angle, points) + start).astype(int) + most + 60
        for u, v in cells:
            scores[t] += level[u : u + most + 1, v : v + most + 1]
    least = 0.4 * scores.max()
    found = core.branch_and_bound.search(
        field.levels, field.blocks, points, np.column_stack((np.cos(turns), np.sin(turns))), start,
        most, least, 0.5, np.array([0.5, 6.0, 250.0]))
    best, *at, second = found
    assert best == scores.max() == scores[tuple(at)]
    t, u, v = np.indices(scores.shape)
    elsewhere = (abs(t - at[0]) > 0.5) | (abs(u - at[1]) > 6) | (abs(v - at[2]) > 6)
    assert second == scores[elsewhere].max() > 0.5 * best
    nothing = core.branch_and_bound.search(
        field.levels, field.blocks, points, np.ones((1, 2)), start, most, 1.1 * best, 0.5,
        np.array([0.5, 6.0, 250.0]))
    assert nothing == (0, -1, 0, 0, 0)


def test_rays_agree_with_what_they_end_at_and_contradict_what_they_pass(core, rng):
    points, views = rng.uniform(-5, 5, (400, 2)), rng.uniform(1, 6, (3, 90))
    views[rng.random(views.shape) < 0.2] = np.nan
    views[rng.random(views.shape) < 0.2] = np.inf
    poses = np.column_stack((rng.uniform(-1, 1, (3, 2)), rng.uniform(-3, 3, 3)))
    agree, through = np.zeros((2, 400), bool)
    for view, pose in zip(views, poses, strict=True):
        away = turned(-pose[2], points - pose[:2])
        at = np.floor(np.arctan2(*away.T[::-1]) / (2 * np.pi) * 90).astype(int) % 90
        distance = np.hypot(*away.T)
        past = [view[(at + k) % 90] - distance > 0.3 + 0.03 * distance for k in (-1, 0, 1)]
        agree |= abs(view[at] - distance) <= 0.3 + 0.03 * distance
        through |= np.all(past, axis=0)
    found = core.ray_casting.contradictions(*read_only(points, views, poses), 0.3)
    assert found == (agree.sum(), (through & ~agree).sum()) and min(found) > 10


def test_a_ray_takes_from_the_cells_it_passes_and_adds_to_its_last(core, rng):
    ends = rng.uniform(-1, 7, (300, 2))
    starts, hits = rng.uniform(0, 6, (300, 2)), rng.random(300) < 0.5
    expected = np.zeros((12, 10))
    for start, end, hit in zip(starts / 0.5, ends / 0.5, hits, strict=True):
        # Where it crosses the lines between cells; halfway between crossings it is in a cell.
        lines = [(np.arange(-5, 20) - a) / (b - a) for a, b in zip(start, end, strict=True)]
        t = np.concatenate((*lines, [0.0, 1.0]))
        t = np.sort(t[(t >= 0) & (t <= 1)])
        *passed, last = np.trunc(start + (t[:-1] + np.diff(t) / 2)[:, None] * (end - start))
        for cell, odds in ((*((c, -0.4) for c in passed), (last, 0.85 * hit))):
            if (cell >= 0).all() and (cell < expected.shape).all():
                at = tuple(cell.astype(int))
                expected[at] = np.clip(expected[at] + odds, -2, 2)
    grid = np.zeros(expected.shape, np.float32)
    core.ray_casting.cast_rays(grid, np.zeros(2), 0.5, starts, ends, hits, 0.4, 0.85, 2.0)
    inside = (ends >= 0).all(axis=1)
    assert inside.mean() > 0.7
    np.testing.assert_allclose(grid[1:, 1:], expected[1:, 1:], atol=1e-4)


def test_of_each_cell_and_side_the_first_point_is_kept(core, rng):
    points, normals = rng.uniform(-1, 1, (500, 2)), rng.standard_normal((500, 2))
    normals[rng.random(500) < 0.1] = 0
    counts = np.array([300, 0, 200])
    poses = np.array([(0, 0, 0), (9, 9, 1), (0.3, -0.2, 0.7)])
    rows = np.repeat(np.arange(3), counts)
    xy = np.array([turned(poses[r, 2], p) + poses[r, :2] for r, p in zip(rows, points,
                                                                         strict=True)])
    n = np.array([turned(poses[r, 2], p) for r, p in zip(rows, normals, strict=True)])
    side = np.round(np.arctan2(n[:, 1], n[:, 0]) / (np.pi / 2)).astype(int) % 4
    cell = np.column_stack((np.floor(xy / 0.2).astype(int), side))
    seen, kept = set(), []
    for k in np.flatnonzero(normals.any(axis=1)):
        if tuple(cell[k]) not in seen:
            seen.add(tuple(cell[k]))
            kept.append(k)
    found = core.voxel_grid.merge(*read_only(points, normals, counts, poses), 0.2)
    assert 100 < len(kept) < 400
    np.testing.assert_allclose(found[0], xy[kept], atol=1e-12)
    np.testing.assert_allclose(found[1], n[kept], atol=1e-12)


def normal_of(away, k, reach, off):
    """Return the normal of a point by principal axes; zero where it has none."""
    linked = 0.5 * reach
    for window in (reach, reach / 2, reach / 4):
        first = last = k
        while first > 0 and np.hypot(*(away[first - 1] - away[k])) <= window and (
                np.hypot(*(away[first - 1] - away[first])) <= linked):
            first -= 1
        while last < len(away) - 1 and np.hypot(*(away[last + 1] - away[k])) <= window and (
                np.hypot(*(away[last + 1] - away[last])) <= linked):
            last += 1
        if k in (first, last):
            break
        near = away[first : last + 1]
        values, axes = np.linalg.eigh(np.cov(near.T, bias=True))
        if values[0] <= off**2:
            return axes[:, 0] * (-1 if axes[:, 0] @ away[k] > 0 else 1)
    return np.zeros(2)


def test_points_are_thinned_out_and_have_the_normals_of_their_lines(core, rng):
    scan = scan_at(HERE, rng)
    ranges, increment = np.array(scan.ranges), scan.angle_increment
    ranges[::17] += rng.uniform(1, 3, len(ranges[::17]))
    ranges[[5, 60, 61]], ranges[100:110] = (np.nan, np.inf, 0.01), np.inf
    angles = increment * np.arange(len(ranges))
    ends = np.where(np.isfinite(ranges), ranges, 0)[:, None] * np.column_stack(
        (np.cos(angles), np.sin(angles)))
    bins = 3 * len(ranges) // 2
    bearings = np.floor(angles / (2 * np.pi) * bins + 1e-9).astype(int)
    centre = np.array([0.1, 0.0])
    xy, normals, view = core.scan_points.points_of(
        *read_only(ends, ranges, angles, bearings), bins, 0.05, 30.0, increment, centre)

    hit = (ranges > 0.05) & (ranges < 30)
    reach = np.where(hit, ranges, 0)
    second = abs(reach[:-2] - 2 * reach[1:-1] + reach[2:])[
        hit[:-2] & hit[1:-1] & hit[2:] & (reach[1:-1] * increment < 0.05)]
    noise = min(np.sort(second)[len(second) // 4] / (0.3186 * np.sqrt(6)), 0.08) if (
        len(second) >= 20) else 0.0
    least, off = max(0.25, 8 * noise), max(0.03, 1.5 * noise)
    reach = np.maximum(least, 10 * increment * ranges[hit])
    way = np.hypot(*np.diff(ends[hit], axis=0).T)
    lone = np.append(True, way > reach[1:] / 2) & np.append(way > reach[:-1] / 2, True)
    kept = []
    for point in ends[hit][~lone]:
        if not kept or np.hypot(*(point - kept[-1])) > 0.05:
            kept.append(point)
    away = np.array(kept) - centre
    expected = [normal_of(away, k, max(least, 10 * increment * np.hypot(*a)), off)
                for k, a in enumerate(away)]
    assert lone.sum() > 5
    np.testing.assert_allclose(xy, np.concatenate((kept, ends[hit][lone])), atol=1e-12)
    assert np.abs(normals[: len(kept)]).any(axis=1).mean() > 0.7
    assert not normals[len(kept):].any()
    np.testing.assert_allclose(normals[: len(kept)], expected, atol=1e-7)

    seen = np.full(bins, np.nan)
    looked = ranges > 0.05
    for at, r in zip(bearings[looked], ranges[looked], strict=True):
        seen[at] = np.fmin(seen[at], r)
    steps = np.arange(1, int(bins / len(ranges) + 1e-6) + 1)
    for at in np.flatnonzero(np.isnan(seen)):
        sides = [next((r for r in seen[(at + sign * steps) % bins] if not np.isnan(r)), np.nan)
                 for sign in (-1, 1)]
        np.testing.assert_equal(view[at], np.minimum(*sides))
    np.testing.assert_array_equal(view[~np.isnan(seen)], seen[~np.isnan(seen)])


def test_what_does_not_fit_together_is_refused(core, rng):
    given = scene(rng)
    matching, pose = core.scan_matching, np.zeros(3)
    for wrong, name in (((given[0][1:], *given[1:]), 'normals'),
                        ((*given[:2], given[2][1:], *given[3:]), 'map_normals'),
                        ((*given[:5], given[5][:1]), 'origin'),
                        ((given[0].T, *given[1:]), 'points'),
                        ((*given[:4], given[4].astype(int), given[5]), 'nearest')):
        with pytest.raises(TypeError, match=f'normal_equations: .*{name}'):
            matching.normal_equations(*wrong, RESOLUTION, pose, 0.2, SCALE)
    with pytest.raises(TypeError, match='match: .*units'):
        matching.match(*given, RESOLUTION, pose, pose, np.eye(3), pose[:2], 0.6, SCALE, VARIANCE,
                       OFF_NORMAL)
    ends = np.zeros((4, 2))
    with pytest.raises(TypeError, match='points_of: .*bearings'):
        core.scan_points.points_of(ends, np.ones(4), np.ones(4), np.full(4, 720), 720, 0.0, 9.0,
                                   0.1, np.zeros(2))
    with pytest.raises(TypeError, match='cast_rays: .*finite'):
        core.ray_casting.cast_rays(np.zeros((3, 3), np.float32), np.zeros(2), 0.1, ends,
                                   np.full((4, 2), np.nan), np.ones(4, bool), 0.4, 0.8, 1.0)
    with pytest.raises(TypeError, match='contradictions: .*poses'):
        core.ray_casting.contradictions(ends, np.ones((2, 9)), np.zeros((1, 3)), 0.3)
    with pytest.raises(TypeError, match='merge: .*counts'):
        core.voxel_grid.merge(ends, ends, np.array([3, 2]), np.zeros((2, 3)), 0.1)
    with pytest.raises(TypeError, match='nearest_points: .*best'):
        core.likelihood_field.nearest_points(
            ends, np.zeros(2), 0.1, 0.6, np.zeros((3, 3), np.int32), np.zeros((3, 4)))
    with pytest.raises(TypeError, match='search: .*most'):
        core.branch_and_bound.search(
            np.zeros((4, 9, 9), np.uint8), np.zeros((8, 8, 2, 66), np.uint8), ends,
            np.ones((1, 2)), np.zeros(2), 256, 1.0, 0.5, np.ones(3))
