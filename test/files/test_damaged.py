# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Damaged bags: all before the damage is used, it is said, nothing else is lost or made up."""

import re
import shutil
import sqlite3
import struct
from contextlib import closing, suppress
from io import BytesIO

import numpy as np
import pytest
from command import run
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType
from records import error_of, read
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from worlds import simulated_bag

import l1slam_ros as l1
from bags import (
    NOTE,
    NOTED,
    mcap_file,
    recording_of,
    ros1_file,
    rosbag2_directory,
    split_directory,
    write_mcap,
)
from l1slam_ros.cli.main import main

SIZE = 200


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Return a bag of this package: 200 odometry messages, 101 loops."""
    return simulated_bag(tmp_path_factory.mktemp('world') / 'bag', SIZE, 300)


@pytest.fixture(scope='module')
def recording(bag):
    return recording_of(bag)


def factors_of(graph):
    """Return the factors of odometry and of loops, each its keyframes and what is measured."""
    rows = graph.between.is_odometry
    both = np.hstack((graph.between.pairs, graph.between.measurement))
    return both[rows].tolist(), both[~rows].tolist()


@pytest.fixture(scope='module')
def whole(bag):
    """Return the factors of the whole bag."""
    return factors_of(l1.read_graph(bag)[0])


def damage_in(sentences):
    """Return what is said of damage."""
    said = [sentence for sentence in sentences if ' damaged' in sentence]
    assert len(said) <= 1 and not any('\n' in sentence for sentence in said)
    return ''.join(said)


@pytest.fixture
def read_part(recording, whole):
    """
    Return a function from a bag to how many messages of it are used, and what is said of damage.

    These must be the first ones of the recording, but for so many of the last.
    """
    def used(path, but=0):
        record = read(path)
        said, count = damage_in(record.skipped), len(recording)
        if said:
            count = int(re.search('; ([0-9,]+) messages ', said)[1].replace(',', ''))
        poses = sum(message[0] == '/odom' for message in recording[:count - but])
        steps, loops = factors_of(record.graph)
        for found, first, n in ((steps, whole[0], poses - 1),
                                (loops, whole[1], count - but - poses)):
            assert found[:n] == first[:n] and 0 <= len(found) - n <= but
        return count, said
    return used


def same(path, messages):
    """Check that a bag makes the graph of other messages; return what is said of damage."""
    found = read(path)
    expected = read(mcap_file(path.with_name('expected.mcap'), messages, note=NOTED))
    assert factors_of(found.graph) == factors_of(expected.graph)
    return damage_in(found.skipped)


def assert_told(said, path, used):
    assert re.fullmatch(rf'{re.escape(str(path))} is damaged(:| after) .*[^;]; '
                        rf'{used:,} messages before that were used', said), said


# What the file holds up to a byte, by independent means: kind -> the file's bytes, and where it
# ends after each message of the recording, in the order of writing.
def unchunked(folder, recording):
    stream, ends = BytesIO(), []
    write_mcap(stream, recording, ends, note=NOTED, use_chunking=False)
    return 'a.mcap', stream.getvalue(), ends


def uncompressed(folder, recording):
    whole = mcap_file(folder / 'a.mcap', recording, note=NOTED, compression=CompressionType.NONE,
                      chunk_size=100_000).read_bytes()
    ends, at = [], 0
    for *_, data in recording:
        at = whole.index(data, at) + len(data)
        ends.append(at)
    return 'a.mcap', whole, ends


def database(folder, recording, page=4096):
    """SQLite reads whole pages."""
    path = rosbag2_directory(folder / 'a', recording, StoragePlugin.SQLITE3) / 'a.db3'
    with closing(sqlite3.connect(path)) as opened:
        opened.execute(f'PRAGMA page_size = {page}')
        opened.execute('VACUUM')
    whole = path.read_bytes()
    return 'a.db3', whole, [(whole.index(data) // page + 1) * page for *_, data in recording]


def large_pages(folder, recording):
    return database(folder, recording, 65536)


@pytest.mark.parametrize('kind', [unchunked, uncompressed, database, large_pages])
def test_every_message_before_a_cut_is_used_and_no_other(
        tmp_path, read_part, recording, kind, rng):
    recording = recording[:100]
    name, whole, ends = kind(tmp_path, recording)
    assert len(ends) == len(recording) and sorted(ends) == ends
    path = tmp_path / f'cut_{name}'
    for cut in [*rng.integers(0, len(whole), 12), len(whole) - 10]:
        path.write_bytes(whole[:cut])
        expected = int(np.searchsorted(ends, cut, 'right'))
        try:
            found, said = read_part(path)
        except l1.L1SlamError as error:  # of one keyframe there is no graph
            assert expected < 3 and '\n' not in str(error)
            continue
        assert found == expected
        assert_told(said, path, expected)
        assert f': it breaks off after {cut:,} bytes; ' in said
    with pytest.warns(UserWarning, match=' is damaged: it breaks off after '):  # in Python
        l1.read_graph(path)


@pytest.mark.parametrize('compression', ['NONE', 'ZSTD', 'LZ4'])
def test_of_a_chunk_cut_in_two_the_first_part_is_used(tmp_path, read_part, recording, compression):
    # One chunk for all: a decoder works block by block.
    path = mcap_file(tmp_path / 'a.mcap', recording, note=NOTED,
                     compression=CompressionType[compression], chunk_size=2**30)
    whole = path.read_bytes()
    chunk, = make_reader(BytesIO(whole)).get_summary().chunk_indexes
    path.write_bytes(whole[:chunk.chunk_start_offset + int(0.9 * chunk.chunk_length)])
    found, said = read_part(path)
    assert len(recording) // 3 < found < len(recording)
    assert_told(said, path, found)


def test_wherever_a_bit_of_our_bag_is_wrong_no_message_is(
        tmp_path, read_part, bag, recording, rng):
    whole = (bag / 'bag.mcap').read_bytes()
    path = tmp_path / 'a.mcap'
    told = 0
    for at in rng.integers(0, len(whole), 24):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        with suppress(l1.L1SlamError):
            found, said = read_part(path)
            assert said or found == len(recording)
            told += bool(said)
    assert told > 6


def test_a_record_that_swallows_the_rest_of_a_chunk_is_damage(tmp_path, read_part, recording):
    path = mcap_file(tmp_path / 'a.mcap', recording, note=NOTED, compression=CompressionType.NONE,
                     enable_crcs=False)
    whole, k = bytearray(path.read_bytes()), len(recording) // 2
    head = whole.index(recording[k][3]) - 22 - 9  # of the message and of its record
    whole[head:head + 9] = struct.pack('<BQ', 200, 2**40)
    path.write_bytes(whole)
    found, said = read_part(path)
    assert found == k
    assert re.search(rf' is damaged after .*; {k:,} messages before that were used', said)


def test_zeros_at_the_end_are_damage(tmp_path, read_part, recording):
    for options in ({'use_chunking': False}, {'compression': CompressionType.NONE}):
        path = mcap_file(tmp_path / 'a.mcap', recording, note=NOTED, **options)
        whole = path.read_bytes()
        path.write_bytes(whole[:len(whole) // 2] + bytes(len(whole) // 2))
        # The last one may have zeros in it: nothing in such a file tells.
        found, said = read_part(path, but=1)
        assert abs(found - len(recording) // 2) < 20
        assert re.search(r' is damaged after [0-9,]+ of [0-9,]+ bytes; ', said)


def test_a_directory_without_its_metadata(tmp_path, capsys, read_part, bag, recording):
    folder = shutil.copytree(bag, tmp_path / 'a')
    for content in (None, '', 'x', '[', 'rosbag2_bagfile_information:\n  version: 9\n', '\x00'):
        (folder / 'metadata.yaml').unlink(missing_ok=True)
        if content is not None:
            (folder / 'metadata.yaml').write_text(content)
        wrong = 'is missing' if content is None else 'cannot be read'
        found, said = read_part(folder)
        assert found == len(recording)
        assert said == (f'{folder} is damaged: its metadata.yaml {wrong}; '
                        '301 messages of its files were used')
    listed = run(capsys, 'info', folder, code=3)[0].splitlines()
    assert listed[1] == 'note        covariance increment, keyframes every'
    assert [line.split(' of ')[0] for line in listed[2:4]] == [
        'topic       /loop_closures: 101', 'topic       /odom: 200']


@pytest.mark.parametrize('mode', [CompressionMode.NONE, CompressionMode.FILE])
@pytest.mark.parametrize('plugin', StoragePlugin)
def test_a_split_bag_is_used_up_to_the_damage(tmp_path, read_part, recording, plugin, mode):
    folder = split_directory(tmp_path / 'a', recording, plugin, mode, parts=12)
    files = sorted(folder.glob('a_*'), key=lambda file: int(re.findall('[0-9]+', file.name)[0]))
    size = -(-len(recording) // 12)
    whole = files[11].read_bytes()
    files[11].write_bytes(whole[:-4000])
    found, said = read_part(folder)
    assert found >= 11 * size
    assert said.startswith(f'{files[11]} is damaged: ')
    listed = (folder / 'metadata.yaml').read_text()
    (folder / 'metadata.yaml').unlink()
    assert read_part(folder) == (found, said)
    files[10].unlink()
    assert same(folder, recording[:10 * size] + recording[11 * size:found])
    # The last one is whole: what is before and after the missing one is used.
    files[11].write_bytes(whole)
    (folder / 'metadata.yaml').write_text(listed)
    left = recording[:10 * size] + recording[11 * size:]
    assert same(folder, left) == (f'{files[10]} is damaged: the file is missing; '
                                  f'{len(left)} messages before and after that were used')


def coarse(recording):
    """Return a recording with times so coarse that messages of one time are on many pages."""
    return [(topic, msgtype, moment // 10**10 * 10**10, data)
            for topic, msgtype, moment, data in recording]


def test_a_database_with_a_damaged_page(tmp_path, read_part, recording):
    """The library reads up to it; what was read then is not read again."""
    recording = coarse(recording)
    path = rosbag2_directory(tmp_path / 'a', recording, StoragePlugin.SQLITE3) / 'a.db3'
    whole = bytearray(path.read_bytes())
    at = whole.index(recording[250][3]) // 4096 * 4096
    whole[at:at + 200] = b'\xff' * 200
    path.write_bytes(whole)
    found, said = read_part(path)
    assert 240 < found <= 250
    assert said == (f'{path} is damaged: database disk image is malformed; '
                    f'{found} messages before that were used')


def test_a_message_that_cannot_be_decoded_is_left_out(tmp_path, recording):
    broken = list(recording)
    for k in (20, 30):
        broken[k] = (*broken[k][:3], broken[k][3][:40])
    path = mcap_file(tmp_path / 'a.mcap', broken, note=NOTED)
    sound = [m for k, m in enumerate(recording) if k not in (20, 30)]
    assert same(path, sound) == (
        f'{path} is damaged: 2 messages cannot be decoded; 299 others were used')


def test_what_is_no_bag_is_told(capsys, tmp_path, bag):
    (tmp_path / 'a.txt').write_text('x')
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'two').mkdir()
    for name in 'a_0.mcap', 'b_0.mcap':
        (tmp_path / 'two' / name).write_bytes((bag / 'bag.mcap').read_bytes())

    for name, said in (('none', ': no such file or directory; expected a'),
                       ('a.txt', 'unknown kind of file; expected .g2o, '),
                       ('empty', 'without metadata.yaml and with the files of 0 bags'),
                       ('two', 'without metadata.yaml and with the files of 2 bags')):
        assert said in error_of(l1.read_graph, tmp_path / name)
        found = run(capsys, 'info', tmp_path / name, code=2)[1]
        assert said in found and found.count('\n') == 1


@pytest.mark.parametrize('content', [b'', b'x', b'\x89MCAP0\r\n', b'\x00' * 5000])
@pytest.mark.parametrize('suffix', ['.mcap', '.db3'])
def test_a_file_that_is_no_bag(capsys, tmp_path, content, suffix):
    path = tmp_path / f'a{suffix}'
    path.write_bytes(content)
    assert error_of(l1.read_graph, path).startswith(f'{path}: damaged, or not a bag (')
    said = run(capsys, 'info', path, code=2)[1]
    assert said.startswith(f'l1slam: {path}: damaged, or not a bag (') and said.count('\n') == 1


def test_a_ros1_bag_that_is_damaged_is_refused(tmp_path, capsys, recording):
    path = ros1_file(tmp_path / 'a.bag', recording)
    whole = path.read_bytes()
    for damaged in whole[:len(whole) // 2], b'x', whole[:-200] + bytes(200):
        path.write_bytes(damaged)
        for said in error_of(l1.read_graph, path), run(capsys, 'info', path, code=2)[1]:
            assert re.search(r'a\.bag: damaged, or not a bag .*rosbag reindex', said)


# What happens to files: from somewhere on bytes are changed, lost or inserted; the rest is lost.
PIECES = st.tuples(st.floats(0, 1), st.sampled_from([0, 1, 20, 900, 10**9]),
                   st.binary(max_size=40))


def damaged(whole, pieces):
    for where, lost, content in pieces:
        at = int(where * len(whole))
        whole = whole[:at] + content + whole[at + lost:]
    return whole


@pytest.fixture(scope='module')
def small(tmp_path_factory):
    """Return a folder with one small recording as several kinds."""
    folder = tmp_path_factory.mktemp('small')
    simulated_bag(folder / 'bag', 40, 60)
    messages = recording_of(folder / 'bag')
    shutil.copy(folder / 'bag' / 'bag.mcap', folder / 'ours.mcap')
    mcap_file(folder / 'lz4.mcap', messages, compression=CompressionType.LZ4, chunk_size=5_000)
    mcap_file(folder / 'unchunked.mcap', messages, use_chunking=False)
    shutil.copy(rosbag2_directory(folder / 'db3', messages, StoragePlugin.SQLITE3, note=NOTE)
                / 'db3.db3', folder / 'rosbag2.db3')
    ros1_file(folder / 'ros1.bag', messages, Rosbag1Writer.CompressionFormat.BZ2, chunk=5_000)
    return folder


@pytest.mark.parametrize('name', ['ours.mcap', 'lz4.mcap', 'unchunked.mcap', 'rosbag2.db3',
                                  'ros1.bag', 'bag/metadata.yaml'])
@settings(max_examples=25, derandomize=True, deadline=None, database=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(pieces=st.lists(PIECES, min_size=1, max_size=3))
def test_no_bytes_make_a_traceback_or_half_a_file(tmp_path, small, capfd, name, pieces):
    folder = tmp_path / 'input'
    if folder.exists():
        shutil.rmtree(tmp_path / 'input')
    folder.mkdir()
    path = folder / name.rpartition('/')[2]
    if name.endswith('.yaml'):
        shutil.copy(small / 'bag' / 'bag.mcap', folder)
    path.write_bytes(damaged((small / name).read_bytes(), pieces))
    output = tmp_path / 'out.g2o'
    for former in tmp_path.glob('out.*'):
        former.unlink()
    capfd.readouterr()
    source = folder if name.endswith('.yaml') else path
    code = main(['convert', str(source), str(output)])
    err = capfd.readouterr().err
    assert code in (0, 2, 3) and 'Traceback' not in err
    assert all(line.startswith('l1slam: ') for line in err.splitlines())
    assert sorted(p.name for p in tmp_path.iterdir() if p != folder) == (
        [] if code == 2 else ['out.g2o', 'out.g2o.stamps.txt'])
    if code != 2:
        assert l1.read_graph(output)[0].n_poses >= 2
        assert (code == 3) == ('is damaged' in err)
