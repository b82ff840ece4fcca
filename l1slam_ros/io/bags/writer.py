# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Writing rosbag2 directories (mcap) that `ros2 bag play`, rosbags, Foxglove and mcap tools read.

The mcap library writes the file in small chunks with checksums, so that little is lost, and the
loss is noticed, if the file is cut or damaged later. This module adds what rosbag2 needs:
metadata.yaml, version 9, and a copy of it in the file.
"""

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from l1slam_ros.io.bags.bag_files import METADATA
from l1slam_ros.io.files import dated_names, new_folder_beside, reported, sync_folder

NOTE_KEY = 'l1slam'
# Suffixes of the other files in the directory of a bag.
_BAG_SUFFIXES = ('.mcap', '.db3', '.db3-shm', '.db3-wal', '.zstd')
_CHUNK = 16 * 1024  # [bytes] before compression: about 20 odometry messages
_LIBRARY = 'l1slam_ros'
_DISTRIBUTION = 'jazzy'
# As in rosbag2: 2^63 - 1 ns means no deadline, and is the start of an empty bag.
_FOREVER = {'sec': 9223372036, 'nsec': 854775807}
_NEVER = 2**63 - 1
_QOS = {'history': 'keep_last', 'depth': 1000, 'reliability': 'reliable', 'durability': 'volatile',
        'deadline': _FOREVER, 'lifespan': _FOREVER, 'liveliness': 'automatic',
        'liveliness_lease_duration': _FOREVER, 'avoid_ros_namespace_conventions': False}


class BagWriter:
    """Writes serialised messages into a new bag; apart : see `new_bag`."""

    def __init__(self, writer: Any, typestore: Any, apart: bool):
        self._writer, self._typestore, self._apart = writer, typestore, apart
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._msgtypes: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._times = (_NEVER, 0)

    def add_topic(self, topic: str, msgtype: str) -> None:
        """Announce a topic: reliable, volatile, the last 1000 messages kept."""
        if msgtype not in self._schemas:
            definition, _ = self._typestore.generate_msgdef(msgtype, ros_version=2)
            self._schemas[msgtype] = self._writer.register_schema(
                msgtype, 'ros2msg', definition.encode())
        self._msgtypes[topic] = msgtype
        self._channels[topic] = self._writer.register_channel(
            topic, 'cdr', self._schemas[msgtype], {
                'offered_qos_profiles': _yaml([_QOS]),
                'topic_type_hash': self._typestore.hash_rihs01(msgtype)})

    def write(self, topic: str, time: int, data: bytes) -> None:
        """Write a message (CDR) at a time [ns]."""
        if self._apart:
            time = max(time, self._times[1] + 1)
        self._writer.add_message(self._channels[topic], time, data, time)
        self._counts[topic] += 1
        self._times = (min(self._times[0], time), max(self._times[1], time))

    def metadata(self, file: str, note: dict[str, str]) -> dict[str, Any]:
        """Return the content of metadata.yaml for the file and a note."""
        start, stop = self._times
        extent = {'duration': {'nanoseconds': max(stop - start, 0)},
                  'starting_time': {'nanoseconds_since_epoch': start},
                  'message_count': self._counts.total()}
        return {
            'version': 9, 'storage_identifier': 'mcap', 'relative_file_paths': [file], **extent,
            'topics_with_message_count': [self._topic_metadata(name) for name in self._channels],
            'compression_format': '', 'compression_mode': '', 'files': [{'path': file, **extent}],
            'custom_data': {NOTE_KEY: _yaml(note, in_one_line=True)} if note else None,
            'ros_distro': _DISTRIBUTION}

    def _topic_metadata(self, topic: str) -> dict[str, Any]:
        msgtype = self._msgtypes[topic]
        return {'message_count': self._counts[topic], 'topic_metadata': {
            'name': topic, 'type': msgtype, 'serialization_format': 'cdr',
            'offered_qos_profiles': [_QOS],
            'type_description_hash': self._typestore.hash_rihs01(msgtype)}}


@contextmanager
def new_bag(path: str | os.PathLike[str], note: dict[str, str],
            apart: bool = False) -> Iterator[BagWriter]:
    """
    Yield the writer of a new bag, which is put in place when the block succeeds.

    Parameters
    ----------
    path : a bag already there is replaced once the new one is complete; anything else that is
        there is kept beside it, under its name and the time of its last change
    note : what `read_note` will return
    apart : whether a message is written behind the one before, at the least by a nanosecond

    Raises
    ------
    FileError : the bag cannot be written.

    """
    target = Path(os.path.realpath(path))
    with _replacing_directory(target) as made:
        made.mkdir()
        file = made / f'{target.name}.mcap'
        with file.open('xb') as stream:
            writer = Writer(stream, chunk_size=_CHUNK)
            writer.start('ros2', _LIBRARY)
            # The note comes first, so that it is not lost if the file is cut.
            if note:
                writer.add_metadata(NOTE_KEY, note)
            bag = BagWriter(writer, get_typestore(Stores.ROS2_JAZZY), apart)
            yield bag
            metadata = bag.metadata(file.name, note)
            writer.add_metadata('rosbag2', {'serialized_metadata': _yaml(metadata)})
            writer.finish()
        document = {'rosbag2_bagfile_information': metadata}
        (made / METADATA).write_text(_yaml(document) + '\n', 'utf-8')


# Writes no aliases for values that occur twice.
_DUMPER = type('_Dumper', (yaml.SafeDumper,), {'ignore_aliases': lambda self, data: True})


def _yaml(document: Any, in_one_line: bool = False) -> str:
    return str(yaml.dump(document, Dumper=_DUMPER, sort_keys=False, width=2**16,
                         default_flow_style=in_one_line)).strip()


@contextmanager
def _replacing_directory(target: Path) -> Iterator[Path]:
    """Yield the name of a directory that replaces `target` when the block succeeds."""
    with reported(target), new_folder_beside(target) as scratch:
        # Under its final name, which the file inside repeats.
        made = scratch / target.name
        yield made
        for file in made.iterdir():
            with file.open('rb') as written:
                os.fsync(written.fileno())
        sync_folder(made)
        # What is no bag is not removed with the scratch folder: it may be a person's work.
        kept = os.path.lexists(target) and not _is_bag(target)
        _swap(made, target, next(name for name in dated_names(target, target)
                                 if not os.path.lexists(name))
              if kept else scratch / f'{target.name}.former')
        sync_folder(target.parent)


def _is_bag(path: Path) -> bool:
    """Tell whether a directory is a bag and holds nothing else."""
    return (path / METADATA).is_file() and all(
        child.name == METADATA or child.name.endswith(_BAG_SUFFIXES) for child in path.iterdir())


def _swap(made: Path, target: Path, former: Path) -> None:
    """Move what is at `target`, if anything, to `former`, and `made` to `target`."""
    replaces = os.path.lexists(target)
    if replaces:
        os.rename(target, former)
    try:
        os.rename(made, target)
    except OSError:
        if replaces:
            os.rename(former, target)
        raise
