# SPDX-License-Identifier: Apache-2.0
"""
The messages of a .db3 file, read off its pages, without the tree that orders them.

SQLite finds the leaves of a table from its root down. A table that outgrows a level gets its new
inner pages at the end of the file, and without these a file that is cut has no way to leaves that
are all there. Numbers as in "Database File Format", sqlite.org/fileformat2.html.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_FILE_HEADER = 100  # [bytes] on the first page, before what every page has
_TABLE_LEAF = 13
# Serial type of a number -> how many bytes it takes.
_INTEGERS = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}
_FIRST_BLOB = 12

# Row id, topic id, time [ns], data.
Row = tuple[int, int, int, bytes]


def is_cut(path: Path) -> bool:
    """Tell whether a database is shorter than its first page says."""
    with path.open('rb') as file:
        header = file.read(_FILE_HEADER)
    pages = int.from_bytes(header[28:32], 'big')
    return path.stat().st_size < pages * _page_size(header)


def leaf_rows(path: Path) -> Iterator[Row]:
    """Yield the rows of the table `messages` that are all there, in the order of the pages."""
    with path.open('rb') as file:
        header = file.read(_FILE_HEADER)
        size = _page_size(header)
        pages = _Pages(file, size, size - header[20])
        for number in range(1, path.stat().st_size // size + 1):
            yield from pages.rows(number)


def _page_size(header: bytes) -> int:
    size = int.from_bytes(header[16:18], 'big')
    return 65536 if size == 1 else size


class _Pages:
    """The pages of a database: of a size, of which `usable` bytes are used."""

    def __init__(self, file: BinaryIO, size: int, usable: int):
        self._file, self._size, self._usable = file, size, usable

    def rows(self, number: int) -> Iterator[Row]:
        """Yield the messages on one page, if it is a leaf of that table."""
        page = self._page(number)
        start = _FILE_HEADER if number == 1 else 0
        if page[start] != _TABLE_LEAF:
            return
        count = int.from_bytes(page[start + 3:start + 5], 'big')
        for k in range(start + 8, start + 8 + 2 * count, 2):
            row = self._row(page, int.from_bytes(page[k:k + 2], 'big'))
            if row is not None:
                yield row

    def _page(self, number: int) -> bytes:
        self._file.seek((number - 1) * self._size)
        return self._file.read(self._size)

    def _row(self, page: bytes, at: int) -> Row | None:
        """Return the row of a cell; None: it is of another table, or not all there."""
        length, at = _varint(page, at)
        row_id, at = _varint(page, at)
        record = self._payload(page, at, length)
        at, at_types = _varint(record, 0)
        types = []
        while at_types < at:
            kind, at_types = _varint(record, at_types)
            types.append(kind)
        # id (the row id stands for it), topic_id, timestamp, data
        if (len(types) != 4 or not all(kind in _INTEGERS for kind in types[:3])
                or types[3] < _FIRST_BLOB or types[3] % 2 or len(record) < length):
            return None
        values = []
        for kind in types[:3]:
            end = at + _INTEGERS[kind]
            values.append(1 if kind == 9 else int.from_bytes(record[at:end], 'big', signed=True))
            at = end
        return row_id, values[1], values[2], record[at:]

    def _payload(self, page: bytes, at: int, length: int) -> bytes:
        """Return the record of a cell, as far as it is there: its end may be on other pages."""
        local = self._local(length)
        parts, rest = [page[at:at + local]], length - local
        following = int.from_bytes(page[at + local:at + local + 4], 'big') if rest else 0
        while rest > 0 and following:
            page = self._page(following)
            parts.append(page[4:4 + min(rest, self._usable - 4)])
            rest -= self._usable - 4
            following = int.from_bytes(page[:4], 'big')
        return b''.join(parts)

    def _local(self, length: int) -> int:
        """Return how many bytes of a record are on the leaf itself."""
        most = self._usable - 35
        if length <= most:
            return length
        least = (self._usable - 12) * 32 // 255 - 23
        local = least + (length - least) % (self._usable - 4)
        return local if local <= most else least


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number of 1 to 9 bytes, high bits first, and where it ends."""
    value = 0
    for k in range(at, at + 8):
        value = value << 7 | data[k] & 127
        if data[k] < 128:
            return value, k + 1
    return value << 8 | data[at + 8], at + 9
