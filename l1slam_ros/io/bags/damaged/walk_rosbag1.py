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

from rosbags.typesys import get_types_from_msg

from l1slam_ros.io.bags.damaged.walk import (
    BrokenRecordError,
    RawMessage,
    broken_at,
    ros1_types,
    uncompressed,
)

_MAGIC = b'#ROSBAG V2.0\n'
_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
_LENGTH = struct.Struct('<I')
_TIME = struct.Struct('<II')


def walk_rosbag1(path: Path, definitions: dict[str, str]) -> Iterator[RawMessage]:
    """Yield the messages of a file in the order of writing; as `walk_mcap`."""
    size, chunks = path.stat().st_size, -1
    connections = _Connections(definitions)
    with path.open('rb') as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise BrokenRecordError(0)
        for start, header, data in _records(file, size):
            opcode = header['op'][0]
            if opcode == _BAG:
                chunks = _LENGTH.unpack(header['chunk_count'])[0]
            chunks -= opcode == _CHUNK_INFO
            read = connections.chunk if opcode == _CHUNK else connections.record
            yield from broken_at(size if file.tell() == size else start, read(header, data))
    # The chunks are listed at the end, unless the recorder was killed before.
    if chunks:
        raise BrokenRecordError(size)


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[int, dict[str, bytes], bytes]]:
    """Yield start, header and data of each record; the data of a chunk in part where it is cut."""
    while (start := stream.tell()) < size:
        try:
            header = _fields(_sized(stream, size))
            length = _LENGTH.unpack(stream.read(_LENGTH.size))[0]
            chunk = header['op'][0] == _CHUNK
        except (KeyError, IndexError, ValueError, struct.error) as error:
            raise BrokenRecordError(size if stream.tell() == size else start) from error
        there = size - stream.tell()
        if length <= there or chunk:
            yield start, header, stream.read(min(length, there))
        if length > there:
            raise BrokenRecordError(size)


def _sized(stream: BinaryIO, size: int) -> bytes:
    """Return the bytes after a length; where they are not all there, read to the end and raise."""
    length = _LENGTH.unpack(stream.read(_LENGTH.size))[0]
    content = stream.read(min(length, size - stream.tell()))
    if len(content) < length:
        raise ValueError(length)
    return content


def _fields(header: bytes) -> dict[str, bytes]:
    """Return the fields of a header."""
    fields, stream = {}, BytesIO(header)
    while stream.tell() < len(header):
        name, _, value = _sized(stream, len(header)).partition(b'=')
        fields[name.decode()] = value
    return fields


class _Connections:
    """Turns records into messages, by the connections announced before them."""

    def __init__(self, definitions: dict[str, str]):
        self._definitions = definitions
        self._fields: dict[str, Any] = {}
        self._types: Any = None
        self._topics: dict[int, tuple[str, str]] = {}

    def record(self, header: dict[str, bytes], data: bytes) -> Iterator[RawMessage]:
        """Yield the message that a record is; of a connection, learn what it says."""
        opcode = header['op'][0]
        if opcode not in (_MESSAGE, _CONNECTION):
            return
        number = _LENGTH.unpack(header['conn'])[0]
        if opcode == _CONNECTION:
            self._topics[number] = (header['topic'].decode(), self._learned(_fields(data)))
            return
        topic, msgtype = self._topics[number]
        seconds, nanoseconds = _TIME.unpack(header['time'])
        cdr = bytes(self._types.ros1_to_cdr(data, msgtype))
        yield RawMessage(topic, msgtype, seconds * 10**9 + nanoseconds, cdr)

    def chunk(self, header: dict[str, bytes], data: bytes) -> Iterator[RawMessage]:
        """Yield the messages of a chunk, in part where it is damaged."""
        rows = uncompressed(data, header['compression'].decode())
        stream = BytesIO(rows)
        for _, inner, content in _records(stream, len(rows)):
            yield from self.record(inner, content)
        if len(rows) != _LENGTH.unpack(header['size'])[0]:
            raise BrokenRecordError(len(rows))

    def _learned(self, connection: dict[str, bytes]) -> str:
        """Return the type of a connection, by its name in ROS 2, once its definition is known."""
        package, name = connection['type'].decode().split('/')
        msgtype, text = f'{package}/msg/{name}', connection['message_definition'].decode()
        if msgtype not in self._fields:
            self._fields.update(get_types_from_msg(text, msgtype))
            self._types = ros1_types(self._fields)
            self._definitions[msgtype] = text
        return msgtype
