# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Reading the messages before the first damage of a file that the bag library refuses.

The file is walked in the order in which it was written; what is behind the damage is not used.
"""

from collections import Counter, deque
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import zstandard  # comes with the bag libraries
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

from l1slam_ros.io.bags.bounds import MOST_AT_ONCE, BombError, unpacked
from l1slam_ros.io.bags.damaged.walk import BagMessage, BrokenRecordError
from l1slam_ros.io.bags.damaged.walk_mcap import walk_mcap
from l1slam_ros.io.bags.damaged.walk_sqlite import walk_sqlite
from l1slam_ros.io.bags.definitions import types_of

# The first bytes of a message that rosbag2 compressed alone; CDR never begins like this.
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
_WALKS = {'.mcap': walk_mcap, '.db3': walk_sqlite}
_PIECE = 4096  # [bytes] of a compressed file that are decompressed at a time
_MOST_PACKED = 200  # largest ratio of compression: images of a single colour come near it
_COMPLAINT = 200  # largest number of characters of a library's error that are quoted


class DamageError(Exception):
    """Why a file cannot be read to its end; where : the words after 'damaged'."""

    def __init__(self, path: Path, where: str):
        super().__init__(f'{path} is damaged{where}')
        self.where = where


class Salvage:
    """
    A damaged file; the constructor reads through it once.

    Parameters
    ----------
    file : .mcap or .db3, or one of them packed as a whole (.zstd)

    Attributes
    ----------
    counts : (topic, type) -> how many messages were found
    times : when they were recorded, in the order in which they were written [ns]
    damage : what ended the reading; None: it came to the end

    """

    def __init__(self, file: Path):
        self._file = file
        self._definitions: dict[str, str] = {}
        self.counts: Counter[tuple[str, str]] = Counter()
        self.times: list[int] = []
        self.damage: DamageError | None = None
        try:
            for message in self._walk():
                self.counts[message.topic, message.msgtype] += 1
                self.times.append(message.time)
        except DamageError as error:
            self.damage = error

    def messages(self, topics: Collection[str] | None, start: int | None,
                 stop: int | None) -> Iterator[BagMessage]:
        """
        Yield the messages in order of time; equal times in the order of the file.

        The file is read once more, so that only messages ahead of time are held in memory.

        topics : only these; None: all; start, stop : only from start [ns] on and before stop [ns]
        """
        order = deque(sorted(range(len(self.times)), key=self.times.__getitem__))
        waiting: dict[int, BagMessage] = {}
        # As many as were counted, so this ends before the damage.
        for k, message in enumerate(islice(self._walk(), len(order))):
            waiting[k] = message
            while order and order[0] in waiting:
                due = waiting.pop(order.popleft())
                if ((topics is None or due.topic in topics)
                        and (start is None or due.time >= start)
                        and (stop is None or due.time < stop)):
                    yield due

    def types(self) -> Any:
        """Return the types for decoding."""
        return types_of(tuple((name, MessageDefinition(MessageDefinitionFormat.MSG, text))
                              for name, text in self._definitions.items()))

    def _walk(self) -> Iterator[BagMessage]:
        """Yield the messages in the order in which they were written."""
        try:
            with _decompressed(self._file) as readable:
                walk = _WALKS[readable.suffix.lower()]
                try:
                    yield from map(unpacked_alone, walk(readable, self._definitions))
                except BrokenRecordError as error:
                    size = readable.stat().st_size
                    where = (f': it breaks off after {size:,} bytes' if error.position == size
                             else f' after {error.position:,} of {size:,} bytes')
                    raise DamageError(self._file, where) from error
        except (DamageError, BombError):
            raise
        except Exception as error:  # damaged files make the libraries raise anything
            raise DamageError(self._file, f': {complaint(error)}') from error


def complaint(error: Exception) -> str:
    """Return the message of a library's error on one line."""
    return ' '.join(str(error).split())[:_COMPLAINT] or type(error).__name__


@contextmanager
def _decompressed(file: Path) -> Iterator[Path]:
    """Yield a readable file: this one, or its decompressed content as far as it goes."""
    if file.suffix != '.zstd':
        yield file
        return
    with TemporaryDirectory() as folder:
        readable = Path(folder, file.stem)
        decoder = zstandard.ZstdDecompressor().decompressobj()
        most = max(MOST_AT_ONCE, _MOST_PACKED * file.stat().st_size)
        with (file.open('rb') as source, readable.open('wb') as target,
              suppress(zstandard.ZstdError)):
            while piece := source.read(_PIECE):
                target.write(decoder.decompress(piece))
                if target.tell() > most:
                    raise BombError(f'{file.name} unpacks to more than {most:,} bytes, '
                                    f'{_MOST_PACKED} times its size; expected a recording')
        yield readable


def unpacked_alone(message: BagMessage) -> BagMessage:
    """Return a message, decompressed if it was compressed alone."""
    if not message.data.startswith(_ZSTD_MAGIC):
        return message
    return message._replace(data=unpacked('zstd', message.data))
