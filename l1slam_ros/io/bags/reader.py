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

The files of a bag are read together, by time: recorders write late messages, and begin anew. Of a
damaged file what is before the damage is used, and of the other files everything. The libraries
are slow to import, so other modules import this one only when there is a bag.
"""

import os
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from math import inf
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from l1slam_ros.core.errors import FileError, L1SlamError
from l1slam_ros.io.bags.bag_files import (
    METADATA,
    bag_count,
    directory_metadata,
    files_of,
    storage_files,
)
from l1slam_ros.io.bags.bounds import BombError, require_shallow
from l1slam_ros.io.bags.damaged.walk import BagMessage
from l1slam_ros.io.bags.damaged.walk_mcap import mcap_metadata
from l1slam_ros.io.bags.damaged.walk_sqlite import sqlite_metadata
from l1slam_ros.io.bags.stored_file import Found, StoredFile
from l1slam_ros.io.bags.topics import BAG_SUFFIXES
from l1slam_ros.io.bags.writer import NOTE_KEY
from l1slam_ros.io.bounded import read_yaml
from l1slam_ros.io.files import other_kind

# Called with one sentence about the damage, after everything that can be read was.
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
                  on_damage: OnDamage = _refuse, more: Sequence[Path] = ()
                  ) -> Iterator[BagMessage]:
    """
    Yield the messages of a bag in order of time, decoded.

    Parameters
    ----------
    path : a rosbag2 directory, .mcap, .db3, .bag, or a directory with the files of one bag
    topics : only these, as far as the bag has them; None: all
    on_damage : called in the end with the reason why only a part could be read; by default raises
    more : further bags of the same drive, read together with it

    Raises
    ------
    FileError : nothing in it can be read.

    """
    count = undecodable = 0
    for raw, types in _messages((path, *more), topics, None, None, on_damage):
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
    for message, _ in _messages((path,), topics, start, stop, on_damage):
        yield message


def bag_summary(path: str | os.PathLike[str]) -> BagSummary:
    """
    Return what a bag holds, topics in alphabetical order.

    Raises
    ------
    FileError : nothing in it can be read.

    """
    bag = _bag_path(path)
    files, listing = _stored_files(bag)
    types = defaultdict[str, set[str]](set)
    counts = defaultdict[str, int](int)
    kept = defaultdict[str, int](int)
    times = list[int]()
    for file in files:
        content = file.content()
        times += content.times or ()
        for (name, msgtype), (count, late) in content.counts.items():
            types[name].add(msgtype)
            counts[name] += count
            kept[name] = max(kept[name], late)
    _require_any(bag, files, listing)
    topics = tuple(TopicSummary(name, (*found, 'several types')[0 if len(found) == 1 else -1],
                                counts[name], kept[name]) for name, found in sorted(types.items()))
    start = min(times, default=0)
    return BagSummary(topics, start, max(times, default=start) - start, read_note(path))


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
    if not bag.is_dir() and bag.suffix.lower() not in BAG_SUFFIXES:
        raise FileError(path, f'does not have the name of a bag; expected '
                        f'{", ".join(BAG_SUFFIXES)} or a rosbag2 directory')
    if bag.is_dir() and not (bag / METADATA).is_file() and (count := bag_count(bag)) != 1:
        raise FileError(path, f'a directory without {METADATA} and with the files of '
                        f'{count} bags; expected a rosbag2 directory')
    for part in () if bag.is_dir() else (bag, bag.with_name(f'{bag.name}-wal')):
        if kind := other_kind(part):  # reading it may never end
            raise FileError(part, f'cannot be read: it is {kind}')
    return bag


def _stored_files(bag: Path) -> tuple[list[StoredFile], str]:
    """Return the files of a bag, and what is wrong with their list, empty if nothing is."""
    try:
        require_shallow(bag / METADATA)
    except BombError as error:
        raise FileError(bag, str(error)) from error
    files, listing = files_of(bag)
    return [StoredFile(file) for file in files], listing


def _require_any(bag: Path, files: Sequence[StoredFile], listing: str) -> None:
    """Refuse a bag if nothing in any of its files could be read."""
    if all(file.failure for file in files):
        reason = next((file.failure for file in files), listing)
        raise FileError(bag, f'damaged, or not a bag ({reason}); expected a bag that can be read '
                        'to its end')


def _messages(paths: Sequence[str | os.PathLike[str]], topics: Collection[str] | None,
              start: int | None, stop: int | None, on_damage: OnDamage) -> Iterator[Found]:
    """Yield the messages of bags of one drive, each with the types for decoding it."""
    bags = [_bag_path(path) for path in paths]
    stored = [_stored_files(bag) for bag in bags]
    count = 0
    for found in _by_time([file for files, _ in stored for file in files], topics, start, stop):
        count += 1
        yield found
    several = sum(len(files) for files, _ in stored) > 1
    for bag, (files, listing) in zip(bags, stored, strict=True):
        _require_any(bag, files, listing)
        damages = [str(file.damage) for file in files if file.damage]
        if damages:
            others = f' (and {len(damages) - 1:,} more of its files)' if len(damages) > 1 else ''
            on_damage(f'{damages[0]}{others}; {count:,} messages before '
                      f'{"and after " if several else ""}that were used')
        elif listing:
            on_damage(f'{bag} is damaged: {listing}; {count:,} messages of its files were used')


def _by_time(files: Sequence[StoredFile], topics: Collection[str] | None, start: int | None,
             stop: int | None) -> Iterator[Found]:
    """
    Yield the messages of all files in order of time.

    Of each file one is held in memory, and nothing of a file before its time. Of one time in
    several files nothing says which came first, unless one ends where the next begins: they come
    by topic and content, so that it does not matter how a bag was split.
    """
    if len(files) == 1:
        yield from files[0].messages(topics, start, stop)
        return
    begun = [(*times, file) for file in files if (times := file.content().times)]
    waiting = deque(sorted(begun, key=itemgetter(0, 1)))
    ahead = list[_Ahead]()
    while waiting or ahead:
        time = min((one.found[0].time for one in ahead), default=inf)
        if waiting and waiting[0][0] <= time:
            begin, end, file = waiting.popleft()
            messages = file.messages(topics, start, stop)
            ahead += [_Ahead(begin, end, messages, found) for found in islice(messages, 1)]
            continue
        now = sorted((one for one in ahead if one.found[0].time == time), key=itemgetter(0, 1))
        ahead = [one for one in ahead if one.found[0].time > time]
        tied = list[Found]()
        for one in now:
            tied.append(one.found)
            for following in one.messages:
                if following[0].time > time:
                    ahead.append(one._replace(found=following))
                    break
                tied.append(following)
        if any(one.end > other.begin for one, other in pairwise(now)):
            tied.sort(key=lambda one: (one[0].topic, one[0].data))
        yield from tied


class _Ahead(NamedTuple):
    """A file that is being read: its first and last time [ns], and its next message."""

    begin: int
    end: int
    messages: Iterator[Found]
    found: Found
