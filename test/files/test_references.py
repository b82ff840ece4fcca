# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""References of every kind: keys, whether they are stamps, and poses."""

import numpy as np
import pytest
from command import solve_json
from worlds import between, edge

POSES = np.array([(0, 0, 0), (1, 0, 0.5), (1, 2, -2), (4, 2, 1)], float)
IDS, STAMPS = (4, 2, 9, 7), ('10.5', '11', '12.000000001', '1e2')


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
