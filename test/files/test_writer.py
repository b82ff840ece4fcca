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

import numpy as np
import pytest
import yaml
from disk import Disk
from mcap.reader import NonSeekingReader, make_reader
from mcap.stream_reader import StreamReader
from records import read
from worlds import made, simulated_bag, write_g2o

import l1slam_ros as l1

NOTE = '{covariance: increment, keyframes: every}'
QOS_KEYS = {'history', 'depth', 'reliability', 'durability', 'deadline', 'lifespan', 'liveliness',
            'liveliness_lease_duration', 'avoid_ros_namespace_conventions'}


@pytest.fixture(scope='module')
def large(tmp_path_factory):
    """Return a bag of 500 poses and 201 loops."""
    return simulated_bag(tmp_path_factory.mktemp('large') / 'bag', 500, 700)


@pytest.fixture(scope='module')
def write(tmp_path_factory):
    """Return a function that writes the bag of 2, 3 or 5 keyframes in a row."""
    records, folder = {}, tmp_path_factory.mktemp('source')
    for count in 2, 3, 5:  # before any disk fails
        k = np.arange(count - 1)
        records[count] = read(write_g2o(
            folder / 'a.g2o', np.stack((k, k + 1), axis=1), np.tile([1.0, 0, 0], (len(k), 1)),
            np.tile(np.eye(3), (len(k), 1, 1))))

    def written(path, count=5, **options):
        records[count].write(path, **options)
        return path
    return written


@pytest.fixture
def bag(tmp_path, write):
    return write(tmp_path / 'bag')


def count(path):
    """Return how many messages of odometry a bag has."""
    with (path / 'bag.mcap').open('rb') as file:
        return len(list(make_reader(file).iter_messages('/odom')))


def records_of(path):
    with path.open('rb') as file:
        return list(StreamReader(file, emit_chunks=True, validate_crcs=True).records)


def test_the_file_is_what_rosbag2_and_mcap_tools_want(large):
    path = large / 'bag.mcap'
    with path.open('rb') as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        assert len(list(reader.iter_messages())) == 701
    assert summary.statistics.message_count == 701
    assert summary.statistics.channel_message_counts == {1: 500, 2: 201}
    assert len(summary.chunk_indexes) > 3
    assert all(chunk.message_index_offsets for chunk in summary.chunk_indexes)
    assert {chunk.compression for chunk in summary.chunk_indexes} == {'zstd'}
    records, whole = records_of(path), path.read_bytes()
    chunks = [record for record in records if type(record).__name__ == 'Chunk']
    assert all(chunk.uncompressed_crc for chunk in chunks)
    assert max(chunk.uncompressed_size for chunk in chunks) < 20_000
    # By the format: of the summary, and of the footer up to the checksum itself.
    assert records[-1].summary_crc == zlib.crc32(whole[records[-1].summary_start:-8 - 4])
    document = yaml.safe_load((path.parent / 'metadata.yaml').read_text())
    inside = yaml.safe_load(metadata['rosbag2']['serialized_metadata'])
    assert inside == document['rosbag2_bagfile_information']
    assert (inside['version'], inside['storage_identifier']) == (9, 'mcap')
    assert inside['relative_file_paths'] == ['bag.mcap']
    assert yaml.safe_load(inside['custom_data']['l1slam']) == yaml.safe_load(NOTE)
    assert (inside['message_count'], inside['duration']['nanoseconds']) == (701, 49_900_000_000)
    channels = {channel.topic: channel for channel in summary.channels.values()}
    types = {'/odom': (500, 'nav_msgs/msg/Odometry'),
             '/loop_closures': (201, 'geometry_msgs/msg/PoseWithCovarianceStamped')}
    for topic in inside['topics_with_message_count']:
        of = topic['topic_metadata']
        assert (topic['message_count'], of['type']) == types[of['name']]
        assert of['serialization_format'] == 'cdr'
        qos, = of['offered_qos_profiles']
        assert qos.keys() == QOS_KEYS
        assert (qos['history'], qos['depth']) == ('keep_last', 1000)
        assert (qos['reliability'], qos['durability']) == ('reliable', 'volatile')
        channel = channels.pop(of['name'])
        assert channel.message_encoding == 'cdr'
        assert summary.schemas[channel.schema_id].encoding == 'ros2msg'
        assert yaml.safe_load(channel.metadata['offered_qos_profiles']) == [qos]
        assert channel.metadata['topic_type_hash'] == of['type_description_hash']
    assert not channels and '&' not in (path.parent / 'metadata.yaml').read_text()


def test_the_note_comes_before_the_messages_it_is_about(bag):
    header, note, *_ = records_of(bag / 'bag.mcap')
    assert (header.profile, note.name) == ('ros2', 'l1slam')
    assert note.metadata == yaml.safe_load(NOTE)
    with (bag / 'bag.mcap').open('rb') as file:  # a stream of it is enough
        topics = [channel.topic for _, channel, _ in NonSeekingReader(file).iter_messages()]
    assert topics == ['/odom'] * 5


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
    document = yaml.safe_load((made(tmp_path / 'bag', 5, 5) / 'metadata.yaml').read_text())
    topics = document['rosbag2_bagfile_information']['topics_with_message_count']
    assert expected in [topic['topic_metadata']['type_description_hash'] for topic in topics
                        if topic['topic_metadata']['type'] == msgtype]


def contents(bag):
    return {file.name: file.read_bytes() for file in bag.iterdir()}


# Both files, then their folder; the two renamings, then the folder around it.
CALLS = ['open', 'open', 'fsync', 'fsync', 'fsync', 'rename', 'rename', 'fsync']


@pytest.mark.parametrize('is_old', [True, False])
@pytest.mark.parametrize('failing', range(len(CALLS) + 1))
def test_a_disk_that_fails_leaves_the_old_bag_or_the_new_one(
        tmp_path, write, monkeypatch, failing, is_old):
    """And where there was none, none or the new one."""
    bag = write(tmp_path / 'bag') if is_old else tmp_path / 'bag'
    old = contents(bag) if is_old else None
    disk = Disk(monkeypatch, tmp_path, failing)
    try:
        write(bag, 3)
    except l1.L1SlamError as error:
        assert 'cannot be written: Input/output error' in str(error)
        assert (contents(bag) if bag.exists() else None) == old
    else:
        assert count(bag) == 3
        # That a folder cannot be synced is no reason to fail.
        assert failing in ((4, 7, 8) if is_old else (4, 6, 7, 8))
    if is_old:
        assert disk.calls[:failing + 1] == CALLS[:failing + 1]
    assert list(tmp_path.iterdir()) == ([bag] if bag.exists() else [])


def test_a_power_cut_after_a_bag_is_written_takes_none_of_it(tmp_path, bag, write, monkeypatch):
    disk = Disk(monkeypatch, tmp_path)
    write(bag, 3)
    for early in True, False:
        kept = {file.name: disk.after_a_power_cut(file, tmp_path, early) for file in bag.iterdir()}
        assert kept == contents(bag)


def test_what_is_no_bag_is_kept_beside_the_bag_that_takes_its_place(tmp_path, bag, write):
    (tmp_path / 'file').write_text('precious')
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'folder' / 'precious').touch()
    (bag / 'precious.txt').touch()
    before = {name: contents(tmp_path / name) for name in ('folder', 'bag')}
    for name in ('file', 'folder', 'bag', 'folder'):
        write(tmp_path / name, force=True)
        assert contents(tmp_path / name).keys() == {'metadata.yaml', f'{name}.mcap'}
    kept = {name: list(tmp_path.glob(f'{name}.*')) for name in ('file', 'folder', 'bag')}
    # The bag that the second one replaced in `folder` was written by this program: it is gone.
    assert [len(names) for names in kept.values()] == [1, 1, 1]
    assert kept['file'][0].read_text() == 'precious'
    assert {name: contents(kept[name][0]) for name in before} == before
    assert len(list(tmp_path.iterdir())) == 6


def test_what_a_link_leads_to_is_replaced(tmp_path, bag, write):
    link = tmp_path / 'link'
    link.symlink_to(bag.name)
    write(link, 2)
    assert link.is_symlink() and count(bag) == 2
    assert {p.name for p in tmp_path.iterdir()} == {'link', 'bag'}
