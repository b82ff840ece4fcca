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
from command import run, solve_json
from records import beside, read

import l1slam_ros as l1


def write(tmp_path, text):
    path = tmp_path / 'reference.txt'
    path.write_text(text)
    return path


def graph_of(path, poses, stamps=()):
    """Write a graph in a row through poses, by their ids; stamps : [s]."""
    ids = [*poses]
    lines = []
    for one, other in zip(ids, ids[1:], strict=False):
        (x, y, turn), (to_x, to_y, to_turn) = poses[one], poses[other]
        c, s = np.cos(turn), np.sin(turn)
        dx, dy = to_x - x, to_y - y
        lines.append(f'EDGE_SE2 {one} {other} {c * dx + s * dy} {c * dy - s * dx} '
                     f'{to_turn - turn} 1 0 0 1 0 1\n')
    path.write_text(''.join(lines))
    if len(stamps):
        beside(path, 'stamps').write_text(''.join(
            f'{k} {stamp:.9f}\n' for k, stamp in zip(ids, stamps, strict=True)))
    return path


# Three poses, whose positions make a triangle of three different sides.
POSES = {2: (4, 5, 0.5), 4: (1, 2, 0), 9: (7, 3, 1)}


def assert_positions(capsys, tmp_path, reference, stamps=()):
    """Check that a reference has the positions of POSES, at these stamps or by their ids."""
    graph = graph_of(tmp_path / 'graph.g2o', POSES, stamps)
    found = solve_json(capsys, graph, '--reference', reference, code=None)
    assert found['ate_poses'] == 3 and found['ate'] == pytest.approx(0, abs=1e-9)
    # Of another triangle they are not.
    other = graph_of(tmp_path / 'other.g2o', {**POSES, 9: (9, 3, 1)}, stamps)
    assert solve_json(capsys, other, '--reference', reference, code=None)['ate'] > 0.1


def columns(path):
    mark, *rows = [line.split(' ') for line in path.read_text().splitlines()]
    assert mark[0] == '#', 'to evo and others a comment'
    return rows


def test_a_tum_file_has_eight_columns_and_exact_stamps(tmp_path):
    path, source = tmp_path / 'a.tum', tmp_path / 'a.g2o'
    source.write_text('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n')
    beside(source, 'stamps').write_text('0 1305031102.175300121\n1 1305031102.175300122\n')
    graph, _ = l1.read_graph(source)
    l1.write_graph(path, graph, np.array([[1.25, -2, 0], [0.1, 0.2, np.pi / 2]]))
    rows = columns(path)
    assert [row[0] for row in rows] == ['1305031102.175300121', '1305031102.175300122']
    np.testing.assert_allclose(
        np.array(rows, float)[:, 1:],
        [[1.25, -2, 0, 0, 0, 0, 1], [0.1, 0.2, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]], rtol=1e-15)
    assert [len(row) for row in rows] == [8, 8]
    # Stamps that are invented are ten a second from 1000 s on.
    beside(source, 'stamps').unlink()
    read(source).write(tmp_path / 'b.tum')
    assert [row[0] for row in columns(tmp_path / 'b.tum')] == ['1000.000000000', '1000.100000000']


def test_tum_of_other_tools(capsys, tmp_path):
    reference = write(
        tmp_path, '# time x y z q\n2.5 1 2 9 0 0 0 -1.002\n1.305e+00 4 5 9 0 0 0.707 0.707\n'
        '4 7 3 8 0 0 0 1\n')
    assert_positions(capsys, tmp_path, reference, (1.305, 2.5, 4))


def test_truth_round_trip(capsys, tmp_path):
    """The truth that is written beside a simulated graph is its reference, by its ids."""
    path, back = tmp_path / 'a.g2o', tmp_path / 'back.g2o'
    run(capsys, 'simulate', path, '--poses', 40, '--edges', 60)
    truth = beside(path, 'truth')
    lines = [line.split(' ') for line in truth.read_text().splitlines() if line[0] != '#']
    assert [len(line) for line in lines] == [4] * 40
    assert [line[0] for line in lines] == list(map(str, range(40)))
    graph, _ = l1.read_graph(path)
    l1.write_graph(back, graph, np.array(lines, float)[:, 1:])
    errors = [solve_json(capsys, path, '--reference', one)['ate'] for one in (truth, back)]
    assert errors[0] == errors[1] > 0


def test_the_vertices_of_a_graph_file_are_a_reference(capsys, tmp_path):
    path = tmp_path / 'a.g2o'
    path.write_text('# no edges\nVERTEX_SE2 4 1 2 3\nVERTEX_SE2 2 4 5 6\nVERTEX_SE2 9 7 3 6\n')
    assert_positions(capsys, tmp_path, path)


def test_a_graph_with_stamps_is_a_reference_by_them_where_both_have_some(capsys, tmp_path):
    path = tmp_path / 'a.g2o'
    path.write_text('VERTEX_SE2 14 4 5 6\nVERTEX_SE2 12 1 2 3\nVERTEX_SE2 19 7 3 1\n')
    beside(path, 'stamps').write_text('14 10.5\n12 11\n19 12\n')
    assert_positions(capsys, tmp_path, path, (10.5, 11, 12))
    graph = graph_of(tmp_path / 'b.g2o', POSES)
    for reference, said in ((path, 'shares 0 poses with the graph'),
                            (tmp_path / 'none', 'cannot be read: No such file or directory')):
        assert said in run(capsys, 'solve', graph, '--reference', reference, code=2)[1]


@pytest.mark.parametrize('text', [
    '2.5, 1, 2, 0.5\n1.5, 4, 5, 0\n3, 7, 3, 0\n',
    'stamp,x,y,theta\n2.5,1,2,.5\n1.5,4,5,0\n3,7,3,0\n',
    f'2.5,1,2,0,0,0,{float(np.sin(.25))!r},{float(np.cos(.25))!r}\n1.5,4,5,0,0,0,0,1\n'
    '3,7,3,0,0,0,0,1\n'])
def test_a_csv_file_has_stamps(capsys, tmp_path, text):
    assert_positions(capsys, tmp_path, write(tmp_path, text), (1.5, 2.5, 3))


@pytest.mark.parametrize(('text', 'message'), [
    ('', ': the file is empty; expected reference poses'),
    ('1 2 3\n', ':1: 3 columns; expected 8 (TUM), 4 (id and pose) or a graph file'),
    ('0 0 0 0\n1 0 0\n', ':2: pose: 3 fields; expected 1 whole and 3 finite numbers'),
    ('0 0 0 0\n1 0 0 inf\n', ":2: pose: 'inf' is not a finite number; expected"),
    ('0 0 0 0\n1 0 0 0\n# c\n0 0 0 0\n', ':4: the same id or stamp a second time; expected'),
    ('1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n', ':2: TUM pose: 7 fields; expected'),
    ('1 0 0 0 0 0 0 1\nnow 0 0 0 0 0 0 1\n', ":2: stamp 'now'; expected seconds"),
    ('1 0 0 0 0 0 0 1\n2 0 inf 0 0 0 0 1\n', ":2: TUM pose: 'inf' is not a finite number"),
    ('1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n', ':2: quaternion [0.0, 0.0, 0.0, 0.0]; expected one of'),
    ('1 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n', ':2: the same id or stamp a second time'),
    ('1,2,3\n', ':1: 3 columns; expected 8 (TUM) or 4 (stamp and pose)'),
    ('stamp, x, y, theta\n', ':1: 0 columns; expected 8 (TUM) or 4 (stamp and pose)'),
    ('1,0,0,0\n2,0,x,0\n', ":2: pose: 'x' is not a finite number"),
    ('0 nan 0 0\n', ': 1 true pose of 1 left out: NaN; expected reference poses'),
    ('VERTEX_SE2 0 0 0\n', ':1: VERTEX_SE2: 3 fields; expected'),
    ('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n', ': no vertices; expected VERTEX_SE2, VERTEX2, '),
])
def test_each_malformed_reference_is_named(capsys, tmp_path, text, message):
    graph, path = graph_of(tmp_path / 'graph.g2o', POSES), write(tmp_path, text)
    said = run(capsys, 'solve', graph, '--reference', path, code=2)[1]
    assert said.startswith(f'l1slam: {path}{message}') and said.count('\n') == 1
