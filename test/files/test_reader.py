# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What is in a bag is listed; what is no bag is named."""

import pytest
from command import run
from mcap.writer import Writer as McapWriter
from records import error_of
from rosbags.rosbag2 import StoragePlugin, Writer
from worlds import simulated_bag

import l1slam_ros as l1
from bags import STRING, TYPES


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return simulated_bag(tmp_path_factory.mktemp('world') / 'bag', 5, 5)


def test_an_empty_bag(capsys, tmp_path):
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        writer.add_connection('/a', STRING, typestore=TYPES)
    with (tmp_path / 'a.mcap').open('wb') as stream:
        writer = McapWriter(stream)
        writer.start('ros2')
        writer.register_channel('/a', 'cdr', writer.register_schema(STRING, 'ros2msg', b''))
        writer.finish()
    for path in tmp_path / 'bag', tmp_path / 'a.mcap':
        out, err = run(capsys, 'info', path, code=2)
        assert 'duration    0.0 s from 0.000000000\nnote        none of l1slam' in out
        assert f'topic       /a: 0 of {STRING}\n' in out
        assert err == f'l1slam: {path}: 0 keyframes from /odom; expected 2 or more\n'


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
