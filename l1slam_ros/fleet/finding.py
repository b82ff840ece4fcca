# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The recordings of a folder, and where the result of each goes.

In: a folder. Out: one `Recording` for each file or rosbag2 directory in it that a graph can be
read from, in the order of their names.
"""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from l1slam_ros.core.errors import FileError
from l1slam_ros.io.bags.topics import BAG_SUFFIXES
from l1slam_ros.io.bounded import open_regular
from l1slam_ros.io.formats import GRAPH_READERS, LOG_SUFFIXES, files_of

_SUFFIXES = (*GRAPH_READERS, *BAG_SUFFIXES, *LOG_SUFFIXES)
# What makes a directory a bag: its metadata, and a file with messages or a word in the metadata.
_METADATA = 'metadata.yaml'
_WORD = b'rosbag2_bagfile_information'
_ENOUGH = 2**16


@dataclass(frozen=True)
class Recording:
    """
    One recording.

    name : its path below the folder, with `/`; path : its path.
    """

    name: str
    path: Path

    @property
    def map_name(self) -> str:
        """The name of its map: no two recordings share one, whatever their suffixes."""
        return f'{self.name}.g2o'

    def fingerprint(self) -> list[list[int]]:
        """Return size [bytes] and time of change [ns] of all that is read; none: unreadable."""
        files = [self.path, *(sorted(self.path.iterdir()) if self.path.is_dir() else ()),
                 *files_of(self.path)[1:]]
        found = []
        for file in files:
            try:
                status = file.stat()
            except OSError:
                continue
            found.append([status.st_size, status.st_mtime_ns])
        return found


def find(folder: Path, output: Path) -> list[Recording]:
    """
    Return the recordings of a folder; those in `output`, and hidden ones, are none.

    Links are followed, and each folder is visited once.

    Raises
    ------
    FileError : it is no folder, is a bag itself, is the output, or holds no recording.

    """
    if not folder.is_dir():
        raise FileError(folder, 'expected a folder of recordings')
    if _is_bag(folder, os.listdir(folder)):
        raise FileError(folder, 'is one recording; expected a folder of recordings, or '
                        '`l1slam solve`')
    visited = {_identity(output)} if output.exists() else set()
    if _identity(folder) in visited:
        raise FileError(output, 'is the folder of the recordings; expected another folder')
    paths = sorted(_walk(folder, visited), key=lambda path: os.fsencode(path))
    if not paths:
        raise FileError(folder, f'no recording in it; expected {", ".join(_SUFFIXES)} or a '
                        'rosbag2 directory')
    return [Recording(path.relative_to(folder).as_posix(), path) for path in paths]


def _walk(folder: Path, visited: set[tuple[int, int]]) -> Iterator[Path]:
    """Yield what may be a recording; also a folder that nobody may list, so that it is said."""
    waiting = [folder]
    while waiting:
        here = waiting.pop()
        try:
            identity = _identity(here)
            names = [name for name in os.listdir(here) if not name.startswith('.')]
        except OSError:
            yield here
            continue
        if identity in visited:
            continue
        visited.add(identity)
        if _is_bag(here, names):
            yield here
            continue
        for path in map(here.joinpath, names):
            if path.is_dir():
                waiting.append(path)
            elif path.suffix.lower() in _SUFFIXES:
                yield path


def _identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino


def _is_bag(folder: Path, names: Iterable[str]) -> bool:
    if _METADATA not in names:
        return False
    if any(name.lower().endswith(BAG_SUFFIXES) for name in names):
        return True
    try:
        with open_regular(folder / _METADATA) as file:
            return _WORD in file.read(_ENOUGH)
    except (OSError, FileError):
        return False
