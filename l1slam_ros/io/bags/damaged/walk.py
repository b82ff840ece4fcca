# SPDX-License-Identifier: Apache-2.0
"""What the walks through bag files share: each yields messages from the start to the damage."""

import bz2
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped]  # comes with both bag libraries
import zstandard  # comes with the mcap library
from rosbags.typesys import Stores, get_typestore

_BASIC = ('std_msgs/msg/Header', 'builtin_interfaces/msg/Time', 'builtin_interfaces/msg/Duration')
_PIECE = 4096  # [bytes] a decoder is given at a time


class BagMessage(NamedTuple):
    """A message of a bag; time : when recorded [ns]; data : serialised (CDR), or decoded."""

    topic: str
    msgtype: str
    time: int
    data: Any


class BrokenRecordError(Exception):
    """The walk ends; `position` [bytes] is where in the file, or in the chunk."""

    def __init__(self, position: int):
        super().__init__(f'no readable record at byte {position}')
        self.position = position


def broken_at(position: int, messages: Iterator[BagMessage]) -> Iterator[BagMessage]:
    """Yield the messages; raise nothing but a BrokenRecordError with that position."""
    try:
        yield from messages
    except Exception as error:  # damaged content makes the readers of records raise anything
        raise BrokenRecordError(position) from error


def ros1_types(fields: Mapping[str, Any]) -> Any:
    """Return the types by which messages of ROS 1 become CDR, and are decoded from that."""
    jazzy = get_typestore(Stores.ROS2_JAZZY).fielddefs
    types = get_typestore(Stores.EMPTY)
    # In ROS 1 a header has one field more, which the library's conversion leaves out.
    types.register({**fields, **{name: jazzy[name] for name in _BASIC}})
    return types


def zstd_decoder() -> Any:
    """Return a decoder of zstd for one use."""
    return zstandard.ZstdDecompressor().decompressobj()


def lz4_decoder() -> Any:
    """Return a decoder of lz4 for one use."""
    return lz4.frame.LZ4FrameDecompressor()


# By their names in MCAP and in bags of ROS 1.
_DECODERS = {'zstd': zstd_decoder, 'lz4': lz4_decoder, 'bz2': bz2.BZ2Decompressor}


def uncompressed(data: bytes, compression: str) -> bytes:
    """Return the content of a chunk, as far as it goes."""
    if compression in ('', 'none'):
        return data
    return decoded(_DECODERS[compression], data)


def decoded(make_decoder: Callable[[], Any], data: bytes, sure: int = 0,
            piece: int = _PIECE) -> bytes:
    """Return what a decoder makes of `data` before it fails; the first `sure` bytes never fail."""
    decoder = make_decoder()
    parts = [decoder.decompress(data[:sure])]
    for start in range(sure, len(data), piece):
        try:
            parts.append(decoder.decompress(data[start:start + piece]))
        except Exception:  # the decoders have no exception in common
            if piece == 1:
                break
            # A failure takes along what this piece held before it: once more, byte by byte.
            return decoded(make_decoder, data[:start + piece], start, 1)
    return b''.join(parts)
