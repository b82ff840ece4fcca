# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Reading the messages before the first damage of a bag that the bag library refuses.

The files of a bag are walked in the order in which they were written, up to the first damage.
Messages behind it are not used: odometry that ends early gives a smaller map, odometry with a gap
a wrong one.
"""

import re
from collections import Counter, deque
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import zstandard  # comes with the bag libraries
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from l1slam_ros.io.bags.bounds import MOST_AT_ONCE, BombError, unpacked
from l1slam_ros.io.bags.damaged.walk import BagMessage, BrokenRecordError
from l1slam_ros.io.bags.damaged.walk_mcap import walk_mcap
from l1slam_ros.io.bags.damaged.walk_sqlite import walk_sqlite
from l1slam_ros.io.bounded import read_yaml

METADATA = 'metadata.yaml'
# How rosbag2 names the files of a bag; `.zstd` if whole files are compressed.
_STORAGE_NAME = re.compile(r'(?P<bag>.+?)(_[0-9]+)?(\.mcap|\.db3)(\.zstd)?')
# The first bytes of a message that rosbag2 compressed alone; CDR never begins like this.
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
_WALKS = {'.mcap': walk_mcap, '.db3': walk_sqlite}
_PIECE = 4096  # [bytes] of a compressed file that are decompressed at a time
_MOST_PACKED = 200  # largest ratio of compression: images of a single colour come near it
_COMPLAINT = 200  # largest number of characters of a library's error that are quoted


class DamageError(Exception):
    """
    Why a bag cannot be read to its end.

    where : the words after 'damaged'; used : which messages are used
    """

    def __init__(self, path: Path, where: str, used: str = 'before that'):
        super().__init__(f'{path} is damaged{where}')
        self.where, self.used = where, used

    def sentence(self, count: int) -> str:
        """Return the damage as one sentence; count : how many messages were used."""
        return f'{self}; {count:,} messages {self.used} were used'


class Salvage:
    """
    A damaged bag; the constructor reads through it once.

    Parameters
    ----------
    bag : a rosbag2 directory, .mcap or .db3

    Attributes
    ----------
    counts : (topic, type) -> how many messages were found
    times : when they were recorded, in the order in which they were written [ns]
    damage : what ended the reading; None: it came to the end

    """

    def __init__(self, bag: Path):
        self._bag = bag
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
        Yield the messages in order of time; equal times in the order of the files.

        The bag is read once more, so that only messages that are ahead of time are held in memory.

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
        """Return the types for decoding: those of Jazzy, and others as the bag defines them."""
        types = get_typestore(Stores.ROS2_JAZZY)
        for name, text in self._definitions.items():
            with suppress(Exception):  # a damaged definition makes the library raise anything
                types.register({other: fields for other, fields
                                in get_types_from_msg(text, name).items()
                                if other not in types.fielddefs})
        return types

    def _walk(self) -> Iterator[BagMessage]:
        """Yield the messages of all files in the order in which they were written."""
        files, damage = _files(self._bag)
        for file in files:
            if not file.exists():
                raise DamageError(file, ': the file is missing')
            try:
                yield from self._messages_of(file)
            except (DamageError, BombError):
                raise
            except Exception as error:  # damaged files make the libraries raise anything
                raise DamageError(file, f': {complaint(error)}') from error
        if damage is not None:
            raise damage

    def _messages_of(self, file: Path) -> Iterator[BagMessage]:
        with _decompressed(file) as readable:
            walk = _WALKS[readable.suffix.lower()]
            try:
                yield from map(_unpacked, walk(readable, self._definitions))
            except BrokenRecordError as error:
                size = readable.stat().st_size
                where = (f': it breaks off after {size:,} bytes' if error.position == size
                         else f' after {error.position:,} of {size:,} bytes')
                raise DamageError(file, where) from error


def complaint(error: Exception) -> str:
    """Return the message of a library's error on one line."""
    return ' '.join(str(error).split())[:_COMPLAINT] or type(error).__name__


def directory_metadata(bag: Path) -> dict[str, Any]:
    """Return the content of the metadata.yaml of a bag; empty if it cannot be read."""
    with suppress(Exception):  # it may be missing, or not text, or not such YAML
        document = read_yaml((bag / METADATA).read_text(encoding='utf-8'))
        return dict(document['rosbag2_bagfile_information'])
    return {}


def storage_files(directory: Path) -> list[Path]:
    """Return the existing files of a bag in the order of their numbers."""
    def by_number(path: Path) -> list[tuple[str, int]]:
        return [(text, int(number or 0)) for text, number
                in re.findall(r'(\D*)([0-9]*)', path.name)]

    return sorted((path for path in directory.iterdir() if _STORAGE_NAME.fullmatch(path.name)),
                  key=by_number)


def bag_names(directory: Path) -> set[str]:
    """Return the names, without numbers, of the bags whose files are in a directory."""
    matches = map(_STORAGE_NAME.fullmatch, (path.name for path in directory.iterdir()))
    return {match['bag'] for match in matches if match}


def _files(bag: Path) -> tuple[list[Path], DamageError | None]:
    """Return the files of a bag in the order of writing, and an error if their list is damaged."""
    if not bag.is_dir():
        return [bag], None
    names = directory_metadata(bag).get('relative_file_paths')
    if isinstance(names, list) and names and all(isinstance(name, str) for name in names):
        # Older versions include the directory.
        return [bag / Path(name).name for name in names], None
    wrong = 'cannot be read' if (bag / METADATA).exists() else 'is missing'
    return storage_files(bag), DamageError(bag, f': its {METADATA} {wrong}', 'of its files')


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


def _unpacked(message: BagMessage) -> BagMessage:
    """Return a message, decompressed if it was compressed alone."""
    if not message.data.startswith(_ZSTD_MAGIC):
        return message
    return message._replace(data=unpacked('zstd', message.data))
