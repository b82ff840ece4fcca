# SPDX-License-Identifier: Apache-2.0
"""The files beside a graph: stamps, trusted loops (more in `test_graph_file`) and false loops."""

import numpy as np
import pytest

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.graph.factor_graph import BetweenFactors
from l1slam_ros.io.files import write_lines
from l1slam_ros.io.graphs.side_files import (
    false_loops_path,
    pair_lines,
    read_false_loops,
    read_stamps,
    read_trusted,
    stamps_path,
    trusted_path,
    truth_path,
    write_beside,
)

# The largest ids there are: as floats, the last two would be one.
IDS = np.array([-7, 3, 9, 2**63 - 2, 2**63 - 1])
STAMPS = np.array([1, 5, 1305031102175300121, 2**62 - 1, 2**62])
CHAIN = [(0, 1), (1, 2), (2, 3), (3, 4)]


def factors(*loops, trusted=()):
    """Return odometry along `IDS` and then loops; trusted : rows."""
    pairs = np.array([*CHAIN, *loops])
    m = len(pairs)
    return BetweenFactors(*pairs.T, np.zeros((m, 3)), np.tile(np.eye(3), (m, 1, 1)),
                          np.isin(np.arange(m), trusted), np.zeros(m, bool))


def test_names(tmp_path):
    assert stamps_path(tmp_path / 'a.g2o') == tmp_path / 'a.g2o.stamps.txt'
    assert trusted_path(tmp_path / 'a.g2o') == tmp_path / 'a.g2o.trusted.txt'
    assert truth_path('b') .name == 'b.truth.txt'
    assert false_loops_path('bag.v2').name == 'bag.v2.false.txt'


def test_stamps_come_back_to_the_nanosecond(tmp_path):
    path = tmp_path / 'a.g2o'
    write_beside(path, IDS, STAMPS, factors())
    assert stamps_path(path).read_text().splitlines()[2] == '9 1305031102.175300121'
    assert read_stamps(path, IDS).tolist() == STAMPS.tolist()
    assert read_stamps(tmp_path / 'none.g2o', IDS) is None
    assert [p.name for p in tmp_path.iterdir()] == ['a.g2o.stamps.txt']


def test_stamps_alone_are_those_of_the_vertices_in_their_order(tmp_path):
    path = tmp_path / 'a.g2o'
    stamps_path(path).write_text('# seconds\n 5.25\n7\n6.5 \n8\n9.125\n')
    assert read_stamps(path, IDS).tolist() == [
        5_250_000_000, 7_000_000_000, 6_500_000_000, 8_000_000_000, 9_125_000_000]
    for text, said in (('1\n2\n', '2 stamps that are not'),
                       ('1\n2 3\n', "'2 3'; expected seconds"),
                       ('1\n' * 6, '6 stamps that are not'), ('x\n', "'x'; expected seconds")):
        stamps_path(path).write_text(text)
        with pytest.raises(FileError, match=said):
            read_stamps(path, IDS)


def test_trust_comes_back(tmp_path):
    path, loops = tmp_path / 'a.g2o', [(0, 3), (4, 0), (2, 1), (0, 4), (1, 4)]
    # Rows 5 and 7 join the same vertices; row 6 goes along the odometry, which is row 1.
    written = factors(*loops, trusted=[1, 5, 6])
    write_beside(path, IDS, None, written)
    assert trusted_path(path).read_text() == f'{2**63 - 1} -7\n9 3\n'
    assert np.flatnonzero(read_trusted(path, IDS, factors(*loops))).tolist() == [5, 6, 7]
    assert [p.name for p in tmp_path.iterdir()] == ['a.g2o.trusted.txt']
    assert not read_trusted(tmp_path / 'none.g2o', IDS, written).any()


def test_odometry_alone_lends_its_pair_no_trust(tmp_path):
    path = tmp_path / 'a.g2o'
    write_beside(path, IDS, None, factors((2, 1), trusted=[1]))
    assert not trusted_path(path).exists()
    trusted_path(path).write_text('3 9\n')
    assert not read_trusted(path, IDS, factors()).any()


def test_a_file_without_loops_trusts_none(tmp_path):
    trusted_path(tmp_path / 'a.g2o').write_text('# nobody vouched\n\n')
    assert read_trusted(tmp_path / 'a.g2o', IDS, factors((0, 2))).tolist() == [False] * 5


@pytest.mark.parametrize(('line', 'words'), [
    ('1', ':4: trusted loop: 1 field; expected 2 whole numbers'),
    ('1 2.5', ":4: trusted loop: '2.5' is not a whole number of 64 bits; expected 2"),
    ('-7 8', ':4: no edge between -7 and 8 in '), ('9 -7', ':4: no edge between 9 and -7 in '),
    ('3 3', ':4: no edge between 3 and 3 in '),
    (f'-7 {2**63 - 2}', f':4: no edge between -7 and {2**63 - 2} in ')])
def test_damaged_trust_is_named(tmp_path, line, words):
    path = tmp_path / 'a.g2o'
    trusted_path(path).write_text(f'# of a graph\n3 {2**63 - 2}\n\n{line}\n-7 12\n')
    with pytest.raises(FileError) as caught:
        read_trusted(path, IDS, factors((1, 3), (0, 4)))
    assert str(caught.value).startswith(f'{trusted_path(path)}{words}')
    assert '; expected' in str(caught.value) and '\n' not in str(caught.value)


def test_what_is_no_more_is_removed(tmp_path):
    path = tmp_path / 'a.g2o'
    write_beside(path, IDS, STAMPS, factors((0, 2), trusted=[4]))
    assert len(list(tmp_path.iterdir())) == 2
    write_beside(path, IDS, None, factors((0, 2)))
    assert not list(tmp_path.iterdir())


def test_both_are_written_or_neither(tmp_path):
    path = tmp_path / 'a.g2o'
    trusting, doubting = factors((0, 2), trusted=[4]), factors((0, 2))
    trusted_path(path).mkdir()
    for found, word in (trusting, 'written'), (doubting, 'removed'):
        with pytest.raises(FileError, match=f'^{trusted_path(path)}: cannot be {word}: '):
            write_beside(path, IDS, STAMPS, found)
        assert list(tmp_path.iterdir()) == [trusted_path(path)]


@pytest.mark.parametrize('pairs', [[], [[1, 5]], [[2**62, -7], [9, 2], [9, 2]]])
def test_false_loops_come_back(tmp_path, pairs):
    pairs = np.array(pairs, np.int64).reshape(-1, 2)
    path = tmp_path / 'false.txt'
    write_lines(path, pair_lines(pairs))
    assert path.read_text() == ''.join(f'{i} {j}\n' for i, j in pairs)
    np.testing.assert_array_equal(read_false_loops(path), pairs)


def test_without_the_file_no_loop_is_false(tmp_path):
    assert read_false_loops(tmp_path / 'none.txt').shape == (0, 2)


@pytest.mark.parametrize(('line', 'found'), [
    ('1', '1 field'), ('1 2 3', '3 fields'), ('1 2.5', "'2.5' is not a whole number"),
    ('a b', "'a' is not a whole number")])
def test_damaged_false_loops_are_named(tmp_path, line, found):
    path = tmp_path / 'false.txt'
    path.write_text(f'# of a graph\n1 2\n\n{line}\n3 4\n')
    with pytest.raises(FileError) as caught:
        read_false_loops(path)
    assert str(caught.value).startswith(f'{path}:4: false loop: {found}')
    assert str(caught.value).endswith('; expected 2 whole numbers')
