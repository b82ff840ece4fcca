# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Graphs of several robots, told by the symbols of GTSAM."""

import numpy as np
from command import run
from records import read

A, B = ord('a') << 56, ord('b') << 56
INFORMATION = '1 0 0 1 0 1'


def test_robots_of_one_file(capsys, tmp_path):
    """The first keyframe of each robot follows none, even where a loop joins it to the last."""
    ends = (A, A + 1), (A + 1, A + 2), (B, B + 1), (A + 2, B)
    path = tmp_path / 'team.g2o'
    path.write_text(''.join(f'EDGE_SE2 {i} {j} 1 0 0 {INFORMATION}\n' for i, j in ends))
    record = read(path)
    np.testing.assert_array_equal(record.graph.predecessor, [-1, 0, 1, -1, 3])
    np.testing.assert_array_equal(record.graph.robot, [0, 0, 0, 1, 1])
    np.testing.assert_array_equal(
        record.graph.between.is_odometry, [True, True, True, False])
    said, _ = run(capsys, 'info', path)
    assert 'robots      2: a, b' in said and 'jump' not in said and 'gap' not in said
    out = tmp_path / 'out.g2o'
    record.write(out)
    again = read(out)
    np.testing.assert_array_equal(again.ids, record.ids)
    np.testing.assert_array_equal(again.graph.predecessor, record.graph.predecessor)
