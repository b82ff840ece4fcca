# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Bags in: messages, raw or decoded, in order of time; a summary, a note; what is no bag."""

import pytest
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

from bags import NOTED, STRING, TYPES, write_strings
from l1slam_ros.core.errors import FileError
from l1slam_ros.io.bags.reader import bag_summary, read_messages, read_note, read_raw
from l1slam_ros.io.bags.writer import new_bag
from l1slam_ros.io.messages.serialisation import cdr, string_bytes


@pytest.fixture
def bag(tmp_path):
    return write_strings(tmp_path / 'bag')


def test_messages_come_in_order_of_time(bag):
    messages = list(read_messages(bag))
    assert [m.topic for m in messages] == ['/a', '/b', '/a', '/a', '/a', '/a']
    assert [m.time // 10**9 for m in messages] == [10, 11, 12, 14, 16, 18]
    assert messages[1].data.data == 'b'
    assert messages[1].msgtype == STRING
    assert [m.data.data for m in read_messages(bag, ['/b', '/not_there'])] == ['b']


def test_a_part_of_the_time(bag):
    part = read_raw(bag, start=11 * 10**9, stop=14 * 10**9)
    assert [m.time // 10**9 for m in part] == [11, 12]


def test_summary(bag):
    for path in (bag, bag / 'bag.mcap'):
        summary = bag_summary(path)
        assert [(t.name, t.msgtype, t.count) for t in summary.topics] == [
            ('/a', STRING, 5), ('/b', STRING, 1)]
        assert summary.start == 10 * 10**9
        assert summary.duration == 8 * 10**9
        assert summary.note == NOTED


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


def test_an_empty_bag(tmp_path):
    with new_bag(tmp_path / 'bag', {}) as writer:
        writer.add_topic('/a', STRING)
    summary = bag_summary(tmp_path / 'bag')
    assert (summary.start, summary.duration, summary.note) == (0, 0, {})
    assert list(read_messages(tmp_path / 'bag')) == []


def error_of(call, *arguments):
    with pytest.raises(FileError) as caught:
        list(call(*arguments))
    assert '\n' not in str(caught.value)
    return str(caught.value)


def test_what_is_no_bag_is_told(tmp_path, bag):
    (tmp_path / 'a.txt').write_text('x')
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'two').mkdir()
    for name in 'a_0.mcap', 'b_0.mcap':
        (tmp_path / 'two' / name).write_bytes((bag / 'bag.mcap').read_bytes())
    for call in (read_messages, read_raw, bag_summary, read_note):
        assert error_of(call, tmp_path / 'none').endswith(': no such file or directory; '
                                                          'expected a bag')
        assert 'not have the name of a bag; expected .mcap, .db3' in error_of(
            call, tmp_path / 'a.txt')
        for name, count in ('empty', 0), ('two', 2):
            assert (f'without metadata.yaml and with the files of {count} bags'
                    in error_of(call, tmp_path / name))
    assert list(read_messages(bag, ['/odom'])) == []


@pytest.mark.parametrize('content', [b'', b'x', b'\x89MCAP0\r\n', b'\x00' * 5000])
@pytest.mark.parametrize('suffix', ['.mcap', '.db3'])
def test_a_file_that_is_no_bag(tmp_path, content, suffix):
    path = tmp_path / f'a{suffix}'
    path.write_bytes(content)
    assert error_of(read_messages, path).startswith(f'{path}: damaged, or not a bag (')
    assert error_of(bag_summary, path).startswith(f'{path}: damaged, or not a bag (')
