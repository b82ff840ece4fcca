# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Bags out: by the rules of rosbag2 and MCAP, whole or not at all."""

import json
import zlib
from pathlib import Path

import pytest
import yaml
from disk import Disk
from mcap.reader import NonSeekingReader, make_reader
from mcap.stream_reader import StreamReader

from bags import NOTE, NOTED, STRING, write_strings
from l1slam_ros.core.errors import FileError, GraphError
from l1slam_ros.io.bags.reader import read_messages
from l1slam_ros.io.bags.writer import new_bag


@pytest.fixture
def bag(tmp_path):
    return write_strings(tmp_path / 'bag')


def records_of(path):
    with path.open('rb') as file:
        return list(StreamReader(file, emit_chunks=True, validate_crcs=True).records)


def test_the_file_is_what_rosbag2_and_mcap_tools_want(tmp_path):
    path = write_strings(tmp_path / 'bag', 500) / 'bag.mcap'
    with path.open('rb') as file:
        reader = make_reader(file, validate_crcs=True)
        summary, header = reader.get_summary(), reader.get_header()
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        assert len(list(reader.iter_messages())) == 501
    assert header.profile == 'ros2'
    assert summary.statistics.message_count == 501
    assert summary.statistics.channel_message_counts == {1: 500, 2: 1}
    assert {s.encoding for s in summary.schemas.values()} == {'ros2msg'}
    assert {c.message_encoding for c in summary.channels.values()} == {'cdr'}
    assert len(summary.chunk_indexes) > 3
    assert all(chunk.message_index_offsets for chunk in summary.chunk_indexes)
    assert {chunk.compression for chunk in summary.chunk_indexes} == {'zstd'}
    document = yaml.safe_load((path.parent / 'metadata.yaml').read_text())
    inside = yaml.safe_load(metadata['rosbag2']['serialized_metadata'])
    assert inside == document['rosbag2_bagfile_information']
    assert (inside['version'], inside['storage_identifier']) == (9, 'mcap')
    assert inside['relative_file_paths'] == ['bag.mcap']
    assert inside['custom_data'] == {'l1slam': NOTE}
    assert (inside['message_count'], inside['duration']['nanoseconds']) == (501, 998 * 10**9)
    assert {topic['topic_metadata']['name']: topic['message_count']
            for topic in inside['topics_with_message_count']} == {'/a': 500, '/b': 1}
    assert metadata['l1slam'] == NOTED


def test_every_chunk_and_the_index_carry_a_checksum(tmp_path):
    path = write_strings(tmp_path / 'bag', 500) / 'bag.mcap'
    records = records_of(path)
    chunks = [record for record in records if type(record).__name__ == 'Chunk']
    assert all(chunk.uncompressed_crc for chunk in chunks)
    assert max(chunk.uncompressed_size for chunk in chunks) < 20_000
    footer, whole = records[-1], path.read_bytes()
    # By the format: of the summary, and of the footer up to the checksum itself.
    assert footer.summary_crc == zlib.crc32(whole[footer.summary_start:-8 - 4])


def test_the_note_comes_before_the_messages_it_is_about(bag):
    header, note, *rest = records_of(bag / 'bag.mcap')
    assert (header.profile, note.name) == ('ros2', 'l1slam')
    assert 'Chunk' in {type(record).__name__ for record in rest}


def test_a_stream_of_the_file_is_enough(bag):
    with (bag / 'bag.mcap').open('rb') as file:
        topics = [channel.topic for _, channel, _ in NonSeekingReader(file).iter_messages()]
    assert topics == ['/a', '/b', '/a', '/a', '/a', '/a']


def test_every_topic_has_its_type_and_all_qos_keys(bag):
    qos_keys = {'history', 'depth', 'reliability', 'durability', 'deadline', 'lifespan',
                'liveliness', 'liveliness_lease_duration', 'avoid_ros_namespace_conventions'}
    data = yaml.safe_load((bag / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    with (bag / 'bag.mcap').open('rb') as file:
        channels = {c.topic: c for c in make_reader(file).get_summary().channels.values()}
    for topic in data['topics_with_message_count']:
        metadata = topic['topic_metadata']
        assert metadata['serialization_format'] == 'cdr' and metadata['type'] == STRING
        qos, = metadata['offered_qos_profiles']
        assert set(qos) == qos_keys
        assert (qos['history'], qos['depth']) == ('keep_last', 1000)
        assert (qos['reliability'], qos['durability']) == ('reliable', 'volatile')
        inside = channels[metadata['name']].metadata
        assert yaml.safe_load(inside['offered_qos_profiles']) == [qos]
        assert inside['topic_type_hash'] == metadata['type_description_hash']
    assert '&' not in (bag / 'metadata.yaml').read_text()


@pytest.mark.parametrize('msgtype', [
    'nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'geometry_msgs/msg/PoseStamped'])
def test_type_hashes_are_those_of_ros(tmp_path, msgtype):
    package, _, name = msgtype.split('/')
    module = Path(pytest.importorskip(package).__file__)
    files = [parent / 'share' / package / 'msg' / f'{name}.json' for parent in module.parents]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        pytest.skip(f'no description of {msgtype} is installed')
    expected = next(entry['hash_string'] for entry in json.loads(file.read_text())['type_hashes']
                    if entry['type_name'] == msgtype)
    with new_bag(tmp_path / 'bag', {}) as writer:
        writer.add_topic('/a', msgtype)
    data = yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text())
    topic, = data['rosbag2_bagfile_information']['topics_with_message_count']
    assert topic['topic_metadata']['type_description_hash'] == expected


def test_a_bag_is_whole_or_absent(tmp_path):
    with pytest.raises(GraphError), new_bag(tmp_path / 'bag', {}) as writer:
        writer.add_topic('/a', STRING)
        writer.write('/a', 1, b'')
        assert not (tmp_path / 'bag').exists()
        raise GraphError('half way')
    assert list(tmp_path.iterdir()) == []


def test_a_former_bag_stays_until_the_new_one_is_complete(bag):
    before = {p: p.read_bytes() for p in bag.iterdir()}
    with pytest.raises(KeyboardInterrupt), new_bag(bag, {}) as writer:
        writer.add_topic('/new', STRING)
        raise KeyboardInterrupt
    assert {p: p.read_bytes() for p in bag.iterdir()} == before
    write_strings(bag, 1)
    assert [m.topic for m in read_messages(bag)] == ['/a', '/b']
    assert {p.name for p in bag.iterdir()} == {'metadata.yaml', 'bag.mcap'}
    assert list(bag.parent.iterdir()) == [bag]


def contents(bag):
    return {file.name: file.read_bytes() for file in bag.iterdir()}


# Both files, then their folder; the two renamings, then the folder around it.
CALLS = ['open', 'open', 'fsync', 'fsync', 'fsync', 'rename', 'rename', 'fsync']


@pytest.mark.parametrize('failing', range(len(CALLS) + 1))
def test_a_disk_that_fails_leaves_the_old_bag_or_the_new_one(tmp_path, bag, monkeypatch, failing):
    old = contents(bag)
    disk = Disk(monkeypatch, tmp_path, failing)
    if failing in (4, 7, 8):  # that a folder cannot be synced is no reason to fail
        write_strings(bag, 3)
        assert contents(bag) != old and len(list(read_messages(bag))) == 4
    else:
        with pytest.raises(FileError, match='cannot be written: Input/output error'):
            write_strings(bag, 3)
        assert contents(bag) == old
    assert disk.calls[:failing + 1] == CALLS[:failing + 1]
    assert list(tmp_path.iterdir()) == [bag]


def test_a_power_cut_after_a_bag_is_written_takes_none_of_it(tmp_path, bag, monkeypatch):
    disk = Disk(monkeypatch, tmp_path)
    write_strings(bag, 3)
    for early in True, False:
        kept = {file.name: disk.after_a_power_cut(file, tmp_path, early) for file in bag.iterdir()}
        assert kept == contents(bag)


def test_what_is_no_bag_is_kept_beside_the_bag_that_takes_its_place(tmp_path, bag):
    (tmp_path / 'file').write_text('precious')
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'folder' / 'precious').touch()
    (bag / 'precious.txt').touch()
    before = {name: contents(tmp_path / name) for name in ('folder', 'bag')}
    for name in ('file', 'folder', 'bag', 'folder'):
        write_strings(tmp_path / name)
        assert contents(tmp_path / name).keys() == {'metadata.yaml', f'{name}.mcap'}
    kept = {name: list(tmp_path.glob(f'{name}.*')) for name in ('file', 'folder', 'bag')}
    # The bag that the second one replaced in `folder` was written by this program: it is gone.
    assert [len(names) for names in kept.values()] == [1, 1, 1]
    assert kept['file'][0].read_text() == 'precious'
    assert {name: contents(kept[name][0]) for name in before} == before
    assert len(list(tmp_path.iterdir())) == 6


def test_what_a_link_leads_to_is_replaced(tmp_path, bag):
    link = tmp_path / 'link'
    link.symlink_to(bag.name)
    write_strings(link, 2)
    assert link.is_symlink() and len(list(read_messages(bag))) == 3
    assert {p.name for p in tmp_path.iterdir()} == {'link', 'bag'}
