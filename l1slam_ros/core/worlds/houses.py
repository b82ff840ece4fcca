# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Houses along the streets that a robot drove, and what a laser on it sees of them.

In: true poses on the streets of `simulate`, a random generator. Out: walls, and the ranges of one
scan for each pose. No two houses are alike, so that places can be told apart.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.scans.points import Scan
from l1slam_ros.core.worlds.simulate import WorldOptions

# [m] From the middle of a street to the corners of houses, at least and at most.
_STREET = 0.7, 1.8
# How far a bay stands back, at least and at most, how wide it is, and how far it is from the
# corners at least, of the front's length.
_BAY = (0.1, 0.25)
_WIDTH = (0.15, 0.4)
_OFF = 0.2


@dataclass(frozen=True)
class Laser:
    """
    A laser that looks all round from where the robot is, in no time.

    rays : of a scan; sigma : of a range [m]; farthest : range [m]; resolution : of a range [m]
    """

    rays: int = 240
    sigma: float = 0.01
    farthest: float = 12.0
    resolution: float = 0.01


def houses(positions: Array, block: float, rng: np.random.Generator) -> Array:
    """
    Return the walls of houses in the squares of a street grid, and of a fence, x y to x y, (w, 4).

    positions : (n, 2) where a robot drove, on lines of whole multiples of `block` [m]. No front is
    quite along its street, and each has a bay, so that no two places look alike.
    """
    low, high = (np.rint(extreme / block).astype(int)
                 for extreme in (positions.min(axis=0), positions.max(axis=0)))
    # One more row around: the streets at the edge have two sides, too. Behind it is the fence.
    a, b = low - 1
    c, d = high + 1
    corners = np.array([(x, y) for x in range(a, c) for y in range(b, d)])
    fence = block * np.array([(a, b, c, b), (c, b, c, d), (c, d, a, d), (a, d, a, b)])
    return np.concatenate([fence, *(_house(corner * block, block, rng) for corner in corners)])


def scans_of_streets(truth: Array, stamps: Indices, options: WorldOptions,
                     rng: np.random.Generator) -> list[Scan]:
    """Return what a laser sees of the houses along streets, at poses (n, 3) and stamps [ns]."""
    return scans(truth, stamps, houses(truth[:, :2], options.block * options.step, rng), Laser(),
                 rng)


def scans(truth: Array, stamps: Indices, walls: Array, laser: Laser, rng: np.random.Generator
          ) -> list[Scan]:
    """
    Return what the laser sees at true poses.

    truth : (n, 3); stamps : (n,) of the poses [ns]; walls : (w, 4) [m]
    """
    increment = 2 * np.pi / laser.rays
    bearings = -np.pi + increment * np.arange(laser.rays)
    along = walls[:, 2:] - walls[:, :2]
    square = (along**2).sum(axis=1)
    found = []
    for stamp, pose in zip(stamps.tolist(), truth, strict=True):
        off = pose[:2] - walls[:, :2]
        part = np.clip((off * along).sum(axis=1) / square, 0.0, 1.0)
        near = np.hypot(*(off - part[:, None] * along).T) < laser.farthest
        exact = ranges(pose[:2], pose[2] + bearings, walls[near])
        noisy = exact + laser.sigma * rng.standard_normal(laser.rays)
        told = np.rint(noisy / laser.resolution) * laser.resolution
        found.append(Scan(stamp, np.where(exact < laser.farthest, told, np.inf), -np.pi,
                          increment, 0.05, laser.farthest))
    return found


def ranges(start: Array, angles: Array, walls: Array) -> Array:
    """Return the way from a start (2,) at each angle (r,) to the nearest wall [m]; none: inf."""
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    x, y = (walls[:, :2] - start).T
    u, v = (walls[:, 2:] - walls[:, :2]).T
    with np.errstate(divide='ignore', invalid='ignore'):
        cross = c * v - s * u
        way, along = (x * v - y * u) / cross, (x * s - y * c) / cross
        hit = (way > 0) & (along >= 0) & (along <= 1)
    return np.where(hit, way, np.inf).min(axis=1, initial=np.inf)


def _house(corner: Array, block: float, rng: np.random.Generator) -> Array:
    """Return the walls of the house in the square from a corner (2,) on, (w, 4)."""
    square = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    outline = corner + block * square + (1 - 2 * square) * rng.uniform(*_STREET, (4, 2))
    points: list[Array] = []
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        front = end - start
        back = rng.uniform(*_BAY) * np.array([-front[1], front[0]])
        wide = rng.uniform(*_WIDTH)
        first = start + rng.uniform(_OFF, 1 - _OFF - wide) * front
        last = first + wide * front
        points += [start, first, first + back, last + back, last]
    return np.column_stack((points, np.roll(points, -1, axis=0)))
