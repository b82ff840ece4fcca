# SPDX-License-Identifier: Apache-2.0
"""
A .bag file of ROS 1 record by record from its start, as far as it can be read; no index is needed.

A record is a header (fields `name=value`) and data, each with its length before it. The data of
a chunk are such records again. Messages are turned into CDR, as ROS 2 serialises them.
"""

import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from rosbags.rosbag1.reader import Header, ReaderError, RecordType, read_uint32
from rosbags.typesys import get_types_from_msg

from l1slam_ros.io.bags.damaged.walk import (
    BagMessage,
    BrokenRecordError,
    broken_at,
    ros1_types,
    uncompressed,
)

_MAGIC = b'#ROSBAG V2.0\n'


def walk_rosbag1(path: Path, definitions: dict[str, str]) -> Iterator[BagMessage]:
    """Yield the messages of a file in the order of writing; as `walk_mcap`."""
    size, chunks = path.stat().st_size, -1
    connections = _Connections(definitions)
    with path.open('rb') as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise BrokenRecordError(0)
        for start, header, data in _records(file, size):
            opcode = header.get_uint8('op')
            if opcode == RecordType.BAGHEADER:
                chunks = header.get_uint32('chunk_count')
            chunks -= opcode == RecordType.CHUNK_INFO
            read = connections.chunk if opcode == RecordType.CHUNK else connections.record
            yield from broken_at(size if file.tell() == size else start, read(header, data))
    # The chunks are listed at the end, unless the recorder was killed before.
    if chunks:
        raise BrokenRecordError(size)


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[int, Any, bytes]]:
    """Yield start, header and data of each record; the data of a chunk in part where it is cut."""
    while (start := stream.tell()) < size:
        try:
            header = Header.read(stream)
            opcode, length = header.get_uint8('op'), read_uint32(stream)
        except (ReaderError, ValueError) as error:
            raise BrokenRecordError(size if stream.tell() == size else start) from error
        there = size - stream.tell()
        if length <= there or opcode == RecordType.CHUNK:
            yield start, header, stream.read(min(length, there))
        if length > there:
            raise BrokenRecordError(size)


class _Connections:
    """Turns records into messages, by the connections announced before them."""

    def __init__(self, definitions: dict[str, str]):
        self._definitions = definitions
        self._fields: dict[str, Any] = {}
        self._types: Any = None
        self._topics: dict[int, tuple[str, str]] = {}

    def record(self, header: Any, data: bytes) -> Iterator[BagMessage]:
        """Yield the message that a record is; of a connection, learn what it says."""
        opcode = header.get_uint8('op')
        if opcode == RecordType.CONNECTION:
            # The fields of its data are such as those of a header.
            connection = Header.read(BytesIO(struct.pack('<I', len(data)) + data))
            self._topics[header.get_uint32('conn')] = (
                header.get_string('topic'), self._learned(connection))
        elif opcode == RecordType.MSGDATA:
            topic, msgtype = self._topics[header.get_uint32('conn')]
            cdr = bytes(self._types.ros1_to_cdr(data, msgtype))
            yield BagMessage(topic, msgtype, header.get_time('time'), cdr)

    def chunk(self, header: Any, data: bytes) -> Iterator[BagMessage]:
        """Yield the messages of a chunk, in part where it is damaged."""
        rows = uncompressed(data, header.get_string('compression'))
        for _, inner, content in _records(BytesIO(rows), len(rows)):
            yield from self.record(inner, content)
        if len(rows) != header.get_uint32('size'):
            raise BrokenRecordError(len(rows))

    def _learned(self, connection: Any) -> str:
        """Return the type of a connection, by its name in ROS 2, once its definition is known."""
        package, name = connection.get_string('type').split('/')
        msgtype, text = f'{package}/msg/{name}', connection.get_string('message_definition')
        if msgtype not in self._fields:
            self._fields.update(get_types_from_msg(text, msgtype))
            self._types = ros1_types(self._fields)
            self._definitions[msgtype] = text
        return msgtype
