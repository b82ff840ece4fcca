# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""One recording as a bag of every kind, each made by a library's own writer."""

import os
import shutil
import sqlite3

import yaml
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from records import read
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore
from worlds import simulated_bag

TYPES = get_typestore(Stores.ROS2_JAZZY)
NOTE = '{keyframes: every, covariance: increment}'
STRING, NOTED = 'std_msgs/msg/String', yaml.safe_load(NOTE)


def write_world(path, poses, edges, seed=0):
    """Write a simulated world as a bag of this package; return what is read of it."""
    return read(simulated_bag(path, poses, edges, '--seed', seed))


def recording_of(bag):
    """Return topic, type, time and CDR of each message, read by rosbags."""
    with AnyReader([bag]) as reader:
        return [(c.topic, c.msgtype, time, bytes(data)) for c, time, data in reader.messages()]


def write_mcap(stream, recording, ends=None, defined=True, note=None, **options):
    """
    Write with the mcap library.

    ends : gets where the file ends after each message; defined : whether definitions are written;
    note : what l1slam notes before the messages
    """
    writer = McapWriter(stream, **options)
    writer.start('ros2', 'test')
    if note:
        writer.add_metadata('l1slam', note)
    channels = {}
    for topic, msgtype, time, data in recording:
        if topic not in channels:
            text, _ = TYPES.generate_msgdef(msgtype, ros_version=2)
            schema = writer.register_schema(msgtype, 'ros2msg', text.encode() * defined)
            channels[topic] = writer.register_channel(topic, 'cdr', schema)
        writer.add_message(channels[topic], time, data, time)
        if ends is not None:
            ends.append(stream.tell())
    writer.finish()


def mcap_file(path, recording, **options):
    with path.open('wb') as stream:
        write_mcap(stream, recording, **options)
    return path


def rosbag2_directory(path, recording, plugin, mode=CompressionMode.NONE, note=NOTE):
    writer = Rosbag2Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    if note:
        writer.set_custom_data('l1slam', note)
    with writer:
        topics = {}
        for topic, msgtype, time, data in recording:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, msgtype, typestore=TYPES)
            writer.write(topics[topic], time, data)
    return path


def split_directory(path, recording, plugin, mode=CompressionMode.NONE, parts=3):
    """Write several files as rosbag2 does when it splits: `bag_0`, `bag_1` and so on."""
    size = -(-len(recording) // parts)
    return directory_of(path, [recording[k * size:(k + 1) * size] for k in range(parts)], plugin,
                        mode)


def directory_of(path, pieces, plugin, mode=CompressionMode.NONE, order=lambda names: names):
    """Write a file for each piece of a recording; order : that in which they are listed."""
    path.mkdir()
    names, totals = [], None
    for k, piece in enumerate(pieces):
        part = path / f'{path.name}_{k}'
        rosbag2_directory(part, piece, plugin, mode)
        document = yaml.safe_load((part / 'metadata.yaml').read_text())
        metadata = document['rosbag2_bagfile_information']
        names += metadata['relative_file_paths']
        shutil.move(part / names[-1], path / f'{names[-1]}.moved')
        shutil.rmtree(part)
        os.rename(path / f'{names[-1]}.moved', path / names[-1])
        topics = {t['topic_metadata']['name']: t for t in metadata['topics_with_message_count']}
        totals = totals or document
        known = totals['rosbag2_bagfile_information']['topics_with_message_count']
        known += [t for name, t in topics.items()
                  if name not in {k['topic_metadata']['name'] for k in known}]
    totals['rosbag2_bagfile_information']['relative_file_paths'] = order(names)
    (path / 'metadata.yaml').write_text(yaml.safe_dump(totals))
    return path


def ros1_file(path, recording, compression=None, chunk=20_000):
    writer = Rosbag1Writer(path)
    writer.chunk_threshold = chunk
    if compression is not None:
        writer.set_compression(compression)
    ros1 = get_typestore(Stores.ROS1_NOETIC)
    with writer:
        topics = {}
        for topic, msgtype, time, data in recording:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, msgtype, typestore=ros1)
            writer.write(topics[topic], time, TYPES.cdr_to_ros1(data, msgtype))
    return path


def journal_of_a_killed_recorder(path, bag):
    """Make a .db3 whose last rows are in the journal beside it, as after a power cut."""
    working = path.with_name('working.db3')
    shutil.copy(bag, working)
    database = sqlite3.connect(working)
    database.execute('PRAGMA journal_mode = WAL')
    rows = list(database.execute('SELECT topic_id, timestamp, data FROM messages ORDER BY id'))
    database.execute('DELETE FROM messages WHERE id > 100')
    database.commit()
    database.execute('PRAGMA wal_checkpoint(TRUNCATE)')
    database.executemany('INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)',
                         rows[100:])
    database.commit()
    for suffix in ('', '-wal'):
        shutil.copy(f'{working}{suffix}', f'{path}{suffix}')
    database.close()
    return path


SQLITE, MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
# Name of a kind -> how a recording is written as it, into an empty folder.
KINDS = {
    'mcap uncompressed': lambda folder, messages: mcap_file(
        folder / 'a.mcap', messages, compression=CompressionType.NONE),
    'mcap zstd': lambda folder, messages: mcap_file(
        folder / 'a.mcap', messages, compression=CompressionType.ZSTD, chunk_size=10_000),
    'mcap lz4': lambda folder, messages: mcap_file(
        folder / 'a.mcap', messages, compression=CompressionType.LZ4, chunk_size=10_000),
    'mcap without chunks': lambda folder, messages: mcap_file(
        folder / 'a.mcap', messages, use_chunking=False),
    'mcap without message index': lambda folder, messages: mcap_file(
        folder / 'a.mcap', messages, index_types=IndexType.CHUNK, chunk_size=10_000),
    'mcap without any index': lambda folder, messages: mcap_file(
        folder / 'a.mcap', messages, index_types=IndexType.NONE, use_statistics=False,
        repeat_channels=False, repeat_schemas=False, use_summary_offsets=False),
    'directory of mcap': lambda folder, messages: rosbag2_directory(
        folder / 'a', messages, MCAP),
    'directory of mcap, chunks compressed': lambda folder, messages: rosbag2_directory(
        folder / 'a', messages, MCAP, CompressionMode.STORAGE),
    'directory of mcap, file compressed': lambda folder, messages: rosbag2_directory(
        folder / 'a', messages, MCAP, CompressionMode.FILE),
    'directory of db3': lambda folder, messages: rosbag2_directory(
        folder / 'a', messages, SQLITE),
    'directory of db3, file compressed': lambda folder, messages: rosbag2_directory(
        folder / 'a', messages, SQLITE, CompressionMode.FILE),
    'directory of db3, messages compressed': lambda folder, messages: rosbag2_directory(
        folder / 'a', messages, SQLITE, CompressionMode.MESSAGE),
    'db3': lambda folder, messages: rosbag2_directory(
        folder / 'a', messages, SQLITE) / 'a.db3',
    'db3 with an odd name': lambda folder, messages: (rosbag2_directory(
        folder / 'a', messages, SQLITE) / 'a.db3').rename(folder / 'a 100%?#x.db3'),
    'db3 with a journal': lambda folder, messages: journal_of_a_killed_recorder(
        folder / 'killed.db3', rosbag2_directory(folder / 'a', messages, SQLITE) / 'a.db3'),
    'split mcap': lambda folder, messages: split_directory(folder / 'a', messages, MCAP),
    'split db3': lambda folder, messages: split_directory(folder / 'a', messages, SQLITE),
    'split mcap, files compressed': lambda folder, messages: split_directory(
        folder / 'a', messages, MCAP, CompressionMode.FILE, 12),
    'ROS 1': lambda folder, messages: ros1_file(folder / 'a.bag', messages),
    'ROS 1 bz2': lambda folder, messages: ros1_file(
        folder / 'a.bag', messages, Rosbag1Writer.CompressionFormat.BZ2),
    'ROS 1 lz4': lambda folder, messages: ros1_file(
        folder / 'a.bag', messages, Rosbag1Writer.CompressionFormat.LZ4),
}
