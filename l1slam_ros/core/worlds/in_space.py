# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Drives in space whose truth is known: a building of several floors, a sphere, a torus.

In: how many poses, how far apart, a random generator. Out: the poses, x ahead and z away from
the ground, the first one the identity.
"""

from collections.abc import Callable

import numpy as np

from l1slam_ros.core.geometry import se3
from l1slam_ros.core.geometry.manifold import Array

# Of a building: the sides of a floor in blocks, how high a floor is in steps, and how many poses
# there are for each floor, in laps of it.
_LENGTH, _WIDTH = 4, 2
_HEIGHT = 3.0
_LAPS = 5
# Points of a curve for each pose of it, and the fewest poses that it has.
_FINE, _FEWEST = 30, 30


def building(n_poses: int, step: float, block: int, rng: np.random.Generator) -> Array:
    """
    Return a drive through a building, (n, 7): laps around its floors, over ramps between them.

    The last side of a lap is a ramp up or down, or level. step : [m]; block : steps.
    """
    sides = np.array([_LENGTH, _WIDTH, _LENGTH, _WIDTH]) * block
    lap = int(sides.sum())
    floors = max(2, n_poses // (lap * _LAPS))
    laps = -(-n_poses // lap)
    ahead = np.repeat([[1, 0], [0, 1], [-1, 0], [0, -1]], sides, axis=0)
    # A random walk, kept inside by folding it at the top and at the bottom.
    walk = np.concatenate(([0], np.cumsum(rng.integers(-1, 2, laps))))
    folded = walk % (2 * (floors - 1))
    floor = np.minimum(folded, 2 * (floors - 1) - folded)
    climbed = np.concatenate((np.zeros(lap - sides[3]), np.full(sides[3], 1 / sides[3])))
    rise = _HEIGHT * (np.diff(floor)[:, None] * climbed).ravel()
    steps = np.column_stack((np.tile(ahead, (laps, 1)), rise))
    positions = np.concatenate((np.zeros((1, 3)), np.cumsum(steps, axis=0))) * step
    return _drive(positions, np.tile([0.0, 0.0, 1.0], (len(positions), 1)), n_poses)


def sphere(n_poses: int, step: float, block: int, rng: np.random.Generator) -> Array:
    """Return a spiral from pole to pole of a sphere, its rounds a step apart in height, (n, 7)."""
    n = max(n_poses, _FEWEST)
    radius = step * np.sqrt(n) / np.pi
    height = np.linspace(-1, 1, _FINE * n)
    turn = 2 * np.pi * radius / step * height
    around = np.sqrt(1 - height**2)
    normal = np.column_stack((around * np.cos(turn), around * np.sin(turn), height))
    return _drive(*_evenly(radius * normal, normal, n), n_poses)


def torus(n_poses: int, step: float, block: int, rng: np.random.Generator) -> Array:
    """Return a drive round the tube of a torus and once along it, rounds a step apart, (n, 7)."""
    n = max(n_poses, _FEWEST)
    radius = step * np.sqrt(n / (8 * np.pi**2))
    along = np.linspace(0, 2 * np.pi, _FINE * n)
    # So many rounds that on the ring in the middle of the tube, twice as wide, they fill it.
    turn = 4 * np.pi * radius / step * along
    outward = np.column_stack((np.cos(along), np.sin(along), np.zeros_like(along)))
    normal = np.cos(turn)[:, None] * outward + np.sin(turn)[:, None] * [0.0, 0.0, 1.0]
    return _drive(*_evenly(radius * (2 * outward + normal), normal, n), n_poses)


DRIVES: dict[str, Callable[[int, float, int, np.random.Generator], Array]] = {
    'building': building, 'sphere': sphere, 'torus': torus}


def _evenly(points: Array, normal: Array, n_poses: int) -> tuple[Array, Array]:
    """Return n + 1 points (n + 1, 3) of a curve, equally far apart along it, and the normals."""
    passed = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    wanted = np.linspace(0, passed[-1], n_poses + 1)
    return (np.column_stack([np.interp(wanted, passed, column) for column in points.T]),
            np.column_stack([np.interp(wanted, passed, column) for column in normal.T]))


def _drive(positions: Array, up: Array, n_poses: int) -> Array:
    """Return the poses that look to the next position, up (n + 1, 3) away from the ground."""
    x = np.diff(positions, axis=0)[:n_poses]
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(up[:len(x)], x)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    R = np.stack((x, y, np.cross(x, y)), axis=2)
    poses = se3.from_rotation(R, positions[:len(x)])
    return se3.between(np.broadcast_to(poses[0], poses.shape), poses)
