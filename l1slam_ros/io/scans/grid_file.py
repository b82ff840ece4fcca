# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Writing an occupancy grid for nav2's map server: a .pgm, and a .yaml of the same name.

The first row of the picture has the greatest y. With `negate: 0` white is free: 254
free, 205 unknown, 0 occupied.
"""

from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.scans.occupancy.grid import Grid
from l1slam_ros.io.files import replacing, require_file, write_lines
from l1slam_ros.io.ours import MARK, marked, refuse_others

_FREE = 254
_UNKNOWN = 205
_OCCUPIED = 0
# A shade is read as (255 - shade) / 255 occupied: 205 is .19608, which a limit of .25 calls free.
_FREE_BELOW = 0.196


def beside(path: Path) -> Path:
    """Return the name of the .yaml of a .pgm."""
    return path.with_suffix('.yaml')


def check_grid(path: Path, inputs: list[Path], force: bool = False) -> None:
    """Check, before any work is done, that a grid can be written."""
    if path.suffix.lower() != '.pgm':
        raise FileError(path, 'unknown suffix; expected .pgm')
    for file in (path, beside(path)):
        require_file(file)
    refuse_others((path, beside(path)), inputs, force)


def write_grid(path: Path, grid: Grid) -> None:
    """
    Write a grid: `path` with the suffix .pgm, and the .yaml beside it, each whole or not at all.

    Raises
    ------
    FileError : it cannot be written.

    """
    occupancy = grid.occupancy
    shade = np.full(occupancy.shape, _UNKNOWN, np.uint8)
    shade[occupancy > 0] = _OCCUPIED
    shade[occupancy == 0] = _FREE
    picture = np.ascontiguousarray(shade.T[::-1])
    height, width = picture.shape
    with replacing(path) as temporary, temporary.open('wb') as file:
        file.write(f'P5\n{MARK}\n{width} {height}\n255\n'.encode())
        file.write(picture.data)
    x, y = grid.origin.tolist()
    write_lines(beside(path), marked([
        f'image: {path.name}', 'mode: trinary', f'resolution: {grid.resolution}',
        f'origin: [{x:.6f}, {y:.6f}, 0.0]', 'negate: 0', 'occupied_thresh: 0.65',
        f'free_thresh: {_FREE_BELOW}']))
