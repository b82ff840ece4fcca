# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Limits on text and YAML from others: their size is checked before all of them is read."""

import bz2
import gzip
import os
import re
import stat
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from l1slam_ros.core.errors import FileError

if TYPE_CHECKING:
    from yaml import Node

# [bytes] A text file as a whole (a graph of a million poses has .4e9), one line of it, and a
# document of YAML.
_LARGEST = 2**31
_LONGEST_LINE = 2**16
_LONGEST_YAML = 2**22
# Ratio of compression: graphs reach 8, and even one of zeros hardly 30.
_MOST_PACKED = 100
# Brackets and lists within each other: PyYAML takes the square of it.
_DEEPEST = 64
_BLOCK = 2**20
_NEWLINE = ord('\n')
_BRACKET = re.compile(r'[][{}]')
_LISTS = re.compile(r'^ *(?:[-?] )+', re.MULTILINE)
# Suffix of a packed file -> what unpacks it.
_UNPACK: dict[str, Callable[[BinaryIO], Any]] = {'.gz': gzip.open, '.bz2': bz2.open}


def unpacked_name(path: str | os.PathLike[str]) -> str:
    """Return the name of a file in lower case, that of its content if the file is packed."""
    name = Path(path).name.lower()
    return name.removesuffix(next(filter(name.endswith, _UNPACK), ''))


def open_regular(path: Path) -> BinaryIO:
    """
    Open a regular file; reading a FIFO or a device may never end.

    Raises
    ------
    FileError : it is another kind of file.
    OSError : it cannot be opened.

    """
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):  # the error of a directory says what it is
        raise FileError(path, 'cannot be read: it is not a regular file')
    return path.open('rb')


def read_bytes(path: Path, most: int) -> bytes:
    """
    Return the content of a file, unpacked if it is packed.

    Raises
    ------
    FileError : it is no regular file, cannot be unpacked, or has more than `most` bytes.
    OSError : it cannot be read.

    """
    return b''.join(_blocks(path, most))


def read_text(path: Path) -> bytes:
    """
    Return the content of a text file, unpacked if it is packed.

    Raises
    ------
    FileError : as `read_bytes` does; it is larger, or one of its lines is longer, than that of any
        graph.
    OSError : it cannot be read.

    """
    blocks = list[bytes]()
    begun = 0
    number = 1
    for block in _blocks(path, _LARGEST, 'a text file of '):
        ends = np.flatnonzero(np.frombuffer(block, np.uint8) == _NEWLINE)
        lengths = np.diff(ends, prepend=-1, append=len(block)) - 1
        lengths[0] += begun  # a line may begin in one block and end in another
        if lengths.max() > _LONGEST_LINE:
            number += int(np.argmax(lengths > _LONGEST_LINE))
            raise FileError(path, f'a line of more than {_LONGEST_LINE:,} bytes; expected a '
                            'text file', number)
        begun = int(lengths[-1])
        number += len(ends)
        blocks.append(block)
    return b''.join(blocks)


def _blocks(path: Path, most: int, expected: str = '') -> Iterator[bytes]:
    """Yield the content of a file in blocks; expected : its kind, for the error on its size."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise FileError(path, f'{size:,} bytes; expected {expected}at most {most:,}')
        unpack = _UNPACK.get(path.suffix.lower())
        if not unpack:
            while block := file.read(_BLOCK):
                yield block
            return
        length = 0
        try:
            unpacked = unpack(file)
            while block := unpacked.read(_BLOCK):
                length += len(block)
                check_unpacked(path, size, length, most)
                yield block
        except (EOFError, OSError, zlib.error) as error:
            raise FileError(path, f'cannot be unpacked: {error}') from error


def check_unpacked(path: Path, size: int, unpacked: int, most: int = _LARGEST) -> None:
    """
    Refuse a packed file that unpacks to more than any graph or log does.

    size, unpacked, most : its bytes, those that were unpacked by now, and how many these may be

    Raises
    ------
    FileError : naming the file.

    """
    if unpacked > min(most, max(_MOST_PACKED * size, _LONGEST_YAML)):
        raise FileError(path, f'{size:,} bytes that unpack to more than a graph; expected at most '
                        f'{_MOST_PACKED} times as many')


def read_yaml(text: str) -> Any:
    """
    Return what a document of YAML says.

    Raises
    ------
    ValueError : it is too long, with its aliases expanded, too, or nested too deeply, to be what
        anybody writes.
    yaml.YAMLError : it is no YAML.

    """
    import yaml

    depth = deepest = 0
    for found in _BRACKET.finditer(text) if len(text) <= _LONGEST_YAML else ():
        depth += 1 if found[0] in '[{' else -1
        deepest = max(deepest, depth)
    lists = max((len(found[0].split()) for found in _LISTS.finditer(text)), default=0)
    if len(text) > _LONGEST_YAML or max(deepest, lists) > _DEEPEST:
        raise ValueError(f'YAML of {len(text):,} characters, {max(deepest, lists)} deep; expected '
                         f'at most {_LONGEST_YAML:,}, and {_DEEPEST} deep')
    loader = yaml.SafeLoader(text)
    try:
        node = loader.get_single_node()
        if node is not None and _expanded(node, {}) > _LONGEST_YAML:
            raise ValueError(f'YAML whose aliases expand to more than {_LONGEST_YAML:,} '
                             'characters; expected at most so many')
        return None if node is None else loader.construct_document(node)
    except RecursionError as error:
        raise ValueError(f'YAML that is nested too deeply; expected {_DEEPEST} deep') from error
    finally:
        loader.dispose()


def _expanded(node: 'Node', known: dict[int, float]) -> float:
    """Return how many characters a node has with its aliases expanded; one in itself: infinite."""
    if isinstance(node.value, str):
        return len(node.value) + 1
    size = known.get(id(node))
    if size is None:
        known[id(node)] = float('inf')
        parts = [part for entry in node.value
                 for part in (entry if isinstance(entry, tuple) else (entry,))]
        known[id(node)] = size = 1 + sum(_expanded(part, known) for part in parts)
    return size
