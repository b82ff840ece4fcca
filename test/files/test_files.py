# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Files are written whole or not at all; lines and numbers of text are read exactly."""

import stat

import numpy as np
import pytest
from disk import Disk
from records import error_of, read

import l1slam_ros as l1

UNIT = '1 0 0 1 0 1'


@pytest.fixture
def write(tmp_path_factory):
    """Return a function that writes one file, the poses of a graph: to a path, with an x."""
    source = tmp_path_factory.mktemp('source') / 'a.g2o'
    source.write_text(f'EDGE_SE2 0 1 1 0 0 {UNIT}\n')
    graph, _ = l1.read_graph(source)

    def poses(path, x):
        l1.write_graph(path, graph, np.array([[0, 0, 0], [x, 0, 0]]))
    return poses


def x_of(content):
    """Return the x of the second pose of a file."""
    return float(content.split()[-7])


@pytest.mark.parametrize('failing', range(5))
def test_a_disk_that_fails_leaves_the_old_file_or_the_new_one(
        tmp_path, write, monkeypatch, failing):
    path = tmp_path / 'a.tum'
    write(path, 1)
    disk = Disk(monkeypatch, tmp_path, failing)
    # File opened, synced, renamed; that the folder cannot be synced is no reason to fail.
    if failing < 3:
        with pytest.raises(l1.L1SlamError, match='cannot be written: Input/output error'):
            write(path, 2)
    else:
        write(path, 2)
    assert disk.calls[:4] == ['open', 'fsync', 'replace', 'fsync'][:failing + 1]
    assert x_of(path.read_bytes()) == (1 if failing < 3 else 2)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize('early', [True, False])
def test_a_power_cut_leaves_the_old_file_or_the_new_one(tmp_path, write, monkeypatch, early):
    path, found = tmp_path / 'a.tum', []
    write(path, 1)
    old = path.read_bytes()
    disk = Disk(monkeypatch, tmp_path,
                seen=lambda: found.append(disk.after_a_power_cut(path, tmp_path, early)))
    write(path, 2)
    assert set(found) == {old, path.read_bytes()} and x_of(found[-1]) == 2


def test_what_a_link_leads_to_is_written(tmp_path, write):
    (tmp_path / 'folder').mkdir()
    path, link = tmp_path / 'folder' / 'a.tum', tmp_path / 'link.tum'
    link.symlink_to('folder/a.tum')
    for x in 1, 2:
        write(link, x)
        assert link.is_symlink() and x_of(path.read_bytes()) == x
    assert {p.name for p in tmp_path.rglob('*')} == {'folder', 'a.tum', 'link.tum'}


def test_others_may_read_what_is_written(tmp_path, write):
    ordinary = tmp_path / 'ordinary'
    ordinary.touch()
    write(tmp_path / 'a.tum', 1)
    assert stat.S_IMODE((tmp_path / 'a.tum').stat().st_mode) == stat.S_IMODE(
        ordinary.stat().st_mode)


@pytest.mark.parametrize('name', ['missing/a.tum', 'folder.tum', 'file/a.tum'])
def test_what_cannot_be_written_is_named(tmp_path, write, name):
    (tmp_path / 'folder.tum').mkdir()
    (tmp_path / 'file').touch()
    with pytest.raises(l1.L1SlamError, match=f'{tmp_path / name}: cannot be written: '):
        write(tmp_path / name, 1)
    assert {p.name for p in tmp_path.rglob('*')} == {'folder.tum', 'file'}


def test_comments_and_blank_lines_are_left_out_and_still_counted(tmp_path):
    path = tmp_path / 'a.g2o'
    content = (b'\xef\xbb\xbf# made by\r\n\r\n  \t\r\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\r\n'
               b'  # b 2\r\nEDGE_SE2 1 2 2 0 0 1 0 0 1 0 ')
    path.write_bytes(content + b'1')
    record = read(path)
    assert record.skipped == ()
    assert record.graph.between.measurement[:, 0].tolist() == [1, 2]
    for number, line in ((4, b'0 1 1'), (6, b'1 2 2')):
        path.write_bytes((content + b'1').replace(line, line + b'x'))
        assert error_of(l1.read_graph, path).startswith(f'{path}:{number}: ')


@pytest.mark.parametrize(('value', 'decimal'), [
    (50.00000000000001, 50.0), (0.30000000000000004, 0.3), (1e-8 + 1e-24, 1e-8),
    (3000.0000000000005, 3e3), (50.0, 50.0), (0.1, 0.1), (1 / 3, None),
    (0.1234567890123456, None)])
def test_rounding_is_undone_where_it_can_be(tmp_path, value, decimal):
    """What is stored is a square root of the information; what is off its diagonal has a sign."""
    path, again = tmp_path / 'a.g2o', tmp_path / 'b.g2o'
    path.write_text(f'EDGE_SE2 0 1 1 0 0 {value!r} {-value / 2!r} 0 {value!r} 0 1\n')
    read(path).write(again)
    line, = (line for line in again.read_text().splitlines() if line.startswith('EDGE'))
    found = [float(line.split()[k]) for k in (6, 7, 9)]
    if decimal:
        assert found == [decimal, -decimal / 2, decimal]
    else:  # what has more digits keeps them
        assert found == pytest.approx([value, -value / 2, value], rel=1e-15)
