# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Text files: whole or not at all, numbers in bulk, the guilty line named."""

import stat

import numpy as np
import pytest
from disk import Disk

from l1slam_ros.core.errors import FileError
from l1slam_ros.io.files import (
    first_failure,
    read_lines,
    rounded,
    stamp_from_text,
    stamp_text,
    write_lines,
)


def test_a_failing_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / 'a.txt'
    write_lines(path, ['old'])

    def lines():
        yield 'new'
        raise RuntimeError('half way')

    with pytest.raises(RuntimeError):
        write_lines(path, lines())
    assert path.read_text() == 'old\n'
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize('failing', range(5))
def test_a_disk_that_fails_leaves_the_old_file_or_the_new_one(tmp_path, monkeypatch, failing):
    path = tmp_path / 'a.txt'
    write_lines(path, ['old'])
    disk = Disk(monkeypatch, tmp_path, failing)
    # File opened, synced, renamed; that the folder cannot be synced is no reason to fail.
    if failing < 3:
        with pytest.raises(FileError, match='cannot be written: Input/output error'):
            write_lines(path, ['new'])
    else:
        write_lines(path, ['new'])
    assert disk.calls[:4] == ['open', 'fsync', 'replace', 'fsync'][:failing + 1]
    assert path.read_text() == ('old\n' if failing < 3 else 'new\n')
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize('early', [True, False])
def test_a_power_cut_leaves_the_old_file_or_the_new_one(tmp_path, monkeypatch, early):
    path, found = tmp_path / 'a.txt', []
    write_lines(path, ['old'])
    disk = Disk(monkeypatch, tmp_path,
                seen=lambda: found.append(disk.after_a_power_cut(path, tmp_path, early)))
    write_lines(path, ['new'])
    assert set(found) == {b'old\n', b'new\n'} and found[-1] == b'new\n'


def test_what_a_link_leads_to_is_written(tmp_path):
    (tmp_path / 'folder').mkdir()
    path, link = tmp_path / 'folder' / 'a.txt', tmp_path / 'link.txt'
    link.symlink_to('folder/a.txt')
    for text in 'old', 'new':
        write_lines(link, [text])
        assert link.is_symlink() and path.read_text() == f'{text}\n'
    assert {p.name for p in tmp_path.rglob('*')} == {'folder', 'a.txt', 'link.txt'}


def test_others_may_read_what_is_written(tmp_path):
    ordinary = tmp_path / 'ordinary'
    ordinary.touch()
    write_lines(tmp_path / 'a.txt', ['x'])
    assert stat.S_IMODE((tmp_path / 'a.txt').stat().st_mode) == stat.S_IMODE(
        ordinary.stat().st_mode)


@pytest.mark.parametrize('name', ['missing/a.txt', 'folder', 'file/a.txt'])
def test_what_cannot_be_written_is_named(tmp_path, name):
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'file').touch()
    with pytest.raises(FileError, match=f'{tmp_path / name}: cannot be written: '):
        write_lines(tmp_path / name, ['x'])
    assert {p.name for p in tmp_path.rglob('*')} == {'folder', 'file'}


def test_comments_and_blank_lines_are_left_out_and_still_counted(tmp_path):
    path = tmp_path / 'a.txt'
    path.write_bytes(b'\xef\xbb\xbf# made by\r\n\r\n  \t\r\na 1\r\n  # b 2\r\nc 3')
    lines = read_lines(path)
    assert lines.numbers == [4, 6]
    assert [text.split() for text in lines.texts] == [['a', '1'], ['c', '3']]


@pytest.mark.parametrize(('value', 'decimal'), [
    (50.00000000000001, 50.0), (0.30000000000000004, 0.3), (1e-8 + 1e-24, 1e-8), (0.0, 0.0),
    (-3000.0000000000005, -3e3), (1 / 3, 1 / 3), (0.1234567890123456, 0.1234567890123456)])
def test_rounding_is_undone_where_it_can_be(value, decimal):
    assert rounded(np.array([value])).tolist() == [decimal]


@pytest.mark.parametrize('bad', [{0}, {9}, {3, 4, 9}, {8, 9}])
def test_bisection_finds_the_first_failure(bad):
    assert first_failure(10, lambda part: not bad & set(range(10)[part])) == min(bad)


@pytest.mark.parametrize('stamp', [0, 1, 10**9, 1305031102175300121, 2**63 - 1])
def test_stamps_keep_their_last_nanosecond(stamp):
    if stamp < 9223372036 * 10**9:
        assert stamp_from_text(stamp_text(stamp)) == stamp
    whole, decimals = stamp_text(stamp).split('.')
    assert len(decimals) == 9
    assert int(whole) * 10**9 + int(decimals) == stamp
    assert stamp_text(np.int64(stamp)) == stamp_text(stamp)


@pytest.mark.parametrize(('text', 'stamp'),
                         [('12', 12 * 10**9), ('12.5', 12500000000),
                          ('1.305031102175300121e+09', 1305031102175300121), ('0.0000000004', 0)])
def test_stamps_of_other_tools(text, stamp):
    assert stamp_from_text(text) == stamp


@pytest.mark.parametrize('text', ['', 'x', 'nan', 'inf', '-1', '1e30', '1e999999999', '1.2.3'])
def test_what_is_no_stamp(text):
    with pytest.raises(ValueError):
        stamp_from_text(text)
