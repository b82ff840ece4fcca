# SPDX-License-Identifier: Apache-2.0
"""The files beside a graph: stamps (more in `test_graph_file`) and false loops."""

import numpy as np
import pytest

from l1slam_ros.core.errors import FileError
from l1slam_ros.io.files import write_lines
from l1slam_ros.io.side_files import (
    false_loop_lines,
    false_loops_path,
    read_false_loops,
    read_stamps,
    stamps_path,
    truth_path,
    write_stamps,
)


def test_names(tmp_path):
    assert stamps_path(tmp_path / 'a.g2o') == tmp_path / 'a.g2o.stamps.txt'
    assert truth_path('b') .name == 'b.truth.txt'
    assert false_loops_path('bag.v2').name == 'bag.v2.false.txt'


def test_stamps_come_back_to_the_nanosecond(tmp_path):
    path, ids = tmp_path / 'stamps.txt', np.array([-3, 5, 2**62])
    stamps = np.array([1, 1305031102175300121, 2**62])
    write_stamps(path, ids, stamps)
    assert path.read_text().splitlines()[1] == '5 1305031102.175300121'
    assert read_stamps(path, ids).tolist() == stamps.tolist()
    assert read_stamps(tmp_path / 'none.txt', ids) is None


@pytest.mark.parametrize('pairs', [[], [[1, 5]], [[2**62, -7], [9, 2], [9, 2]]])
def test_false_loops_come_back(tmp_path, pairs):
    pairs = np.array(pairs, np.int64).reshape(-1, 2)
    path = tmp_path / 'false.txt'
    write_lines(path, false_loop_lines(pairs))
    assert path.read_text() == ''.join(f'{i} {j}\n' for i, j in pairs)
    np.testing.assert_array_equal(read_false_loops(path), pairs)


def test_without_the_file_no_loop_is_false(tmp_path):
    assert read_false_loops(tmp_path / 'none.txt').shape == (0, 2)


@pytest.mark.parametrize(('line', 'found'), [
    ('1', '1 fields'), ('1 2 3', '3 fields'), ('1 2.5', "'2.5' is not a whole number"),
    ('a b', "'a' is not a whole number")])
def test_damaged_false_loops_are_named(tmp_path, line, found):
    path = tmp_path / 'false.txt'
    path.write_text(f'# of a graph\n1 2\n\n{line}\n3 4\n')
    with pytest.raises(FileError) as caught:
        read_false_loops(path)
    assert str(caught.value).startswith(f'{path}:4: false loop: {found}')
    assert str(caught.value).endswith('; expected 2 whole numbers')
