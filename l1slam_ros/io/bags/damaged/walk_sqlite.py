# SPDX-License-Identifier: Apache-2.0
"""A .db3 file of rosbag2, row by row in the order of writing, as far as it can be read."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory

from l1slam_ros.io.bags.damaged.sqlite_pages import Row, is_cut, leaf_rows
from l1slam_ros.io.bags.damaged.walk import BagMessage, BrokenRecordError


def walk_sqlite(path: Path, definitions: dict[str, str]) -> Iterator[BagMessage]:
    """Yield the messages of a .db3 in the order of writing; put its definitions in."""
    with _opened(path) as database:
        with suppress(sqlite3.Error):  # older versions have no definitions
            definitions.update(database.execute(
                'SELECT topic_type, encoded_message_definition FROM message_definitions '
                "WHERE encoding = 'ros2msg'"))
        topics = {key: (name, msgtype) for key, name, msgtype in database.execute(
            "SELECT id, name, type FROM topics WHERE serialization_format = 'cdr'")}
        for _, key, time, data in _rows(database, path):
            if key in topics:
                yield BagMessage(*topics[key], time, data)


def _rows(database: sqlite3.Connection, path: Path) -> Iterator[Row]:
    """Yield the rows of the messages as the database has them; of a cut one, all that are left."""
    if not is_cut(path):
        yield from database.execute('SELECT id, topic_id, CAST(timestamp AS INTEGER), '
                                    'CAST(data AS BLOB) FROM messages ORDER BY id')
        return
    # SQLite would take the lost part of a page for zeros.
    with suppress(IndexError):  # damaged inside as well
        yield from leaf_rows(path)
    raise BrokenRecordError(path.stat().st_size)


def has_journal(path: Path) -> bool:
    """Tell whether a part of a database is still beside it, as where its recorder was killed."""
    return _journal(path).exists()


def _journal(path: Path) -> Path:
    return path.with_name(f'{path.name}-wal')


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Yield a database; one with a journal is put together in a copy."""
    with TemporaryDirectory() as folder:
        options = 'immutable=1'
        if has_journal(path):
            options = 'mode=rw'
            copyfile(_journal(path), Path(folder, _journal(path).name))
            path = Path(copyfile(path, Path(folder, path.name)))
        address = f'{path.resolve().as_uri()}?{options}'
        with closing(sqlite3.connect(address, uri=True)) as database:
            # Else SQLite refuses all of a file that is shorter than its first page says.
            database.execute('PRAGMA writable_schema = ON')
            yield database


def sqlite_metadata(path: Path) -> str:
    """Return the copy of metadata.yaml in a .db3, empty where there is none."""
    with _opened(path) as database:
        for (text,) in database.execute('SELECT metadata FROM metadata ORDER BY id DESC LIMIT 1'):
            return str(text)
    return ''
