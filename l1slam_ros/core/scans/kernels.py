# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The compiled loops of the scan front end: normals, fields, matching, views and rays.

A pose is x, y [m] and heading [rad], (3,); it maps points of the moving scan into the frame of the
map. Points and normals are (n, 2) arrays. Grids are indexed [column of x, row of y].
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop

# Neighbourhoods of a point that are tried for a line, each half as wide as the one before.
_WINDOWS = 3


@loop('(f8[:, ::1], f8[::1], f8, f8, i4[:, ::1], f8[:, ::1])')
def nearest_points(points, origin, resolution, reach, nearest, best):
    """
    Find which point is nearest to the centre of each cell, and its squared distance [m^2].

    points : (n, 2) [m]; origin : (2,) corner of cell (0, 0) [m]; resolution, reach : [m];
    nearest, best : (a, b) for each cell, changed where a point is nearer than `best`, and within
    `reach`
    """
    columns, rows = nearest.shape
    radius = int(np.ceil(reach / resolution))
    for k in range(len(points)):
        column = int((points[k, 0] - origin[0]) / resolution)
        row = int((points[k, 1] - origin[1]) / resolution)
        for a in range(max(column - radius, 0), min(column + radius + 1, columns)):
            dx = origin[0] + (a + 0.5) * resolution - points[k, 0]
            for b in range(max(row - radius, 0), min(row + radius + 1, rows)):
                dy = origin[1] + (b + 0.5) * resolution - points[k, 1]
                square = dx * dx + dy * dy
                if square < best[a, b]:
                    best[a, b] = square
                    nearest[a, b] = k


@loop('(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], i4[:, ::1], f8[::1], f8, f8[::1], f8, f8,'
      ' i8, f8[::1])')
def normal_equations(points, normals, map_points, map_normals, nearest, origin, resolution, pose,
                     gate, scale, together, sums):
    """
    Add up the sums of one Gauss-Newton step of point-to-line matching.

    The residual of a point p with the map's nearest point m and its normal n is n'(R p + t - m);
    its Jacobian is taken in the axes of the moving pose. Weights are Cauchy's, 1 / (1 + (e/s)^2).

    gate : [m] farther points, and those whose normals differ by more than 45 degrees, do not
    match; scale : s [m]; together : so many points in a row are a group; sums : (17,) the upper
    triangle of H by rows (6), the same of the sum over groups of their part of g times itself (6),
    g (3), the number of matches, and the sum of weighted squared residuals [m^2]
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    group = np.zeros(3)
    for k in range(len(points)):
        if k % together == 0:
            _end_group(group, sums)
        px, py = points[k, 0], points[k, 1]
        x, y = c * px - s * py + pose[0], s * px + c * py + pose[1]
        column = int(np.floor((x - origin[0]) / resolution))
        row = int(np.floor((y - origin[1]) / resolution))
        if column < 0 or row < 0 or column >= nearest.shape[0] or row >= nearest.shape[1]:
            continue
        m = nearest[column, row]
        if m < 0:
            continue
        dx, dy = x - map_points[m, 0], y - map_points[m, 1]
        if dx * dx + dy * dy > gate * gate:
            continue
        nx, ny = map_normals[m, 0], map_normals[m, 1]
        # The normal, seen from the moving pose.
        ux, uy = c * nx + s * ny, c * ny - s * nx
        if ux * normals[k, 0] + uy * normals[k, 1] < 0.7071:
            continue
        e = nx * dx + ny * dy
        turn = uy * px - ux * py
        w = 1.0 / (1.0 + (e / scale) ** 2)
        sums[0] += w * ux * ux
        sums[1] += w * ux * uy
        sums[2] += w * ux * turn
        sums[3] += w * uy * uy
        sums[4] += w * uy * turn
        sums[5] += w * turn * turn
        group[0] += w * ux * e
        group[1] += w * uy * e
        group[2] += w * turn * e
        sums[15] += 1.0
        sums[16] += w * e * e
    _end_group(group, sums)


@compiled
def _end_group(group, sums):
    """Add a group's part of g, (3,), and its square to the sums; let another group begin."""
    at = 6
    for i in range(3):
        for j in range(i, 3):
            sums[at] += group[i] * group[j]
            at += 1
        sums[12 + i] += group[i]
    for i in range(3):
        group[i] = 0.0


@loop('(f8[:, ::1], f8[::1], f8, f8, f8, f8, f8[:, ::1], f8[:, ::1])')
def surface_along(points, centre, spacing, least_reach, widening, off, away, normals):
    """
    Thin out the points of a scan and find their normals; return how many are left.

    The points follow each other. Those that are at least `spacing` [m] from the last one kept come
    to the front of `points`, (n, 2), in place. To their neighbours on both sides that hang
    together within `least_reach` [m], or within `widening` of the range, a line is fitted; where
    they are further than `off` [m] from the line (RMS), as at a corner, to those within half as
    much, and half of that.

    centre : (2,) where the laser was; away : (n, 2) takes the points as seen from there; normals :
    (n, 2) of zeros, takes the normals, turned to the laser; a point that has no neighbour on one
    side, or no line, has none
    """
    # As a variable: for the number 0 itself `_window` would be compiled once more.
    count = np.int64(0)
    for k in range(len(points)):
        if count == 0 or not _near(points, k, count - 1, spacing):
            for axis in range(2):
                points[count, axis] = points[k, axis]
                away[count, axis] = points[k, axis] - centre[axis]
            count += 1
    for k in range(count):
        reach = max(least_reach, widening * np.sqrt(away[k, 0] ** 2 + away[k, 1] ** 2))
        linked = 0.5 * reach
        for _ in range(_WINDOWS):
            first, last = _window(away, count, k, reach, linked)
            if first == k or last == k:
                break
            angle, least = _line(away, first, last)
            if least <= off * off:
                nx, ny = -np.sin(angle), np.cos(angle)
                turn = -1.0 if nx * away[k, 0] + ny * away[k, 1] > 0 else 1.0
                normals[k, 0], normals[k, 1] = turn * nx, turn * ny
                break
            reach *= 0.5
    return count


@compiled
def _window(points, count, k, reach, linked):
    """Return the first and the last point around k within reach, none further than `linked`."""
    first = last = k
    while first > 0 and _near(points, first - 1, k, reach) and (
            _near(points, first - 1, first, linked)):
        first -= 1
    while last < count - 1 and _near(points, last + 1, k, reach) and (
            _near(points, last + 1, last, linked)):
        last += 1
    return first, last


@compiled
def _line(points, first, last):
    """Return the angle of the line through points, and their mean squared distance from it."""
    count = last - first + 1
    mx = my = 0.0
    for j in range(first, last + 1):
        mx += points[j, 0] / count
        my += points[j, 1] / count
    xx = xy = yy = 0.0
    for j in range(first, last + 1):
        dx, dy = points[j, 0] - mx, points[j, 1] - my
        xx += dx * dx / count
        xy += dx * dy / count
        yy += dy * dy / count
    half = 0.5 * (xx - yy)
    return 0.5 * np.arctan2(2 * xy, xx - yy), 0.5 * (xx + yy) - np.sqrt(half * half + xy * xy)


@compiled
def _near(points, a, b, reach):
    dx, dy = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]
    return dx * dx + dy * dy <= reach * reach


@loop('(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8)')
def contradictions(points, views, poses, off):
    """
    Return how many points the rays of some views agree with, and how many they pass through.

    points : (n, 2) [m]; views : (v, b) the range seen in each of b equal bearings, NaN where none;
    poses : (v, 3) where they were seen from, in the frame of the points; off : [m] by which a ray
    must pass a point to contradict it. A point that any view's ray passes through is contradicted,
    unless another view's ray ends there.
    """
    agree = pass_through = 0
    bins = views.shape[1]
    for k in range(len(points)):
        seen = through = False
        for v in range(len(poses)):
            dx, dy = points[k, 0] - poses[v, 0], points[k, 1] - poses[v, 1]
            distance = np.sqrt(dx * dx + dy * dy)
            bearing = (np.arctan2(dy, dx) - poses[v, 2]) / (2 * np.pi)
            at = int((bearing - np.floor(bearing)) * bins) % bins
            seen_range = views[v, at]
            if np.isnan(seen_range):
                continue
            tolerance = off + 0.03 * distance
            if abs(seen_range - distance) <= tolerance:
                seen = True
            elif seen_range > distance + tolerance:
                # The neighbours must pass, too: at an edge the ray may miss by its width.
                left, right = views[v, (at - 1) % bins], views[v, (at + 1) % bins]
                if left > distance + tolerance and right > distance + tolerance:
                    through = True
        if seen:
            agree += 1
        elif through:
            pass_through += 1
    return agree, pass_through


@loop('(f4[:, ::1], f8[::1], f8, f8[:, ::1], f8[:, ::1], b1[::1], f4, f4, f4)')
def cast_rays(log_odds, origin, resolution, starts, ends, hits, free, occupied, most):
    """
    Add rays to a grid of log odds, in place: each cell is told once by each scan's ray.

    starts, ends : (r, 2) [m]; hits : (r,) whether there is a surface at the end; free, occupied :
    what a ray adds to the cells it passes, and to the one it ends in; most : bound of either sign.

    Source: Amanatides and Woo, "A fast voxel traversal algorithm for ray tracing", 1987.
    """
    for k in range(len(starts)):
        x, y = (starts[k, 0] - origin[0]) / resolution, (starts[k, 1] - origin[1]) / resolution
        u, v = (ends[k, 0] - origin[0]) / resolution, (ends[k, 1] - origin[1]) / resolution
        dx, dy = u - x, v - y
        column = int(x)
        row = int(y)
        last_column = int(u)
        last_row = int(v)
        step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        next_x = ((column + (step_x > 0)) - x) / dx if dx != 0 else np.inf
        next_y = ((row + (step_y > 0)) - y) / dy if dy != 0 else np.inf
        across_x = abs(1 / dx) if dx != 0 else np.inf
        across_y = abs(1 / dy) if dy != 0 else np.inf
        for _ in range(abs(last_column - column) + abs(last_row - row)):
            if 0 <= column < log_odds.shape[0] and 0 <= row < log_odds.shape[1]:
                log_odds[column, row] = max(log_odds[column, row] - free, -most)
            if next_x < next_y:
                column += step_x
                next_x += across_x
            else:
                row += step_y
                next_y += across_y
        if hits[k] and 0 <= last_column < log_odds.shape[0] and (
                0 <= last_row < log_odds.shape[1]):
            log_odds[last_column, last_row] = min(
                log_odds[last_column, last_row] + occupied, most)
