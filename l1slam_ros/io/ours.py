# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Which files this program may replace: those that it wrote, recognised by a mark in them.

    text              the comment `MARK` as the first line; in a graph as the last line, because
                      GTSAM reads no edge behind a comment; in a saved map the lines of `remarks`
    report            the first line, `REPORT_MARK`
    .jrl, .cbor       the last text, `WROTE`
    .png, .svg, .pdf  the metadata field for the program; in a .pgm a comment
    bag directory     in each .mcap the field for the library that wrote it

A mark is needed because recordings and graphs of other programs look just the same. An empty file
has none: somebody made it for a purpose, or lost what was in it.
"""

import os
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

from l1slam_ros.core.errors import FileError
from l1slam_ros.io.files import other_kind, reported
from l1slam_ros.io.remarks import KEYWORD

PROGRAM = 'l1slam_ros'
WROTE = f'{PROGRAM} wrote this file and may replace it'
MARK = f'# {WROTE}'
REPORT_MARK = f'<!-- {WROTE} -->'
_FIRST_LINES = f'{MARK}\n'.encode(), f'{REPORT_MARK}\n'.encode()
# First bytes of a file -> the mark in it: PNG, PGM, PDF, SVG.
_PICTURES = {
    b'\x89PNG': f'tEXtSoftware\0{PROGRAM}'.encode(),
    b'P5\n': f'\n{MARK}\n'.encode(),
    b'%PDF': f'/Creator ({PROGRAM})'.encode(),
    b'<?xml': f'<dc:title>{PROGRAM}</dc:title>'.encode()}
# MCAP magic, and a header record of 22 bytes: the profile and the library, each with its length.
_BAG = (b'\x89MCAP0\r\n\x01' + (22).to_bytes(8, 'little') + b'\x04\0\0\0ros2\x0a\0\0\0'
        + PROGRAM.encode())
_METADATA = 'metadata.yaml'
# [bytes] at the begin and at the end of a file that are searched for a mark.
_ENOUGH = 2**16


def marked(lines: Iterable[str]) -> Iterator[str]:
    """Yield the lines of a text file with the mark before them."""
    return chain([MARK], lines)


def is_ours(path: str | os.PathLike[str]) -> bool:
    """
    Tell whether this program wrote a file or a bag directory.

    Raises
    ------
    FileError : it cannot be read.

    """
    with reported(path, 'read'):
        if os.path.isdir(path):
            files = sorted(Path(path).iterdir())
            return bool(files) and all(
                file.is_file() and (file.name == _METADATA or _ends(file)[0].startswith(_BAG))
                for file in files) and any(file.name != _METADATA for file in files)
        first, last = _ends(path)
    return (first.startswith(_FIRST_LINES)
            or KEYWORD.encode() in first.partition(b'\n')[0]
            or last.endswith(f'\n{MARK}\n'.encode())
            or last.rstrip(b'"}\n').endswith(WROTE.encode())
            or any(first.startswith(begin) and (mark in first or mark in last)
                   for begin, mark in _PICTURES.items()))


def _holds(folder: str | os.PathLike[str], path: str | os.PathLike[str]) -> bool:
    """Tell whether `path` is the folder or lies in it."""
    inside = Path(os.path.realpath(path))
    return Path(os.path.realpath(folder)) in (inside, *inside.parents)


def _ends(path: str | os.PathLike[str]) -> tuple[bytes, bytes]:
    with open(path, 'rb') as file:
        first = file.read(_ENOUGH)
        file.seek(max(file.seek(0, os.SEEK_END) - _ENOUGH, 0))
        return first, file.read(_ENOUGH)


def refuse_others(outputs: Iterable[str | os.PathLike[str]],
                  inputs: Iterable[str | os.PathLike[str]] = (), force: bool = False,
                  instead: str = 'another name, or --force') -> None:
    """
    Refuse outputs that would replace an input or a file of another program.

    Parameters
    ----------
    outputs : all files that will be written or removed
    inputs : all files that may be read; none may be an output, not even under another name
    force : whether to replace files of other programs
    instead : what was expected of a name that is taken

    Raises
    ------
    FileError : naming the first such output, or one that is neither a file nor a folder, or the
        folder in which this runs: that would move away with all that is in it.

    """
    read = [path for path in inputs if os.path.exists(path)]
    for output in outputs:
        if not os.path.lexists(output):
            continue
        if os.path.isdir(output) and _holds(output, os.getcwd()):
            raise FileError(output, 'is the folder in which this runs, or holds it; expected '
                            'another name')
        if (kind := other_kind(output)) and not os.path.isdir(output):
            raise FileError(output, f'cannot be written: it is {kind}')
        for path in read:
            if _is_part(output, path):
                raise FileError(output, f'is an input, {path}, and inputs are never replaced; '
                                'expected another name')
        if not force and os.path.exists(output) and not is_ours(output):
            raise FileError(output, f'was not written by {PROGRAM}, so it is not overwritten; '
                            f'expected {instead}')


def _is_part(output: str | os.PathLike[str], path: str | os.PathLike[str]) -> bool:
    """Tell whether an input is the output, lies in it, or is a directory that contains it."""
    if not os.path.exists(output):
        return False
    if os.path.isdir(output) and _holds(output, path):
        return True
    parts = [path, *(os.scandir(path) if os.path.isdir(path) else ())]
    return any(os.path.exists(part) and os.path.samefile(output, part) for part in parts)
