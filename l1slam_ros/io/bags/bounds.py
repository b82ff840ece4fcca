# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Limits on a bag: the memory that its compressed parts unpack to, and the time its queries take.

A few kilobytes can unpack to gigabytes, a table of a database can be a query without an end, and
nested YAML costs a parser the square of its length. So each is bounded before it is read.
"""

import bz2
import sqlite3
from collections.abc import Callable, Iterable
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]  # comes with the bag libraries, as does zstandard
import yaml
import zstandard
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import storage_mcap

from l1slam_ros.core.errors import L1SlamError
from l1slam_ros.io.bounded import read_yaml
from l1slam_ros.io.files import quoted

_MIB = 2**20
# [bytes] of a chunk or a message: chunks have some megabytes, messages of cameras tens of them.
MOST_AT_ONCE = 256 * _MIB
# Letters of the name of a topic or a type: ROS 2 allows 255.
_LONGEST_NAME = 1024
# The tables of rosbag2 that are read, and how long the statement that made one may be.
_TABLES = ('schema', 'topics', 'messages', 'message_definitions', 'metadata')
_LONGEST_STATEMENT = 4096


class BombError(L1SlamError):
    """A file asks for more memory or time than any recording needs."""


def require_small(size: int, what: str) -> None:
    """Refuse a piece of a bag of this size [bytes] if it is larger than recorders make."""
    if size > MOST_AT_ONCE:
        raise BombError(f'{what} of {size / _MIB:,.0f} MiB; expected at most '
                        f'{MOST_AT_ONCE // _MIB} MiB')


def unpacked(compression: str, data: bytes) -> bytes:
    """
    Return unpacked data, of cut data as far as it goes; compression : zstd, lz4 or bz2.

    Raises
    ------
    BombError : it is more than recorders pack into one piece.

    """
    content: bytes = _UNPACK[compression](data, MOST_AT_ONCE + 1)
    if len(content) > MOST_AT_ONCE:
        raise BombError(f'{len(data):,} bytes of {compression} unpack to more than a chunk or a '
                        f'message may have; expected at most {MOST_AT_ONCE // _MIB} MiB')
    return content


def _zstd(data: bytes, most: int) -> bytes:
    with zstandard.ZstdDecompressor().stream_reader(BytesIO(data), read_across_frames=True) as (
            stream):
        return stream.read(most)


def _lz4(data: bytes, most: int) -> bytes:
    content = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most)
    return bytes(content)


def _bz2(data: bytes, most: int) -> bytes:
    return bz2.BZ2Decompressor().decompress(data, max_length=most)


_UNPACK: dict[str, Callable[[bytes, int], Any]] = {'zstd': _zstd, 'lz4': _lz4, 'bz2': _bz2}


def require_names(names: Iterable[str]) -> None:
    """Refuse names of topics and types that are longer than any."""
    for name in names:
        if len(name) > _LONGEST_NAME:
            raise BombError(f'the name {quoted(name)} of {len(name):,} characters; expected at '
                            f'most {_LONGEST_NAME:,}')


def require_shallow(metadata: Path) -> None:
    """Refuse a metadata.yaml that would take minutes to parse; it may be missing."""
    if not metadata.is_file():
        return
    require_small(metadata.stat().st_size, metadata.name)
    try:
        with suppress(yaml.YAMLError, UnicodeDecodeError):
            read_yaml(metadata.read_text(encoding='utf-8'))
    except ValueError as error:
        raise BombError(f'{metadata.name}: {error}') from error


def require_tables(database: sqlite3.Connection) -> None:
    """
    Refuse a database whose tables are not plain tables, or hold too large messages.

    Raises
    ------
    BombError : a view, a virtual table or a computed column in the place of a table of rosbag2, or
        a message that is larger than any.

    """
    for name, kind, statement in database.execute(
            'SELECT name, type, sql FROM sqlite_master WHERE lower(name) IN '
            f'({", ".join("?" * len(_TABLES))})', _TABLES).fetchall():
        if (kind != 'table' or not str(statement).upper().startswith('CREATE TABLE')
                or len(str(statement)) > _LONGEST_STATEMENT or _is_computed(database, name)):
            raise BombError(f'{name} is {"a view" if kind == "view" else "computed"}; expected a '
                            'table of rosbag2')
    pages, size = (database.execute(f'PRAGMA {name}').fetchone()[0]
                   for name in ('page_count', 'page_size'))
    if pages * size > MOST_AT_ONCE:
        with suppress(sqlite3.DatabaseError):  # one that is cut is read page by page
            # This reads only the length of the blobs.
            largest, = database.execute('SELECT max(length(data)) FROM messages').fetchone()
            require_small(int(largest or 0), 'a message')


def _is_computed(database: sqlite3.Connection, table: str) -> bool:
    """Tell whether a table has a column that SQLite computes when it is read."""
    columns = database.execute('SELECT hidden FROM pragma_table_xinfo(?)', (table,))
    return any(hidden for hidden, in columns)


def _bound_library() -> None:
    """Make the bag library unpack within these bounds; it has none of its own."""
    for name in ('zstd', 'lz4'):
        storage_mcap.DECOMPRESSORS[name] = lambda data, _, name=name: unpacked(name, data)
    for name in ('bz2', 'lz4'):
        rosbag1.decompressors[name] = lambda data, name=name: unpacked(name, data)


_bound_library()
