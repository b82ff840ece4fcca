# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Trajectory files: exact stamps, references of three kinds, malformed lines named."""

import numpy as np
import pytest

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry import se2
from l1slam_ros.io.files import invented_stamps, write_lines
from l1slam_ros.io.trajectory import read_reference, truth_lines, write_tum


def write(tmp_path, text):
    path = tmp_path / 'reference.txt'
    path.write_text(text)
    return path


def test_invented_stamps_are_ten_a_second_from_1000_s():
    assert invented_stamps(3).tolist() == [1000000000000, 1000100000000, 1000200000000]
    assert invented_stamps(3).dtype == np.int64


def test_a_tum_file_has_eight_columns_and_exact_stamps(tmp_path):
    path = tmp_path / 'a.tum'
    stamps = np.array([1305031102175300121, 1305031102175300122])
    write_tum(path, stamps, np.array([[1.25, -2, 0], [0.1, 0.2, np.pi / 2]]), se2)
    mark, *rows = [line.split(' ') for line in path.read_text().splitlines()]
    assert mark[0] == '#', 'to evo and others a comment'
    assert [row[0] for row in rows] == ['1305031102.175300121', '1305031102.175300122']
    np.testing.assert_allclose(
        np.array(rows, float)[:, 1:],
        [[1.25, -2, 0, 0, 0, 0, 1], [0.1, 0.2, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]], rtol=1e-15)
    assert [len(row) for row in rows] == [8, 8]


def test_tum_of_other_tools(tmp_path):
    reference = read_reference(write(
        tmp_path, '# time x y z q\n2.5 1 2 9 0 0 0 -1.002\n1.305e+00 3 4 9 0 0 0.707 0.707\n'))
    assert reference.keys.tolist() == [1305000000, 2500000000]
    np.testing.assert_allclose(reference.poses, [[3, 4, np.pi / 2], [1, 2, 0]], atol=1e-12)


def test_truth_round_trip(tmp_path, rng):
    path, ids = tmp_path / 'truth.txt', np.array([3, 8, 2**62])
    poses = rng.normal(size=(3, 3))
    write_lines(path, truth_lines(ids, poses))
    reference = read_reference(path)
    assert not reference.stamped
    assert (reference.keys == ids).all()
    assert (reference.poses == poses).all()
    assert [len(line.split(' ')) for line in path.read_text().splitlines()] == [4, 4, 4]


def test_the_vertices_of_a_graph_file_are_a_reference(tmp_path):
    path = tmp_path / 'a.g2o'
    path.write_text('# no edges\nVERTEX_SE2 4 1 2 3\nVERTEX_SE2 2 4 5 6\n')
    reference = read_reference(path)
    assert not reference.stamped
    assert reference.keys.tolist() == [2, 4]
    assert reference.poses.tolist() == [[4, 5, 6], [1, 2, 3]]


def test_a_graph_with_stamps_is_a_reference_by_them_where_both_have_some(tmp_path):
    path = tmp_path / 'a.g2o'
    path.write_text('VERTEX_SE2 4 1 2 3\nVERTEX_SE2 2 4 5 6\n')
    (tmp_path / 'a.g2o.stamps.txt').write_text('4 10.5\n2 11\n')
    reference = read_reference(path, by_stamps=True)
    assert reference.stamped and reference.keys.tolist() == [10_500_000_000, 11_000_000_000]
    assert reference.poses.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert not read_reference(path).stamped


@pytest.mark.parametrize('text', [
    '2.5, 3, 4, 0.5\n1.5, 1, 2, 0\n', 'stamp,x,y,theta\n2.5,3,4,.5\n1.5,1,2,0\n',
    f'2.5,3,4,0,0,0,{float(np.sin(.25))!r},{float(np.cos(.25))!r}\n1.5,1,2,0,0,0,0,1\n'])
def test_a_csv_file_has_stamps(tmp_path, text):
    reference = read_reference(write(tmp_path, text))
    assert reference.stamped and reference.keys.tolist() == [1_500_000_000, 2_500_000_000]
    np.testing.assert_allclose(reference.poses, [[1, 2, 0], [3, 4, 0.5]], atol=1e-15)


@pytest.mark.parametrize(('text', 'message'), [
    ('', ': the file is empty; expected reference poses'),
    ('1 2 3\n', ':1: 3 columns; expected 8 (TUM), 4 (id and pose) or a graph file'),
    ('0 0 0 0\n1 0 0\n', ':2: pose: 3 fields; expected 1 whole and 3 finite numbers'),
    ('0 0 0 0\n1 0 0 inf\n', ":2: pose: 'inf' is not a finite number; expected"),
    ('0 0 0 0\n1.5 0 0 0\n', ":2: pose: '1.5' is not a whole number of 64 bits; expected"),
    ('0 0 0 0\n1 0 0 0\n# c\n0 0 0 0\n', ':4: the same id or stamp a second time; expected'),
    ('1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n', ':2: TUM pose: 7 fields; expected'),
    ('1 0 0 0 0 0 0 1\nnow 0 0 0 0 0 0 1\n', ":2: stamp 'now'; expected seconds"),
    ('1 0 0 0 0 0 0 1\n-2 0 0 0 0 0 0 1\n', ":2: stamp '-2'; expected seconds"),
    ('1 0 0 0 0 0 0 1\n2 0 inf 0 0 0 0 1\n', ":2: TUM pose: 'inf' is not a finite number"),
    ('1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n', ':2: quaternion [0.0, 0.0, 0.0, 0.0]; expected one of'),
    ('1 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n', ':2: the same id or stamp a second time'),
    ('1,2,3\n', ':1: 3 columns; expected 8 (TUM) or 4 (stamp and pose)'),
    ('stamp, x, y, theta\n', ':1: 0 columns; expected 8 (TUM) or 4 (stamp and pose)'),
    ('1,0,0,0\n2,0,x,0\n', ":2: pose: 'x' is not a finite number"),
    ('1,0,0,0\ninf,0,0,0\n', ":2: stamp 'inf'; expected seconds"),
    ('0 nan 0 0\n', ': 1 true pose of 1 left out: NaN; expected reference poses'),
    ('7\n', ':1: 1 column; expected 8 (TUM), 4 (id and pose) or a graph file'),
    ('VERTEX_SE2 0 0 0\n', ':1: VERTEX_SE2: 3 fields; expected'),
    ('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n', ': no vertices; expected VERTEX_SE2, VERTEX2, '),
])
def test_each_malformed_reference_is_named(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(FileError) as caught:
        read_reference(path)
    assert str(caught.value).startswith(f'{path}{message}')
    assert '\n' not in str(caught.value)


def test_no_reference(tmp_path):
    with pytest.raises(FileError, match='cannot be read: No such file or directory'):
        read_reference(tmp_path / 'none.txt')
