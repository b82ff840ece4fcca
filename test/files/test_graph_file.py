# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Graph files: g2o and TORO in, the same numbers out, every malformed line named."""

import numpy as np
import pytest
from command import run
from numpy.testing import assert_allclose
from records import beside, error_of, information_of, read

import l1slam_ros as l1

SQUARE = """\
# a comment
VERTEX_SE2 7 1.5 0 1.5
VERTEX_SE2 3 0 0 0

EDGE_SE2 3 7 1 0.25 1.5 4 0.5 0.25 5 0.125 6
VERTEX_SE2 9 1 1 3
EDGE_SE2 7 9 1 0 1.5 4 0 0 4 0 9
EDGE_SE2 9 3 -0.5 1 -3 1 0 0 1 0 1
"""


@pytest.fixture
def write(tmp_path):
    def file(content, name='a.g2o'):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path
    return file


def message_of(path):
    return error_of(l1.read_graph, path).removeprefix(str(path))


def test_a_small_graph(write):
    record = read(write(SQUARE))
    assert record.ids.tolist() == [3, 7, 9]
    assert record.poses.tolist() == [[0, 0, 0], [1.5, 0, 1.5], [1, 1, 3]]
    factors = record.graph.between
    assert factors.i.tolist() == [0, 1, 2]
    assert factors.j.tolist() == [1, 2, 0]
    assert factors.measurement[0].tolist() == [1, 0.25, 1.5]
    np.testing.assert_allclose(information_of(record.graph)[0],
                               [[4, 0.5, 0.25], [0.5, 5, 0.125], [0.25, 0.125, 6]], rtol=1e-15)
    assert record.stamps is None
    assert record.skipped == ()


def test_priors_are_seen_from_the_world(write, tmp_path):
    record = read(write(
        'EDGE_PRIOR_SE2 7 1 2 0.5 10 1 2 20 3 30\n' + SQUARE + 'EDGE_PRIOR_SE2_XY 9 3 4 5 1 6\n'
        'EDGE_PRIOR_SE2 3 0 0 1 0 0 0 0 0 9\n'))
    graph, factors = record.graph, record.graph.between
    assert factors.is_absolute.tolist() == [True, False, False, False, True, True]
    assert factors.j[factors.is_absolute].tolist() == [1, 2, 0]
    assert factors.measurement[factors.is_absolute].tolist() == [[1, 2, 0.5], [3, 4, 0], [0, 0, 1]]
    np.testing.assert_allclose(information_of(graph)[factors.is_absolute], [
        [[10, 1, 2], [1, 20, 3], [2, 3, 30]], [[5, 1, 0], [1, 6, 0], [0, 0, 0]],
        np.diag([0, 0, 9])], rtol=1e-15)
    record.write(tmp_path / 'again.g2o')
    assert_same(record, read(tmp_path / 'again.g2o'))
    tags = [line.split()[0] for line in (tmp_path / 'again.g2o').read_text().splitlines()]
    assert [tag for tag in tags if tag.startswith('EDGE')] == [
        'EDGE_PRIOR_SE2', *['EDGE_SE2'] * 3, 'EDGE_PRIOR_SE2_XY', 'EDGE_PRIOR_SE2']


def test_what_is_not_used_is_said(write):
    record = read(write(
        SQUARE + 'FIX 9\nFIX 3\nPARAMS_SE2OFFSET 0 0 0 0\nVERTEX_XY 20 1 2\nVERTEX_XY 21 1 2\n'
        'EDGE_SE2_XY\nEDGE_SE2_XY 3 x nan 1\nROBOTLASER1 0 -1.5 3 0.1 81 0 0 3 1.1 x\n'))
    assert record.skipped == (
        "FIX '9 3' is not used: the first vertex, 3, is the one held fixed",
        "6 lines not used: 1 'PARAMS_SE2OFFSET', 1 'ROBOTLASER1' (sensor data and calibration "
        "are no part of a pose graph); 2 'VERTEX_XY', 2 'EDGE_SE2_XY' (landmarks are no part of "
        'a pose graph)')
    assert record.graph.n_poses == 3 and len(record.graph.between) == 3


# The square again, as TORO has it.
TORO_SQUARE = """\
# a comment
VERTEX2 7 1.5 0 1.5
VERTEX2 3 0 0 0

EDGE2 3 7 1 0.25 1.5 4 0.5 5 6 0.25 0.125
VERTEX2 9 1 1 3
EDGE2 7 9 1 0 1.5 4 0 4 9 0 0
EDGE2 9 3 -0.5 1 -3 1 0 1 1 0 0
"""


def test_the_same_square_in_toro(write):
    a, b = read(write(SQUARE)), read(write(TORO_SQUARE, 'a.graph'))
    assert_same(a, b)


@pytest.mark.parametrize(('line', 'least', 'expected'), [
    ('EDGE_SE2 3 7 1 0 0 1 2 0 1 0 1', '-0.33',
     [[1.5, 1.5, 0], [1.5, 1.5, 0], [0, 0, 1]]),
    # Positive definite in one order, not in the other.
    ('EDGE2 3 7 1 0 0 1 0 0 1 0 1', '-0.38', [[1, 0, 0], [0, 0.447, 0.724], [0, 0.724, 1.171]]),
    ('EDGE_PRIOR_SE2 3 1 0 0 1 0 0 1 0 -1', '-1', [[1, 0, 0], [0, 1, 0], [0, 0, 0]]),
    # What says nothing says nothing.
    ('EDGE_PRIOR_SE2_XY 3 1 0 1 0 -1', '-1', [[1, 0, 0], [0, 0, 0], [0, 0, 0]]),
])
def test_information_that_is_not_definite_is_used_as_the_nearest_that_is(
        write, tmp_path, line, least, expected):
    record = read(write(SQUARE + line + '\n'))
    found = information_of(record.graph)[-1]
    assert_allclose(found, expected, atol=2e-3)
    values = np.linalg.eigvalsh(found[:2, :2] if 'XY' in line else found)
    assert values[0] == pytest.approx(1e-6 * values[-1], rel=1e-6)
    assert record.graph.between.speaks[-1].tolist() == [True, True, 'XY' not in line]
    count = len(record.graph.between)
    assert record.skipped[0] == (
        f'1 of {count} information matrices not positive definite, the worst at line 9: its '
        f'smallest eigenvalue is {least} times its largest; each is replaced by the nearest '
        'matrix whose eigenvalues are at least 1e-06 times its largest')
    record.write(path := tmp_path / 'again.g2o')
    again = read(path)
    assert_allclose(information_of(again.graph)[-1], found, rtol=1e-9, atol=1e-15)
    assert not again.skipped


def test_turns_beyond_a_full_turn_are_said_to_look_like_degrees(write):
    near = 'EDGE_SE2 3 7 1 0.25 6.28 1 0 0 1 0 1\n'
    assert not read(write(SQUARE + near)).skipped
    bad = near + 'EDGE_SE2 3 7 1 0.25 7 1 0 0 1 0 1\nEDGE_SE2 9 3 -0.5 1 -171.9 1 0 0 1 0 1\n'
    assert read(write(SQUARE + bad)).skipped == (
        '2 of 6 edges turn by more than 2 pi, the most by 171.9 at line 11: all angles are read '
        'as radians; are these degrees?',)
    sentence, = read(write(SQUARE + bad.splitlines()[1])).skipped
    assert sentence.startswith('1 of 4 edges turns by more than 2 pi, the most by 7 at line 9: ')


@pytest.mark.parametrize(('content', 'message'), [
    ('', ': the file is empty; expected EDGE_SE2, EDGE2, EDGE_SE3:QUAT or EDGE3 lines'),
    ('VERTEX_SE2 0 0 0 0\n', ': no edges; expected EDGE_SE2, EDGE2, EDGE_SE3:QUAT or EDGE3 lines'),
    ('0 1 2\n', ":1: unknown tag '0'; expected VERTEX_SE2, "),
    (b'\x89MCAP0\r\n', ': byte 0x89 at offset 0; expected a text file'),
    (b'VERTEX_SE2 0 0 0 0\n\x00\x01 EDGE\n', ":2: unknown tag '\\x00\\x01'; expected"),
])
def test_what_is_no_graph_is_told(write, content, message):
    found = message_of(write(content))
    assert found.startswith(message)
    assert len(found) < 400


def test_a_directory_or_nothing_beside_a_graph_is_told(capsys, tmp_path, write):
    graph = write(SQUARE)
    for reference, why in ((tmp_path, 'Is a directory'),
                           (tmp_path / 'none.txt', 'No such file or directory')):
        said = run(capsys, 'solve', graph, '--reference', reference, code=2)[1]
        assert said == f'l1slam: {reference}: cannot be read: {why}\n'
    beside(graph, 'stamps').mkdir()
    assert message_of(graph) == '.stamps.txt: cannot be read: Is a directory'


def assert_same(a, b):
    assert (a.ids == b.ids).all()
    assert (a.poses == b.poses).all()
    x, y = a.graph.between, b.graph.between
    assert (x.i == y.i).all() and (x.j == y.j).all()
    assert (x.measurement == y.measurement).all()
    np.testing.assert_allclose(x.sqrt_information, y.sqrt_information, rtol=0, atol=1e-13)


def test_edges_from_a_vertex_to_itself_are_left_out(tmp_path):
    """Whatever else is wrong with them; and a vertex that has no other edge is none."""
    path, edge = tmp_path / 'a.g2o', 'EDGE_SE2 {} 1 0 0 1 0 0 1 0 1'.format
    circles = [edge('7 7'), 'EDGE_SE2 99 99 1 0 0 0 0 0 0 0 0', edge('3 3'), edge('3 3')]
    for count, said in (
            (1, '1 edge from a vertex to itself not used: line 2'),
            (3, '3 edges from a vertex to itself not used: lines 2, 3, 4'),
            (4, '4 edges from a vertex to itself not used: lines 2, 3, 4, ...')):
        path.write_text('\n'.join([edge('3 7'), *circles[:count], edge('7 11')]))
        record = read(path)
        assert record.skipped == (said,)
        assert record.ids.tolist() == [3, 7, 11]
        assert record.ids[record.graph.between.pairs].tolist() == [[3, 7], [7, 11]]
    path.write_text(edge('3 3'))
    assert message_of(path).startswith(': no edges; expected')


LOOPS = 'EDGE_SE2 7 3 1 0 0 1 0 0 1 0 1\nEDGE_SE2 9 7 1 0 0 1 0 0 1 0 1\n'


@pytest.fixture
def judged(write, tmp_path):
    """Return a graph with stamps and words on its loops, and where it has been written."""
    source = write(SQUARE + LOOPS, 'source.g2o')
    beside(source, 'stamps').write_text('3 1\n7 2\n9 3\n')
    (tmp_path / 'out').mkdir()
    record, path = read(source), tmp_path / 'out' / 'a.g2o'
    record.graph.say(np.array([0, 2, 3]), trusted=True)
    record.graph.say(np.array([4]), trusted=False)
    record.write(path)
    return record, path


def test_trust_and_strikes_come_back_with_the_graph(judged):
    record, path = judged
    assert sorted(p.name for p in path.parent.iterdir()) == [
        'a.g2o', 'a.g2o.stamps.txt', 'a.g2o.struck.txt', 'a.g2o.trusted.txt']
    back = read(path)
    assert back.graph.between.trusted.tolist() == [False, False, True, True, False]
    assert back.graph.between.struck.tolist() == [False] * 4 + [True]
    assert (back.poses == record.poses).all() and (back.stamps == record.stamps).all()


def test_trust_joins_loops_either_way_round_and_leaves_odometry(write):
    path = write(SQUARE + 'EDGE_SE2 7 3 1 0 0 1 0 0 1 0 1\nEDGE_SE2 3 9 1 0 0 1 0 0 1 0 1\n')
    beside(path, 'trusted').write_text('3 7\n7 9\n')
    assert read(path).graph.between.trusted.tolist() == [False] * 3 + [True, False]
    beside(path, 'trusted').write_text('3 9\n')
    assert read(path).graph.between.trusted.tolist() == [
        False, False, True, False, True]
    beside(path, 'trusted').write_text('# nobody vouched\n\n')
    assert not read(path).graph.between.trusted.any()


def test_what_is_said_of_one_of_two_loops_between_the_same_keyframes_is_no_word_on_both(write):
    path = write(f'{SQUARE}EDGE_SE2 9 3 1 0 0 1 0 0 1 0 1\n')
    for name in 'trusted', 'struck':
        beside(path, name).write_text('3 9\n')
    factors = read(path).graph.between
    assert not (factors.trusted | factors.struck).any()


@pytest.mark.parametrize(('name', 'text', 'message'), [
    ('trusted', '3 9\n\n3 2.5\n', ":3: trusted loop: '2.5' is not a whole number of 64 bits; "),
    ('trusted', '3 9 1\n', ':1: trusted loop: 3 fields; expected 2 whole numbers'),
    ('trusted', '3 3\n', ':1: no edge between 3 and 3 in '),
    ('trusted', '9 3\n3 8\n', ':2: no edge between 3 and 8 in '),
    ('struck', '3 9\n9 7\n', ':2: no loop between 9 and 7 in '),
])
def test_damaged_trust_and_strikes_are_named(write, name, text, message):
    path = write(SQUARE)
    beside(path, name).write_text(text)
    assert message_of(path).startswith(f'.{name}.txt{message}')


def test_a_graph_is_not_lent_the_stamps_or_the_trust_of_its_predecessor(judged, write):
    _, path = judged
    read(write(SQUARE)).write(path)
    assert list(path.parent.iterdir()) == [path]


def contents(folder):
    return {path: path.is_dir() or path.read_bytes() for path in folder.iterdir()}


def test_graph_stamps_and_trust_are_replaced_together_or_not_at_all(judged, write):
    record, path = judged
    for name in 'trusted', 'struck':
        beside(path, name).unlink()
    beside(path, 'trusted').mkdir()
    before = contents(path.parent)
    beside(write(SQUARE), 'stamps').write_text('3 1\n7 2\n9 4\n')
    plain = read(write(SQUARE))
    for changed, word in (record, 'written'), (plain, 'removed'):
        with pytest.raises(l1.L1SlamError, match=f'{beside(path, "trusted")}: cannot be {word}'):
            changed.write(path, changed.poses + 1, force=True)
        assert contents(path.parent) == before


@pytest.mark.parametrize(('number', 'said'), [
    (np.nan, 'pose 2 is .* expected'), (np.inf, 'pose 2 is .* expected'),
    (-1.1e30, 'VERTEX_SE2 9 would be .* expected')])
def test_a_pose_that_cannot_be_written_leaves_the_graph_before(judged, number, said):
    record, path = judged
    before, poses = contents(path.parent), record.poses.copy()
    poses[2, 1] = number
    with pytest.raises(l1.L1SlamError, match=said):
        record.write(path, poses)
    assert contents(path.parent) == before


@pytest.mark.parametrize(('text', 'message'), [
    ('3 1\n7 2\n8 3\n', ': 3 stamps do not match the 3 vertices'),
    ('3 1\n7 2\n7 2\n9 3\n', ': 4 stamps do not match the 3 vertices'),
    ('3 1\n7\n9 3\n', ":2: '7'; expected a vertex id and seconds"),
    ('1\n2\n', ': 2 stamps do not match'), ('1\n2 3\n', ":2: '2 3'; expected seconds"),
    *((f'3 1\n# x\n7 {seconds}\n9 3\n', f":3: '7 {seconds}'; expected a vertex id and seconds")
      for seconds in ('two', 'nan', 'inf', '-1', '1e30', '1e999999999', '1.2.3')),
])
def test_damaged_stamps_are_named(write, text, message):
    path = write(SQUARE)
    beside(path, 'stamps').write_text(text)
    assert message_of(path).startswith(f'.stamps.txt{message}')


def test_stamps_of_any_order(write):
    path = write(SQUARE)
    beside(path, 'stamps').write_text('9 1.305031102175300121e+09\n# c\n3 0.0000000004\n7 2\n')
    assert read(path).stamps.tolist() == [0, 2000000000, 1305031102175300121]
    beside(path, 'stamps').write_text('# seconds\n 3.25\n1 \n2.5\n')
    assert read(path).stamps.tolist() == [3250000000, 1000000000, 2500000000]
