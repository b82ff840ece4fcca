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
from records import error_of
from worlds import simulated_bag

import l1slam_ros as l1


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return simulated_bag(tmp_path_factory.mktemp('world') / 'bag', 5, 5)


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
