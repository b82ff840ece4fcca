# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""References of every kind: keys, stamps and poses; trajectories out; malformed lines named."""

import numpy as np
import pytest
from command import run, solve_json
from records import beside
from worlds import between, edge

import l1slam_ros as l1

POSES = np.array([(0, 0, 0), (1, 0, 0.5), (1, 2, -2), (4, 2, 1)], float)
IDS, STAMPS = (4, 2, 9, 7), ('10.5', '11', '12.000000001', '1e2')
LINE = 'EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n'


def rows(keys, text='{} {} {} {}', poses=POSES):
    """Return a line of each pose in the reverse order."""
    return '\n'.join(text.format(key, *pose) for key, pose in
                     reversed(list(zip(keys, poses.tolist(), strict=True)))) + '\n'


def quaternions(separator, keys=STAMPS):
    """Return lines with z and quaternions, as long as other tools make them."""
    q = 1.002 * np.column_stack((0 * POSES[:, :2], np.sin(POSES[:, 2] / 2),
                                 np.cos(POSES[:, 2] / 2)))
    columns = np.column_stack((POSES[:, :2], np.full(4, 9.0), q))
    return rows(keys, separator.join(['{}'] * 8), columns)


@pytest.mark.parametrize('name, text', [
    ('a.tum', '# time x y z q\n' + quaternions(' ')), ('a.csv', rows(STAMPS, '{}, {}, {}, {}')),
    ('a.csv', 'stamp,x,y,theta\n' + rows(STAMPS, '{},{},{},{}')), ('a.csv', quaternions(',')),
    ('a.txt', rows(IDS)), ('a.g2o', '# no edges\n' + rows(IDS, 'VERTEX_SE2 {} {} {} {}')),
    # By stamps where both have some: its ids are others.
    ('stamped.g2o', rows((1, 2, 3, 4), 'VERTEX_SE2 {} {} {} {}'))])
def test_each_form_of_reference_is_compared_pose_by_pose(capsys, tmp_path, name, text):
    steps = between(POSES[:-1], POSES[1:])
    graph = tmp_path / 'graph.g2o'
    graph.write_text('\n'.join(edge(i, j, step, np.eye(3)) for i, j, step in zip(
        IDS[:-1], IDS[1:], steps, strict=True)) + '\n')
    (tmp_path / 'graph.g2o.stamps.txt').write_text(rows(IDS, '{} {}', np.array(STAMPS)[:, None]))
    (tmp_path / name).write_text(text)
    if name == 'stamped.g2o':
        (tmp_path / 'stamped.g2o.stamps.txt').write_text(
            rows((1, 2, 3, 4), '{} {}', np.array(STAMPS)[:, None]))
    found = solve_json(capsys, graph, '--no-robust', '--reference', tmp_path / name, code=None)
    assert found['ate_poses'] == 4 and found['ate'] < 1e-9
    graph.write_text(graph.read_text().replace('EDGE_SE2 4 2 1.0', 'EDGE_SE2 4 2 1.5'))
    astray = solve_json(capsys, graph, '--no-robust', '--reference', tmp_path / name, code=None)
    assert astray['ate'] > 0.1


def test_a_tum_file_has_eight_columns_and_exact_stamps(tmp_path):
    path, source = tmp_path / 'a.tum', tmp_path / 'a.g2o'
    source.write_text(LINE)
    beside(source, 'stamps').write_text('0 1305031102.175300121\n1 1305031102.175300122\n')
    graph, _ = l1.read_graph(source)
    l1.write_graph(path, graph, np.array([[1.25, -2, 0], [0.1, 0.2, np.pi / 2]]))
    rows = [line.split(' ') for line in path.read_text().splitlines()]
    assert rows.pop(0)[0] == '#', 'to evo and others a comment'
    assert [row[0] for row in rows] == ['1305031102.175300121', '1305031102.175300122']
    np.testing.assert_allclose(
        np.array(rows, float)[:, 1:],
        [[1.25, -2, 0, 0, 0, 0, 1], [0.1, 0.2, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]], rtol=1e-15)


@pytest.mark.parametrize(('text', 'message'), [
    ('', ': the file is empty; expected reference poses'),
    ('1 2 3\n', ':1: 3 columns; expected 8 (TUM), 4 (id and pose) or a graph file'),
    ('0 0 0 0\n1 0 0 inf\n', ":2: pose: 'inf' is not a finite number; expected"),
    ('0 0 0 0\n1 0 0 0\n# c\n0 0 0 0\n', ':4: the same id or stamp a second time; expected'),
    ('1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n', ':2: TUM pose: 7 fields; expected'),
    ('1 0 0 0 0 0 0 1\nnow 0 0 0 0 0 0 1\n', ":2: stamp 'now'; expected seconds"),
    ('1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n', ':2: quaternion [0.0, 0.0, 0.0, 0.0]; expected one of'),
    ('1,2,3\n', ':1: 3 columns; expected 8 (TUM) or 4 (stamp and pose)'),
    ('stamp, x, y, theta\n', ':1: 0 columns; expected 8 (TUM) or 4 (stamp and pose)'),
    ('0 nan 0 0\n', ': 1 true pose of 1 left out: NaN; expected reference poses'),
    (LINE, ': no vertices; expected VERTEX_SE2, VERTEX2, '),
])
def test_each_malformed_reference_is_named(capsys, tmp_path, text, message):
    graph, path = tmp_path / 'graph.g2o', tmp_path / 'reference.txt'
    graph.write_text(LINE)
    path.write_text(text)
    said = run(capsys, 'solve', graph, '--reference', path, code=2)[1]
    assert said.startswith(f'l1slam: {path}{message}') and said.count('\n') == 1
