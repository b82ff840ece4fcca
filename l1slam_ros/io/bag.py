# SPDX-License-Identifier: Apache-2.0
"""
Bags in and out; the only importer of the bag libraries, and only where they are needed.

In: rosbag2 directories, bare `.mcap` and `.db3` files. Out: rosbag2 directories (mcap) that
`ros2 bag play`, rosbags, Foxglove and the mcap tools read. A note of ours in a bag's metadata
(`custom_data`, key `l1slam`) says what its messages mean.
"""

import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple

from l1slam_ros.core.errors import FileError, L1SlamError

_NOTE_KEY = 'l1slam'
_METADATA = 'metadata.yaml'
_STORAGE_SUFFIXES = ('.mcap', '.db3')
# What recorders leave in a bag's directory besides.
_BAG_SUFFIXES = (*_STORAGE_SUFFIXES, '.db3-shm', '.db3-wal', '.zstd')
# The longest piece of a library's complaint that is passed on.
_COMPLAINT = 200


class BagMessage(NamedTuple):
    """A message of a bag; time : when it was recorded [ns]."""

    topic: str
    msgtype: str
    time: int
    message: Any


class RawMessage(NamedTuple):
    """The same, still serialised (CDR)."""

    topic: str
    msgtype: str
    time: int
    data: bytes


@dataclass(frozen=True)
class TopicSummary:
    """A topic, its type and how many messages it has."""

    name: str
    msgtype: str
    count: int


@dataclass(frozen=True)
class BagSummary:
    """
    What a bag holds.

    start : time of the first message [ns]; duration : until the last one [ns]; note : `read_note`.
    """

    topics: tuple[TopicSummary, ...]
    start: int
    duration: int
    note: dict[str, str]


def read_messages(
    path: str | os.PathLike[str], topics: Collection[str] | None = None
) -> Iterator[BagMessage]:
    """
    Yield the messages of a bag in order of time.

    Parameters
    ----------
    path : a rosbag2 directory, .mcap or .db3
    topics : only these; None: all

    Raises
    ------
    FileError : it cannot be read, or has none of the topics.

    """
    with _reading(path) as reader:
        for connection, time, data in reader.messages(_connections(path, reader, topics)):
            message = reader.deserialize(data, connection.msgtype)
            yield BagMessage(connection.topic, connection.msgtype, time, message)


def read_raw(
    path: str | os.PathLike[str],
    topics: Collection[str] | None = None,
    *,
    start: int | None = None,
    stop: int | None = None,
) -> Iterator[RawMessage]:
    """
    Yield the messages of a bag in order of time, as serialised; arguments as `read_messages`.

    start, stop : only messages from start [ns] on and before stop [ns].
    """
    with _reading(path) as reader:
        connections = _connections(path, reader, topics)
        for connection, time, data in reader.messages(connections, start, stop):
            yield RawMessage(connection.topic, connection.msgtype, time, bytes(data))


def bag_summary(path: str | os.PathLike[str]) -> BagSummary:
    """
    Return what a bag holds, topics in alphabetical order.

    Raises
    ------
    FileError : it cannot be read.

    """
    with _reading(path) as reader:
        topics = tuple(TopicSummary(name, topic.msgtype or 'several types', topic.msgcount)
                       for name, topic in sorted(reader.topics.items()))
        # Without messages the library's times are its largest and smallest numbers.
        start = reader.start_time if reader.message_count else 0
        # The library's end lies one nanosecond behind the last message.
        duration = reader.end_time - 1 - start if reader.message_count else 0
    return BagSummary(topics, start, duration, read_note(path))


def read_note(path: str | os.PathLike[str]) -> dict[str, str]:
    """
    Return what this package noted in a bag's metadata, {} where it noted nothing.

    `keyframes: every`: each odometry message is a keyframe; `covariance: increment`: its
    covariance is that of the motion since the message before.

    Raises
    ------
    FileError : the bag cannot be read.

    """
    import yaml

    path = _bag_path(path)
    with _named_errors(path):
        metadata = _directory_metadata(path) if path.is_dir() else _file_metadata(path)
        note = yaml.safe_load((metadata.get('custom_data') or {}).get(_NOTE_KEY, '{}'))
        return {str(key): str(value) for key, value in note.items()}


class BagWriter:
    """Writes messages into a new bag; `types` holds the classes of all ROS 2 messages by name."""

    def __init__(self, writer: Any, typestore: Any):
        self._writer, self._typestore = writer, typestore
        self._connections: dict[str, Any] = {}
        self.types: dict[str, Any] = typestore.types

    def add_topic(self, topic: str, msgtype: str) -> None:
        """Announce a topic: reliable, volatile, the last 1000 messages kept."""
        self._connections[topic] = self._writer.add_connection(
            topic, msgtype, typestore=self._typestore, offered_qos_profiles=[_offered_qos()])

    def write(self, topic: str, time: int, message: Any) -> None:
        """Write a message at a time [ns]."""
        connection = self._connections[topic]
        data = self._typestore.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, time, data)


@contextmanager
def new_bag(path: str | os.PathLike[str], note: dict[str, str]) -> Iterator[BagWriter]:
    """
    Yield the writer of a bag (a rosbag2 directory, mcap), in its place when the block succeeds.

    Parameters
    ----------
    path : a bag already there is replaced once the new one is complete
    note : what `read_note` will return

    Raises
    ------
    FileError : the bag cannot be written, or something that is no bag is in its place.

    """
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    target = Path(os.path.abspath(path))
    with _replacing_directory(target) as temporary:
        writer = Writer(temporary, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        writer.set_custom_data(_NOTE_KEY, _note_text(note))
        with writer:
            yield BagWriter(writer, get_typestore(Stores.ROS2_JAZZY))


def _bag_path(path: str | os.PathLike[str]) -> Path:
    bag = Path(path)
    if not bag.exists():
        raise FileError(path, 'no such file or directory; expected a bag')
    if not bag.is_dir() and bag.suffix not in _STORAGE_SUFFIXES:
        raise FileError(path, f'no bag by its name; expected {", ".join(_STORAGE_SUFFIXES)} '
                        'or a rosbag2 directory')
    if bag.is_dir() and not (bag / _METADATA).is_file():
        raise FileError(path, f'a directory without {_METADATA}; expected a rosbag2 directory')
    return bag


@contextmanager
def _reading(path: str | os.PathLike[str]) -> Iterator[Any]:
    """Yield a reader of the bag."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    bag = _bag_path(path)
    # The definitions in the bag come first; sqlite bags of older distributions have none.
    typestore = get_typestore(Stores.ROS2_JAZZY)
    with _named_errors(path), AnyReader([bag], default_typestore=typestore) as reader:
        yield reader


@contextmanager
def _named_errors(path: object) -> Iterator[None]:
    """Turn what the bag libraries raise on damaged files, nearly anything, into a FileError."""
    try:
        yield
    except L1SlamError:
        raise
    except Exception as error:
        complaint = ' '.join(str(error).split())[:_COMPLAINT] or type(error).__name__
        raise FileError(path, f'damaged, or no bag ({complaint}); expected a bag that can be '
                        'read to its end') from error


def _connections(path: object, reader: Any, topics: Collection[str] | None) -> list[Any]:
    """Return the library's connections of the topics."""
    found = [c for c in reader.connections if topics is None or c.topic in topics]
    if topics is not None and not found:
        names = ', '.join(sorted({c.topic for c in reader.connections})) or 'no topic at all'
        raise FileError(path, f'the bag has {names}; expected {", ".join(sorted(topics))}')
    return found


def _directory_metadata(bag: Path) -> dict[str, Any]:
    import yaml

    document = yaml.safe_load((bag / _METADATA).read_text(encoding='utf-8'))
    metadata: dict[str, Any] = document['rosbag2_bagfile_information']
    return metadata


def _file_metadata(bag: Path) -> dict[str, Any]:
    """Return what rosbag2 keeps inside an mcap file; .db3 files are never written here."""
    import yaml
    from mcap.reader import make_reader

    if bag.suffix != '.mcap':
        return {}
    with bag.open('rb') as file:
        for record in make_reader(file).iter_metadata():
            if record.name == 'rosbag2':
                return yaml.safe_load(record.metadata['serialized_metadata']) or {}
    return {}


def _note_text(note: dict[str, str]) -> str:
    return '{' + ', '.join(f'{key}: {value}' for key, value in note.items()) + '}'


def _offered_qos() -> Any:
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    # As rosbag2 writes it: 2^63 - 1 nanoseconds.
    forever = QosTime(9223372036, 854775807)
    return Qos(QosHistory.KEEP_LAST, 1000, QosReliability.RELIABLE, QosDurability.VOLATILE,
               forever, forever, QosLiveliness.AUTOMATIC, forever, False)


def _refuse_other_than_bag(target: Path) -> None:
    """Refuse to replace what is there, unless it is a bag and nothing else."""
    if not os.path.lexists(target):
        return
    if not (target / _METADATA).is_file():
        raise FileError(target, 'exists and is no bag, so it is not overwritten; expected a bag '
                        'or nothing there')
    for child in sorted(target.iterdir()):
        if child.name != _METADATA and not child.name.endswith(_BAG_SUFFIXES):
            raise FileError(target, f'holds {child.name}, which is no part of a bag, so it is not '
                            'overwritten; expected a bag or nothing there')


@contextmanager
def _replacing_directory(target: Path) -> Iterator[Path]:
    """Yield the name of a directory to make, which takes the place of `target` in the end."""
    scratch = None
    try:
        _refuse_other_than_bag(target)
        scratch = Path(mkdtemp(prefix=f'.{target.name}.', suffix='.tmp', dir=target.parent))
        # The bag is made under its own name: that of the file inside repeats it.
        made = scratch / target.name
        yield made
        for file in made.iterdir():
            with file.open('rb') as written:
                os.fsync(written.fileno())
        _swap(made, target, scratch / f'{target.name}.former')
    except OSError as error:
        raise FileError(target, f'cannot be written: {error.strerror or error}') from error
    finally:
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)


def _swap(made: Path, target: Path, former: Path) -> None:
    """Put `made` in the place of `target`, and what was there, if anything, into `former`."""
    replaces = os.path.lexists(target)
    if replaces:
        os.rename(target, former)
    try:
        os.rename(made, target)
    except OSError:
        if replaces:
            os.rename(former, target)
        raise
