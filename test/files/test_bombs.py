# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Small files that ask for gigabytes, or hours: refused in one line, in moments."""

import re
import sqlite3
import struct
import subprocess
import sys
import time
from contextlib import closing

import lz4.frame
import pytest
import zstandard
from command import run
from mcap.writer import CompressionType, IndexType, Writer

import l1slam_ros as l1

# [bytes] The most that a chunk, a message or a packed file may be.
MOST_AT_ONCE = 2**28
_MAGIC = b'\x89MCAP0\r\n'
_ZEROS = bytes(2**24)
_ODOM = ('/odom', 'nav_msgs/msg/Odometry')


def _packed(size, name):
    """Return so many zeros, packed."""
    stream = (zstandard.ZstdCompressor().compressobj() if name == 'zstd'
              else lz4.frame.LZ4FrameCompressor())
    parts = [stream.begin()] if name == 'lz4' else []
    parts += [stream.compress(_ZEROS) for _ in range(size // len(_ZEROS))]
    return b''.join((*parts, stream.flush()))


def _record(opcode, content):
    return struct.pack('<BQ', opcode, len(content)) + content


def _text(words):
    return struct.pack('<I', len(words)) + words.encode()


def _unindexed(path, name, stated, packed):
    """Write an MCAP file of one chunk that states a size, without an index."""
    chunk = struct.pack('<QQQI', 1, 2, stated, 0) + _text(name) + struct.pack(
        '<Q', len(packed)) + packed
    path.write_bytes(_MAGIC + _record(1, _text('') + _text('')) + _record(6, chunk)
                     + _record(15, bytes(4)) + _record(2, bytes(20)) + _MAGIC)


def assert_refused(capsys, bag, said):
    """Check that a bag is refused in one line that says why."""
    with pytest.raises(l1.L1SlamError, match=said):
        l1.read_graph(bag)
    err = run(capsys, 'info', bag, code=2)[1]
    assert re.search(said, err) and err.count('\n') == 1


@pytest.mark.parametrize('name', ['zstd', 'lz4'])
@pytest.mark.parametrize('stated', [3 * MOST_AT_ONCE // 2, 1000], ids=['true', 'lying'])
def test_a_chunk_that_unpacks_to_gigabytes_is_refused(capsys, tmp_path, name, stated):
    bag = tmp_path / 'bomb.mcap'
    _unindexed(bag, name, stated, _packed(3 * MOST_AT_ONCE // 2, name))
    assert_refused(capsys, bag, r'bomb\.mcap: .* expected at most 256 MiB')


def test_an_indexed_chunk_that_unpacks_to_gigabytes_is_refused(capsys, tmp_path):
    bag = tmp_path / 'bomb.mcap'
    with bag.open('wb') as stream:
        writer = Writer(stream, chunk_size=2 * MOST_AT_ONCE, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema(_ODOM[1], 'ros2msg', b'')
        channel = writer.register_channel(_ODOM[0], 'cdr', schema)
        for k in range(MOST_AT_ONCE // len(_ZEROS) + 1):
            writer.add_message(channel, k, _ZEROS, k)
        writer.finish()
    assert bag.stat().st_size < 2**18
    assert_refused(capsys, bag, 'a chunk of 272 MiB; expected at most 256 MiB')


MESSAGES = 'CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data)'
ENDLESS = ('WITH RECURSIVE more(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM more) SELECT '
           '{} FROM more')


def _database(path, *statements):
    with closing(sqlite3.connect(path)) as database:
        for statement in (
                'CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type, serialization_format, '
                'offered_qos_profiles)',
                f"INSERT INTO topics VALUES (1, '{_ODOM[0]}', '{_ODOM[1]}', 'cdr', '')",
                *statements):
            database.execute(statement)
        database.commit()


@pytest.mark.parametrize(('statements', 'said'), [
    (['CREATE VIEW messages AS ' + ENDLESS.format(
        "id, 1 AS topic_id, id AS timestamp, x'00' AS data")],
     r'messages is a view; expected a table of rosbag2'),
    ([MESSAGES, 'CREATE VIEW schema AS ' + ENDLESS.format('max(id) AS schema_version')],
     'schema is a view'),
    *(([MESSAGES.replace('data', column), 'INSERT INTO messages VALUES (1, 1, 1)'],
       'messages is computed') for column in (
        'data AS (zeroblob(900000000))', 'data BLOB AS\t(zeroblob(9)) STORED',
        '"data" BLOB GENERATED ALWAYS AS(zeroblob(900000000)) VIRTUAL')),
    ([MESSAGES, f'INSERT INTO messages VALUES (1, 1, 1, zeroblob({MOST_AT_ONCE + 1}))'],
     'a message of 256 MiB')])
def test_a_database_that_computes_without_end_is_refused(capsys, tmp_path, statements, said):
    bag = tmp_path / 'bomb.db3'
    _database(bag, *statements)
    began = time.process_time()
    assert_refused(capsys, bag, said)
    assert time.process_time() - began < 2


def test_the_name_of_a_topic_has_an_end(tmp_path, capsys):
    bags = [tmp_path / name for name in ('indexed.mcap', 'plain.mcap', 'bomb.db3')]
    index = {'index_types': IndexType.NONE, 'use_statistics': False, 'repeat_channels': False,
             'use_summary_offsets': False}
    for bag, options in zip(bags[:2], ({}, index), strict=True):
        with bag.open('wb') as stream:
            writer = Writer(stream, compression=CompressionType.ZSTD, **options)
            writer.start('ros2')
            channel = writer.register_channel('/a' * 10**6, 'cdr', writer.register_schema(
                _ODOM[1], 'ros2msg', b''))
            writer.add_message(channel, 1, b'', 1)
            writer.finish()
    _database(bags[2], MESSAGES, "UPDATE topics SET name = '/' || hex(zeroblob(1000000))",
              "INSERT INTO messages VALUES (1, 1, 1, x'00')")
    for bag in bags:
        said = run(capsys, 'info', bag, code=2)[1]
        assert 'characters; expected at most 1,024' in said and len(said) < 500


@pytest.mark.parametrize('text', ['[' * 10000, '- ' * 10000 + 'x', '? ' * 5000 + 'x'],
                         ids=['brackets', 'lists', 'keys'])
def test_nested_yaml_is_refused_at_once(capsys, tmp_path, text):
    bag, params, graph = (tmp_path / name for name in ('bag', 'params.yaml', 'a.g2o'))
    bag.mkdir()
    (bag / 'metadata.yaml').write_text(text)
    (bag / 'bag_0.mcap').write_bytes(_MAGIC)
    params.write_text(text)
    began = time.process_time()
    assert_refused(capsys, bag, r'YAML of .* deep; expected')
    graph.write_text('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1')
    said = run(capsys, 'info', graph, '--params-file', params, code=2)[1]
    assert str(params) in said and re.search(r'YAML of .* deep; expected', said)
    assert time.process_time() - began < 2


def test_a_compressed_file_that_unpacks_to_gigabytes_is_refused(capsys, tmp_path):
    bag = tmp_path / 'bag'
    bag.mkdir()
    (bag / 'bag_0.mcap.zstd').write_bytes(_packed(3 * MOST_AT_ONCE // 2, 'zstd'))
    (bag / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information: {version: 5, compression_mode: FILE, compression_format: '
        'zstd, relative_file_paths: [bag_0.mcap.zstd]}')
    assert_refused(capsys, bag, r'bag_0\.mcap\.zstd unpacks to more than')


def test_a_line_of_gigabytes_is_refused_before_it_is_read(tmp_path):
    graph, comment = tmp_path / 'bomb.g2o', '# ' + 'x' * 60000
    # Lines across blocks are read whole.
    graph.write_text('\n'.join(
        comment if k % 3 else f'EDGE_SE2 {k} {k + 3} 1 0 0 1 0 0 1 0 1' for k in range(87)))
    assert l1.read_graph(graph)[0].n_poses == 30
    with graph.open('wb') as file:
        file.write(b'VERTEX_SE2 0 0 0 0\n# ')
        file.truncate(2**30)  # zeros that take no room on the disk
    began = time.process_time()
    with pytest.raises(l1.L1SlamError, match=r'bomb\.g2o:2: a line of more than 65,536 bytes'):
        l1.read_graph(graph)
    with graph.open('r+b') as file:
        file.truncate(2**33)
    with pytest.raises(l1.L1SlamError, match='expected a text file of at most'):
        l1.read_graph(graph)
    assert time.process_time() - began < 2


def test_a_bomb_costs_the_command_no_memory(tmp_path):
    bag = tmp_path / 'bomb.mcap'
    _unindexed(bag, 'zstd', 1000, _packed(2**31, 'zstd'))
    # What `resource` says of a child has the parent's memory in it.
    code = ('import sys; from l1slam_ros.cli.main import main; code = main(sys.argv[1:]); '
            'print(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]); '
            'sys.exit(code)')
    done = subprocess.run([sys.executable, '-c', code, 'info', str(bag)], capture_output=True,
                          text=True, timeout=60)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert int(done.stdout.split()[-1]) < 900 * 1024
