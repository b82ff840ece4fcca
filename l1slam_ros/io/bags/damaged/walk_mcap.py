# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Reading an MCAP file record by record from its start, as far as possible, without an index.

A file is a sequence of records: opcode, length, content. A chunk contains such a sequence, usually
compressed. If a chunk is cut by the end of the file or damaged inside, the part before that is
decompressed and used.
"""

import struct
import zlib
from collections.abc import Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from mcap import data_stream, records
from mcap.reader import make_reader

from l1slam_ros.io.bags.bounds import BombError, require_names, require_small, unpacked
from l1slam_ros.io.bags.damaged.walk import BagMessage, BrokenRecordError

MAGIC = b'\x89MCAP0\r\n'
_SCHEMA = 3
_CHANNEL = 4
_MESSAGE = 5
_CHUNK = 6
_METADATA = 12
_DATA_END = 15
# Opcodes between are reserved for later versions of the format; a power cut leaves zeros.
_LAST_OPCODE, _FIRST_FOREIGN_OPCODE = 15, 128
_HEAD = struct.Struct('<BQ')
_MESSAGE_HEAD = struct.Struct('<HIQQ')
_FOOTER = struct.Struct('<BQQQI')
_CHECKSUM = 4  # [bytes] at the end of the footer


def walk_mcap(path: Path, definitions: dict[str, str]) -> Iterator[BagMessage]:
    """
    Yield the messages of a file in the order in which they were written.

    Parameters
    ----------
    path : an MCAP file
    definitions : message type -> its `ros2msg` definition; those of the file are added

    Raises
    ------
    BrokenRecordError : after the last message before the first damage.

    """
    size = path.stat().st_size
    channels = _Channels(definitions)
    with path.open('rb') as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise BrokenRecordError(0)
        for start, opcode, length in _records(file, size):
            if opcode == _DATA_END:
                break
            if opcode not in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK):
                continue
            require_small(length, 'a record')
            content = file.read(length)
            # The last record of a complete file is of another kind, so this one is cut.
            position = size if file.tell() == size else start
            read = channels.chunk if opcode == _CHUNK else partial(channels.record, opcode)
            try:
                yield from read(content)
            except BombError:
                raise
            except Exception as error:  # damaged content makes readers of records raise anything
                raise BrokenRecordError(position) from error
        file.seek(-min(size, len(MAGIC)), 2)
        if file.read() != MAGIC:
            raise BrokenRecordError(size)


def mcap_metadata(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield name and entries of each metadata record of a file, up to the first damage."""
    with path.open('rb') as file:
        file.seek(len(MAGIC))
        for _, opcode, length in _records(file, path.stat().st_size):
            if opcode == _METADATA:
                record = _parsed('Metadata', file.read(length))
                yield record.name, record.metadata


def is_indexed(path: Path) -> bool:
    """Tell whether a file has an undamaged index of all its messages."""
    with path.open('rb') as file:
        summary = make_reader(file).get_summary()
        if summary is None or summary.statistics is None:
            return False
        end = file.seek(-_FOOTER.size - len(MAGIC), 2)
        _, _, start, _, checksum = _FOOTER.unpack(file.read(_FOOTER.size))
        file.seek(start)
        covered = file.read(end + _FOOTER.size - _CHECKSUM - start)
    if checksum and zlib.crc32(covered) != checksum:
        return False
    chunks = summary.chunk_indexes
    for chunk in chunks:
        require_small(chunk.uncompressed_size, 'a chunk')
    return (all(chunk.message_index_offsets for chunk in chunks)
            and bool(chunks or not summary.statistics.message_count))


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[int, int, int]]:
    """Yield start, opcode and length of each record; the stream is then at its content."""
    start = stream.tell()
    while start < size:
        stream.seek(start)
        head = stream.read(_HEAD.size)
        if len(head) < _HEAD.size:
            raise BrokenRecordError(size)
        opcode, length = _HEAD.unpack(head)
        if not (0 < opcode <= _LAST_OPCODE or opcode >= _FIRST_FOREIGN_OPCODE):
            raise BrokenRecordError(start)
        there = size - start - _HEAD.size
        if length <= there or opcode == _CHUNK:
            yield start, opcode, min(length, there)
        if length > there:
            raise BrokenRecordError(size)
        start += _HEAD.size + length


def _parsed(kind: str, content: bytes) -> Any:
    """Parse a record with the mcap library; kind : its class there."""
    return getattr(records, kind).read(data_stream.ReadDataStream(BytesIO(content)))


class _Channels:
    """Turns records into messages, by the schemas and channels before them."""

    def __init__(self, definitions: dict[str, str]):
        self._definitions = definitions
        self._schemas: dict[int, str] = {0: ''}
        # None: a channel whose messages are not of ROS 2.
        self._topics: dict[int, tuple[str, str] | None] = {}

    def record(self, opcode: int, content: bytes) -> Iterator[BagMessage]:
        """Yield the message in a record; remember the content of schemas and channels."""
        if opcode == _MESSAGE:
            channel_id, _, time, _ = _MESSAGE_HEAD.unpack_from(content)
            topic = self._topics[channel_id]
            if topic is not None:
                yield BagMessage(*topic, time, content[_MESSAGE_HEAD.size:])
        elif opcode == _SCHEMA:
            schema = _parsed('Schema', content)
            self._schemas[schema.id] = schema.name
            if schema.encoding == 'ros2msg':
                self._definitions[schema.name] = schema.data.decode()
        elif opcode == _CHANNEL:
            channel = _parsed('Channel', content)
            names = channel.topic, self._schemas[channel.schema_id]
            require_names(names)
            self._topics[channel.id] = names if channel.message_encoding == 'cdr' else None

    def chunk(self, content: bytes) -> Iterator[BagMessage]:
        """Yield the messages of a chunk; those before the damage if it is damaged."""
        chunk = _parsed('Chunk', content)
        rows = chunk.data
        require_small(chunk.uncompressed_size, 'a chunk')
        if chunk.compression:
            rows = unpacked(chunk.compression, rows)
        whole = len(rows) == chunk.uncompressed_size
        messages = self._rows(rows)
        if whole and chunk.uncompressed_crc and zlib.crc32(rows) != chunk.uncompressed_crc:
            whole = False
            # A decoder copies a wrong byte to wherever the right one occurs again.
            messages = iter(() if chunk.compression else _before_a_break(messages))
        yield from messages
        if not whole:
            raise BrokenRecordError(len(rows))

    def _rows(self, rows: bytes) -> Iterator[BagMessage]:
        stream = BytesIO(rows)
        for _, opcode, length in _records(stream, len(rows)):
            yield from self.record(opcode, stream.read(length))


def _before_a_break(messages: Iterator[BagMessage]) -> list[BagMessage]:
    """
    Return the messages of records that are known to be wrong somewhere.

    Those before the place where they stop being records; none where all of them are.
    """
    found = []
    try:
        for message in messages:
            found.append(message)
    except Exception:
        return found
    return []
