# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
One file of a bag: its topics, and its messages in order of time.

The bag library reads it; where that fails, `salvage` reads what is before the damage.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from rosbags.interfaces import QosDurability
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader

from l1slam_ros.core.errors import FileError
from l1slam_ros.io.bags.bounds import BombError, require_names, require_tables
from l1slam_ros.io.bags.damaged.salvage import DamageError, Salvage, complaint, unpacked_alone
from l1slam_ros.io.bags.damaged.walk import BagMessage
from l1slam_ros.io.bags.damaged.walk_mcap import is_indexed
from l1slam_ros.io.bags.damaged.walk_sqlite import has_journal, is_cut, opened
from l1slam_ros.io.bags.definitions import types_of

# A message and the types for decoding it.
Found = tuple[BagMessage, Any]


@dataclass(frozen=True)
class FileContent:
    """
    What a file holds, as far as it can be read.

    counts : (topic, type) -> how many messages there are, and how many of them its publishers kept
    for subscribers that come late; times : of the first message and the last one [ns], None: there
    are none
    """

    counts: dict[tuple[str, str], tuple[int, int]]
    times: tuple[int, int] | None


class StoredFile:
    """
    One file of a bag.

    Parameters
    ----------
    path : .mcap, .db3, .bag, or one of them packed as a whole (.zstd)

    Attributes
    ----------
    damage : why it cannot be read to its end, known after `content` or after the last message;
        None: it can
    failure : why nothing in it can be read, known then, too; empty: something can

    """

    def __init__(self, path: Path):
        self._path = path
        self._salvage: Salvage | None = None
        self.damage: DamageError | None = None
        self.failure = ''

    def content(self) -> FileContent:
        """
        Return what the file holds.

        Raises
        ------
        FileError : it asks for more memory or time than a recording needs.

        """
        try:
            with self._library() as reader:
                counts = defaultdict[tuple[str, str], tuple[int, int]](lambda: (0, 0))
                for connection in reader.connections:
                    key = connection.topic, connection.msgtype
                    count, kept = counts[key]
                    counts[key] = count + connection.msgcount, kept + _kept(connection)
                # Without messages the library's times are its largest and smallest numbers; its
                # end lies one nanosecond behind the last message.
                times = reader.start_time, reader.end_time - 1
                return FileContent(dict(counts), times if reader.message_count else None)
        except Exception as error:  # damaged files make the library raise anything
            self._begin_salvage(error)
        if self._salvage is None:
            return FileContent({}, None)
        found = self._salvage.times
        return FileContent({key: (count, 0) for key, count in self._salvage.counts.items()},
                           (min(found), max(found)) if found else None)

    def messages(self, topics: Collection[str] | None, start: int | None,
                 stop: int | None) -> Iterator[Found]:
        """
        Yield the messages in order of time.

        topics : only these; None: all; start, stop : only from start [ns] on and before stop [ns]

        Raises
        ------
        FileError : see `content`.

        """
        last = -math.inf
        if not self.failure and self._salvage is None:
            try:
                # All messages of one time or none: the library may order them differently from
                # the file.
                for time, group in groupby(self._by_library(topics, start, stop),
                                           lambda m: m[0].time):
                    messages = list(group)
                    last = time
                    yield from messages
                return
            except Exception as error:  # damaged files make the library raise anything
                self._begin_salvage(error)
                if last > -math.inf:
                    self.failure = ''
        if self._salvage is not None:
            types = self._salvage.types()
            for message in self._salvage.messages(topics, start, stop):
                if message.time > last:
                    yield message, types

    def _by_library(self, topics: Collection[str] | None, start: int | None,
                    stop: int | None) -> Iterator[Found]:
        with self._library() as reader:
            is_ros1 = isinstance(reader, Ros1Reader)
            types = types_of(tuple((c.msgtype, c.msgdef) for c in reader.connections), is_ros1)
            connections = [c for c in reader.connections if topics is None or c.topic in topics]
            missing = sum(c.msgcount for c in connections)
            # For the library an empty list means all connections.
            for c, time, data in reader.messages(connections, start, stop) if connections else ():
                if not isinstance(time, int):
                    raise LookupError('a time that is no number')
                missing -= 1
                cdr = bytes(types.ros1_to_cdr(data, c.msgtype) if is_ros1 else data)
                yield unpacked_alone(BagMessage(c.topic, c.msgtype, time, cdr)), types
            # The library stops silently at a damaged record within a chunk.
            if missing > 0 and start is None and stop is None:
                raise LookupError(f'{missing:,} messages are missing')

    @contextmanager
    def _library(self) -> Iterator[Any]:
        """Yield the library's reader, after checks that the library does not make."""
        file = self._path
        if not file.is_file():  # another kind of file, as a pipe, would be waited for
            raise LookupError('the file is missing')
        if file.suffix == '.mcap' and not is_indexed(file):
            raise LookupError('no sound index')
        if file.suffix == '.db3':
            if has_journal(file) or is_cut(file):
                raise LookupError('not all there')
            with opened(file) as database:
                require_tables(database)
        with (Ros1Reader if file.suffix == '.bag' else Ros2Reader)(file) as reader:
            require_names(name for c in reader.connections for name in (c.topic, c.msgtype))
            yield reader

    def _begin_salvage(self, error: Exception) -> None:
        """Find out what is before the damage of a file that the library cannot read."""
        if isinstance(error, BombError):
            raise FileError(self._path, str(error)) from error
        self.failure = complaint(error)
        if not self._path.is_file() or self._path.suffix.lower() == '.bag':
            if self._path.is_file():
                self.failure += '; `rosbag reindex` may repair it'
            self.damage = DamageError(self._path, f': {self.failure}')
            return
        try:
            self._salvage = Salvage(self._path)
        except BombError as bomb:
            raise FileError(self._path, str(bomb)) from bomb
        self.damage = self._salvage.damage
        if self._salvage.counts:
            self.failure = ''
        elif self.damage is not None and self.damage.where.startswith(': '):
            self.failure = self.damage.where[2:]


def _kept(connection: Any) -> int:
    """Return how many messages of a connection were kept for subscribers that come late."""
    kept = int(bool(getattr(connection.ext, 'latching', False)))  # of ROS 1
    for profile in getattr(connection.ext, 'offered_qos_profiles', ()):
        if profile.durability is QosDurability.TRANSIENT_LOCAL:
            kept += max(profile.depth, 1)
    return kept
