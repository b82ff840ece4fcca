# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Reading a .db3 file of rosbag2 row by row in the order of writing, as far as possible."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory

from l1slam_ros.io.bags.bounds import require_names, require_tables
from l1slam_ros.io.bags.damaged.walk import BagMessage, BrokenRecordError

_FILE_HEADER = 100  # [bytes] "Database File Format", sqlite.org/fileformat2.html
_TABLE_LEAF = b'\x0d'  # the first byte of a page with rows of a table

# Topic id, time [ns], data.
Row = tuple[int, int, bytes]


def walk_sqlite(path: Path, definitions: dict[str, str]) -> Iterator[BagMessage]:
    """Yield the messages of a .db3 in the order of writing; fill in its `definitions`."""
    with opened(path) as database:
        require_tables(database)
        with suppress(sqlite3.Error):  # older versions have no definitions
            definitions.update(database.execute(
                'SELECT topic_type, encoded_message_definition FROM message_definitions '
                "WHERE encoding = 'ros2msg'"))
        topics = {key: (name, msgtype) for key, name, msgtype in database.execute(
            'SELECT id, CAST(name AS TEXT), CAST(type AS TEXT) FROM topics '
            "WHERE serialization_format = 'cdr' AND name NOT NULL AND type NOT NULL")}
        require_names(name for names in topics.values() for name in names)
        cut = is_cut(path)
        # SQLite would read the lost part of a page as zeros.
        rows = leaf_rows(path) if cut else database.execute(
            'SELECT topic_id, CAST(timestamp AS INTEGER), CAST(data AS BLOB) FROM messages '
            'ORDER BY id')
        for key, time, data in rows:
            if key in topics and isinstance(time, int) and isinstance(data, bytes):
                yield BagMessage(*topics[key], time, data)
    if cut:
        raise BrokenRecordError(path.stat().st_size)


def is_cut(path: Path) -> bool:
    """Tell whether a database is shorter than its first page says."""
    with path.open('rb') as file:
        header = file.read(_FILE_HEADER)
    return path.stat().st_size < int.from_bytes(header[28:32], 'big') * _page_size(header)


def _page_size(header: bytes) -> int:
    size = int.from_bytes(header[16:18], 'big')
    return 65536 if size == 1 else size


def leaf_rows(path: Path) -> Iterator[Row]:
    """
    Yield the messages of a database that is cut, up to the first incomplete page.

    SQLite finds the leaves of a table from its root down. A table that outgrows a level gets its
    new inner pages at the end of the file, and without these a file that is cut has no way to
    leaves that are all there. So in a copy each leaf in turn is made the root.
    """
    with TemporaryDirectory() as folder:
        copy = Path(copyfile(path, Path(folder, path.name)))
        with copy.open('r+b') as file:
            header = file.read(_FILE_HEADER)
            size = _page_size(header)
            pages = path.stat().st_size // size
            leaves = []
            for number in range(2, pages + 1):  # the first page has the schema
                file.seek((number - 1) * size)
                if file.read(1) == _TABLE_LEAF:
                    leaves.append(number)
            # A header without a journal, and with this number of pages.
            file.seek(0)
            file.write(header[:18] + b'\1\1' + header[20:28] + pages.to_bytes(4, 'big'))
            file.truncate(pages * size)
        with (suppress(sqlite3.DatabaseError),
              closing(sqlite3.connect(copy, isolation_level=None)) as database):
            database.execute('PRAGMA journal_mode = OFF')
            for number in leaves:
                database.execute('PRAGMA writable_schema = ON')
                database.execute("UPDATE sqlite_master SET rootpage = ? WHERE name = 'messages'",
                                 (number,))
                database.execute('PRAGMA writable_schema = RESET')
                # Rows of other tables have no blob in this column.
                yield from database.execute(
                    "SELECT topic_id, timestamp, data FROM messages WHERE typeof(data) = 'blob'")


def has_journal(path: Path) -> bool:
    """Tell whether a database has a journal, as when its recorder was killed."""
    return _journal(path).exists()


def _journal(path: Path) -> Path:
    return path.with_name(f'{path.name}-wal')


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database; with a journal, a copy in which both are joined."""
    with TemporaryDirectory() as folder:
        options = 'immutable=1'
        if has_journal(path):
            options = 'mode=rw'
            copyfile(_journal(path), Path(folder, _journal(path).name))
            path = Path(copyfile(path, Path(folder, path.name)))
        address = f'{path.resolve().as_uri()}?{options}'
        with closing(sqlite3.connect(address, uri=True)) as database:
            # Without this SQLite refuses a file that is shorter than its first page says.
            database.execute('PRAGMA writable_schema = ON')
            yield database


def sqlite_metadata(path: Path) -> str:
    """Return the copy of metadata.yaml in a .db3, empty if there is none."""
    with opened(path) as database:
        require_tables(database)
        for (text,) in database.execute('SELECT metadata FROM metadata ORDER BY id DESC LIMIT 1'):
            return str(text)
    return ''
