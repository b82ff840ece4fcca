# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A few rooms, what a laser sees in them, and a robot that drives through them with bad wheels."""

import numpy as np
from worlds import between, compose

RAYS = 360
# x0, y0, x1, y1 of walls [m]: a ring of corridors with doors and pillars, none like another.
WALLS = np.array([
    (0, 0, 14, 0), (14, 0, 14, 9), (14, 9, 0, 9), (0, 9, 0, 0),
    (3, 3, 6, 3), (7, 3, 11, 3), (11, 3, 11, 6), (11, 6, 4.5, 6), (3, 6, 3, 3),
    (5, 0, 5, .8), (5, .8, 5.4, .8), (5.4, .8, 5.4, 0), (9, 9, 8.5, 8.2), (8.5, 8.2, 8, 9),
    (14, 5, 13.2, 5), (13.2, 5, 13.2, 5.5), (13.2, 5.5, 14, 5.5), (0, 6.5, .9, 7.2),
    (.9, 7.2, 0, 7.6), (2, 9, 2, 8.3), (12.5, 0, 13.4, 0.6), (13.4, .6, 14, .6),
    (6, 3, 6, 4), (7, 3, 7, 4), (6, 4, 7, 4), (10, 0, 10.3, .5), (10.3, .5, 10.6, 0)])


def ranges_from(pose, rays=RAYS, walls=WALLS):
    """Return how far a laser sees at a pose (3,), rays from -pi on, (rays,) [m]."""
    angles = pose[2] - np.pi + 2 * np.pi / rays * np.arange(rays)
    d = np.stack((np.cos(angles), np.sin(angles)), axis=1)[:, None]
    a, b = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]
    cross = d[..., 0] * b[:, 1] - d[..., 1] * b[:, 0]
    with np.errstate(divide='ignore', invalid='ignore'):
        along = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / cross
        at = (a[:, 0] * d[..., 1] - a[:, 1] * d[..., 0]) / cross
    hit = (along > 0) & (at >= 0) & (at <= 1)
    return np.where(hit, along, np.inf).min(axis=1)


def laps(count, step=0.1):
    """Return poses (n, 3) of a robot that goes around, and turns about the corners."""
    corners = np.array([(1.6, 1.6), (12.4, 1.6), (12.4, 7.4), (1.6, 7.4)])
    poses, turn = [], np.pi / 2 / 12
    for k in range(4 * count):
        a, b = corners[k % 4], corners[(k + 1) % 4]
        heading, length = k * np.pi / 2, np.hypot(*(b - a))
        way = np.arange(0, length, step)[:, None] / length
        poses += [(*p, heading) for p in a + way * (b - a)]
        poses += [(*b, heading + j * turn) for j in range(12)]
    return np.array(poses)


def by_wheels(poses, rng, way=0.03, turn=0.02):
    """Return the poses as wheels have them: they stretch ways, and turn a little all the time."""
    motion = between(poses[:-1], poses[1:])
    length = np.hypot(motion[:, 0], motion[:, 1])
    motion[:, 0] *= 1 + way
    motion[:, 2] = motion[:, 2] * (1 + turn) + turn * length
    motion += rng.normal(0, 1, motion.shape) * (0.003, 0.001, 0.002)
    found = [np.zeros(3)]
    for one in motion:
        found.append(compose(found[-1], one))
    return np.array(found)
