# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Reading bags: rosbag2 directories, bare `.mcap` and `.db3` files, `.bag` files of ROS 1.

The bag library reads them; if it fails, `salvage` reads what is before the damage. The libraries
are slow to import, so other modules import this one only when there is a bag.
"""

import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.typesys import Stores, get_typestore

from l1slam_ros.core.errors import FileError, L1SlamError
from l1slam_ros.io.bags.bounds import BombError, require_shallow, require_tables
from l1slam_ros.io.bags.damaged.salvage import (
    METADATA,
    Salvage,
    bag_names,
    complaint,
    directory_metadata,
    storage_files,
)
from l1slam_ros.io.bags.damaged.walk import BagMessage
from l1slam_ros.io.bags.damaged.walk_mcap import is_indexed, mcap_metadata
from l1slam_ros.io.bags.damaged.walk_sqlite import has_journal, is_cut, opened, sqlite_metadata
from l1slam_ros.io.bags.topics import BAG_SUFFIXES
from l1slam_ros.io.bags.writer import NOTE_KEY
from l1slam_ros.io.bounded import read_yaml
from l1slam_ros.io.files import other_kind

# Types that ROS 1 messages contain, in their ROS 2 form.
_BASIC = ('std_msgs/msg/Header', 'builtin_interfaces/msg/Time', 'builtin_interfaces/msg/Duration')
_TO_ITS_END = 'expected a bag that can be read to its end'
# Called with one sentence about the damage, after everything before it was read.
OnDamage = Callable[[str], None]


def _refuse(damage: str) -> None:
    raise L1SlamError(damage)


@dataclass(frozen=True)
class TopicSummary:
    """
    A topic, its type and its number of messages.

    kept : how many messages its publishers kept for subscribers that come late; 0: none.
    """

    name: str
    msgtype: str
    count: int
    kept: int = 0


@dataclass(frozen=True)
class BagSummary:
    """
    What a bag holds, as far as it can be read.

    start : time of the first message [ns]; duration : until the last one [ns]; note : `read_note`.
    """

    topics: tuple[TopicSummary, ...]
    start: int
    duration: int
    note: dict[str, str]


def read_messages(path: str | os.PathLike[str], topics: Collection[str] | None = None,
                  on_damage: OnDamage = _refuse) -> Iterator[BagMessage]:
    """
    Yield the messages of a bag in order of time, decoded.

    Parameters
    ----------
    path : a rosbag2 directory, .mcap, .db3 or .bag
    topics : only these, as far as the bag has them; None: all
    on_damage : called in the end with the reason why only a part could be read; by default raises

    Raises
    ------
    FileError : nothing in it can be read.

    """
    count = undecodable = 0
    for raw, types in _messages(path, topics, None, None, on_damage):
        try:
            message = types.deserialize_cdr(raw.data, raw.msgtype)
        except Exception:  # malformed messages make the library raise any error
            undecodable += 1
            continue
        count += 1
        yield raw._replace(data=message)
    if undecodable:
        on_damage(f'{path} is damaged: {undecodable:,} messages cannot be decoded; '
                  f'{count:,} others were used')


def read_raw(path: str | os.PathLike[str], topics: Collection[str] | None = None,
             on_damage: OnDamage = _refuse, *, start: int | None = None,
             stop: int | None = None) -> Iterator[BagMessage]:
    """
    Yield the serialised messages of a bag in order of time; see `read_messages`.

    start, stop : only messages from start [ns] on and before stop [ns].
    """
    for message, _ in _messages(path, topics, start, stop, on_damage):
        yield message


def bag_summary(path: str | os.PathLike[str]) -> BagSummary:
    """
    Return what a bag holds, topics in alphabetical order.

    Raises
    ------
    FileError : nothing in it can be read.

    """
    bag = _bag_path(path)
    try:
        with _reader(bag) as reader:
            counts = [(name, topic.msgtype or 'several types', topic.msgcount, _kept(topic))
                      for name, topic in reader.topics.items()]
            # Without messages the library's times are its largest and smallest numbers; its end
            # lies one nanosecond behind the last message.
            times = [reader.start_time, reader.end_time - 1] if reader.message_count else [0]
    except Exception as error:  # damaged bags make the library raise anything
        salvage = _salvage(bag, error)
        counts = [(*names, count, 0) for names, count in salvage.counts.items()]
        times = salvage.times
    topics = tuple(TopicSummary(*entry) for entry in sorted(counts))
    return BagSummary(topics, min(times), max(times) - min(times), read_note(path))


def _kept(topic: Any) -> int:
    """Return how many messages of a topic were kept for subscribers that come late."""
    kept = 0
    for connection in topic.connections:
        for profile in getattr(connection.ext, 'offered_qos_profiles', ()):
            if profile.durability is QosDurability.TRANSIENT_LOCAL:
                kept += max(profile.depth, 1)
        kept += bool(getattr(connection.ext, 'latching', False))  # of ROS 1
    return kept


def read_note(path: str | os.PathLike[str]) -> dict[str, str]:
    """
    Return the note of this package in a bag; {} if there is none or it cannot be read.

    `keyframes: every`: each odometry message is a keyframe; `covariance: increment`: its
    covariance is that of the motion since the message before.

    Raises
    ------
    FileError : there is no such bag.

    """
    bag = _bag_path(path)
    for file in [bag] if bag.is_file() else [bag, *storage_files(bag)]:
        try:
            note = {str(key): str(value) for key, value in _note_in(file).items()}
        except Exception:  # damaged files and malformed notes raise any error
            continue
        if note:
            return note
    return {}


def _note_in(file: Path) -> dict[str, str]:
    """Return the note in a file, or in the metadata.yaml of a directory."""
    metadata: dict[str, Any] = {}
    if file.is_dir():
        metadata = directory_metadata(file)
    elif file.suffix.lower() == '.db3':
        metadata = read_yaml(sqlite_metadata(file)) or {}
    elif file.suffix.lower() == '.mcap':
        for name, entries in mcap_metadata(file):
            if name == NOTE_KEY:
                return entries
            if name == 'rosbag2':
                metadata = read_yaml(entries['serialized_metadata'])
    return read_yaml((metadata.get('custom_data') or {}).get(NOTE_KEY, '{}'))


def _bag_path(path: str | os.PathLike[str]) -> Path:
    bag = Path(path)
    if not bag.exists():
        raise FileError(path, 'no such file or directory; expected a bag')
    if bag.is_file() and bag.suffix.lower() not in BAG_SUFFIXES:
        raise FileError(path, f'does not have the name of a bag; expected '
                        f'{", ".join(BAG_SUFFIXES)} or a rosbag2 directory')
    if bag.is_dir() and not (bag / METADATA).is_file() and len(bag_names(bag)) != 1:
        raise FileError(path, f'a directory without {METADATA} and with the files of '
                        f'{len(bag_names(bag))} bags; expected a rosbag2 directory')
    for part in bag.iterdir() if bag.is_dir() else (bag, bag.with_name(f'{bag.name}-wal')):
        if kind := '' if part.is_dir() else other_kind(part):  # reading it may never end
            raise FileError(part, f'cannot be read: it is {kind}')
    return bag


def _messages(path: str | os.PathLike[str], topics: Collection[str] | None, start: int | None,
              stop: int | None, on_damage: OnDamage) -> Iterator[tuple[BagMessage, Any]]:
    """Yield the messages of a bag, each with the types for decoding it."""
    bag = _bag_path(path)
    count = 0
    last = -math.inf
    try:
        # All messages of one time or none: the library may order them differently from the file.
        for time, group in groupby(_by_library(bag, topics, start, stop), lambda m: m[0].time):
            messages = list(group)
            count = count + len(messages)
            last = time
            yield from messages
        return
    except Exception as error:  # damaged bags make the library raise anything
        salvage = _salvage(bag, error)
    types = salvage.types()
    for message in salvage.messages(topics, start, stop):
        if message.time > last:
            count += 1
            yield message, types
    if salvage.damage is not None:
        on_damage(salvage.damage.sentence(count))


def _by_library(bag: Path, topics: Collection[str] | None, start: int | None,
                stop: int | None) -> Iterator[tuple[BagMessage, Any]]:
    with _reader(bag) as reader:
        types = reader.typestore if reader.is2 else _ros1_types(reader.typestore.fielddefs)
        connections = [c for c in reader.connections if topics is None or c.topic in topics]
        missing = sum(c.msgcount for c in connections)
        # For the library an empty list means all connections.
        for c, time, data in reader.messages(connections, start, stop) if connections else ():
            missing -= 1
            cdr = bytes(data if reader.is2 else types.ros1_to_cdr(data, c.msgtype))
            yield BagMessage(c.topic, c.msgtype, time, cdr), types
        # The library stops silently at a damaged record within a chunk.
        if missing > 0 and start is None and stop is None:
            raise LookupError(f'{missing:,} messages are missing')


def _ros1_types(fields: Mapping[str, Any]) -> Any:
    """Return the types for converting messages of ROS 1 to CDR and decoding them."""
    jazzy = get_typestore(Stores.ROS2_JAZZY).fielddefs
    types = get_typestore(Stores.EMPTY)
    # The header of ROS 1 has one more field, which the library's conversion drops.
    types.register({**fields, **{name: jazzy[name] for name in _BASIC}})
    return types


@contextmanager
def _reader(bag: Path) -> Iterator[Any]:
    """Yield the library's reader of a bag, after checks that the library does not make."""
    if bag.is_dir():
        require_shallow(bag / METADATA)
        if str(directory_metadata(bag).get('compression_mode') or 'none').lower() != 'none':
            raise LookupError('compressed by file or message')  # the library does not limit that
    for file in storage_files(bag) if bag.is_dir() else [bag]:
        if file.suffix == '.mcap' and not is_indexed(file):
            raise LookupError(f'{file.name} has no sound index')
        if file.suffix == '.db3' and (has_journal(file) or is_cut(file)):
            raise LookupError(f'{file.name} is not all there')
        if file.suffix == '.db3':
            with opened(file) as database:
                require_tables(database)
    # Used if the bag has no definitions, as sqlite bags of older distributions.
    typestore = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([bag], default_typestore=typestore) as reader:
        yield reader


def _salvage(bag: Path, error: Exception) -> Salvage:
    """Return the messages before the damage of a bag that the library cannot read."""
    if isinstance(error, BombError):
        raise FileError(bag, str(error)) from error
    if bag.suffix.lower() == '.bag':
        raise FileError(bag, f'damaged, or not a bag ({complaint(error)}); {_TO_ITS_END}: '
                        '`rosbag reindex` may repair it') from error
    try:
        salvage = Salvage(bag)
    except BombError as bomb:
        raise FileError(bag, str(bomb)) from bomb
    if salvage.counts:
        return salvage
    reason = complaint(error)
    if salvage.damage is not None and salvage.damage.where.startswith(': '):
        reason = salvage.damage.where[2:]
    raise FileError(bag, f'damaged, or not a bag ({reason}); {_TO_ITS_END}') from error
