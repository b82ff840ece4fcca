# SPDX-License-Identifier: Apache-2.0
"""What the walks through bag files share: each yields messages from the start to the damage."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped]  # comes with both bag libraries
import zstandard  # comes with the mcap library


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


# By their names in MCAP, each for one use.
DECODERS: dict[str, Callable[[], Any]] = {
    'zstd': lambda: zstandard.ZstdDecompressor().decompressobj(),
    'lz4': lz4.frame.LZ4FrameDecompressor}


def uncompressed(data: bytes, compression: str) -> bytes:
    """Return the content of a chunk, as far as it goes where the end of it is cut off."""
    return DECODERS[compression]().decompress(data) if compression else data
