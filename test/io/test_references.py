# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""References of three kinds: keys, whether they are stamps, and poses with headings."""

import numpy as np
import pytest

from l1slam_ros.io.files import write_lines
from l1slam_ros.io.trajectory import read_reference, truth_lines


def write(tmp_path, text):
    path = tmp_path / 'reference.txt'
    path.write_text(text)
    return path


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
