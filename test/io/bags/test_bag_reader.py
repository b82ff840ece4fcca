# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The reader of bags: any topics in order of time, what was kept for who comes late, the note."""

import struct

import lz4.frame
import pytest
import zstandard
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from bags import NOTED, STRING, TYPES
from l1slam_ros.core.errors import FileError
from l1slam_ros.io.bags.bounds import MOST_AT_ONCE
from l1slam_ros.io.bags.reader import bag_summary, read_messages, read_note
from l1slam_ros.io.bags.writer import new_bag
from l1slam_ros.io.messages.serialisation import cdr, string_bytes


@pytest.fixture
def bag(tmp_path):
    """Return a bag with five long strings on /a, one every other second, and one on /b."""
    with new_bag(tmp_path / 'bag', NOTED) as writer:
        writer.add_topic('/a', STRING)
        writer.add_topic('/b', STRING)
        for k in range(5):
            writer.write('/a', (10 + 2 * k) * 10**9, cdr((4, string_bytes(f'a{k}' * 50))))
        writer.write('/b', 11 * 10**9, cdr((4, string_bytes('b'))))
    return tmp_path / 'bag'


def test_messages_come_in_order_of_time(bag):
    messages = list(read_messages(bag))
    assert [m.topic for m in messages] == ['/a', '/b', '/a', '/a', '/a', '/a']
    assert [m.time // 10**9 for m in messages] == [10, 11, 12, 14, 16, 18]
    assert messages[1].data.data == 'b'
    assert messages[1].msgtype == STRING
    assert [m.data.data for m in read_messages(bag, ['/b', '/not_there'])] == ['b']


def test_summary_says_what_was_kept_for_who_comes_late(tmp_path):
    time = QosTime(0, 0)
    profiles = [Qos(QosHistory.KEEP_LAST, 3, QosReliability.RELIABLE, durability, time, time,
                    QosLiveliness.AUTOMATIC, time, False)
                for durability in (QosDurability.TRANSIENT_LOCAL, QosDurability.VOLATILE)]
    with Rosbag2Writer(tmp_path / 'two', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for name, offered in (('/grid', profiles), ('/said', profiles[1:])):
            to = writer.add_connection(name, STRING, typestore=TYPES, offered_qos_profiles=offered)
            writer.write(to, 1, cdr((4, string_bytes('a'))))
    for path in tmp_path / 'two', tmp_path / 'two' / 'two.mcap':
        assert {t.name: t.kept for t in bag_summary(path).topics} == {'/grid': 3, '/said': 0}
    with Rosbag1Writer(tmp_path / 'one.bag') as writer:
        for latching in 0, 1:
            writer.add_connection(f'/{latching}', STRING, typestore=get_typestore(
                Stores.ROS1_NOETIC), latching=latching)
    assert {t.name: t.kept for t in bag_summary(tmp_path / 'one.bag').topics} == {'/0': 0, '/1': 1}


@pytest.mark.parametrize('name', ['zstd', 'lz4'])
@pytest.mark.parametrize('stated', [3 * MOST_AT_ONCE // 2, 1000], ids=['true', 'lying'])
def test_a_chunk_that_unpacks_to_gigabytes_has_no_note(tmp_path, name, stated):
    bag, magic = tmp_path / 'bomb.mcap', b'\x89MCAP0\r\n'
    packer = (zstandard.ZstdCompressor().compressobj() if name == 'zstd'
              else lz4.frame.LZ4FrameCompressor())
    begin = packer.begin() if name == 'lz4' else b''
    packed = b''.join((begin, *(packer.compress(bytes(2**24))
                                for _ in range(3 * MOST_AT_ONCE // 2**25)), packer.flush()))

    def record(opcode, content):
        return struct.pack('<BQ', opcode, len(content)) + content

    chunk = struct.pack('<QQQII', 1, 2, stated, 0, len(name)) + name.encode() + struct.pack(
        '<Q', len(packed)) + packed
    bag.write_bytes(magic + record(1, bytes(8)) + record(6, chunk) + record(15, bytes(4))
                    + record(2, bytes(20)) + magic)
    with pytest.raises(FileError, match=r'bomb\.mcap: .* expected at most 256 MiB'):
        list(read_messages(bag))
    assert read_note(bag) == {}


@pytest.mark.parametrize('text', ['[' * 10000, '- ' * 10000 + 'x', '? ' * 5000 + 'x'],
                         ids=['brackets', 'lists', 'keys'])
def test_nested_yaml_has_no_note(tmp_path, text):
    bag = tmp_path / 'bag'
    bag.mkdir()
    (bag / 'metadata.yaml').write_text(text)
    (bag / 'bag_0.mcap').write_bytes(b'\x89MCAP0\r\n')
    assert read_note(bag) == {}
