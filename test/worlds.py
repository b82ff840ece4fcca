# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Worlds and drives, made as a user makes them."""

import contextlib
import io
import math
import tempfile
from pathlib import Path

import numpy as np

from l1slam_ros.cli.main import main


def simulated(path, poses, edges, *more):
    """Write a simulated world by `l1slam simulate`; more : its options; return the path."""
    with contextlib.redirect_stdout(io.StringIO()):
        code = main(['simulate', str(path), '--poses', str(poses), '--edges', str(edges),
                     *map(str, more)])
    assert code == 0
    return path


def edited(path, change):
    """Let `change(words, is_odometry)` change the words of each edge of a g2o file, in place."""
    lines = [line.split() for line in path.read_text().splitlines()]
    for line in lines:
        if line and line[0] == 'EDGE_SE2':
            change(line, int(line[2]) == int(line[1]) + 1)
    path.write_text('\n'.join(map(' '.join, lines)) + '\n')
    return path


def drifting(line, is_odometry):
    """Turn odometry by 20 mrad a metre."""
    if is_odometry:
        line[5] = repr(float(line[5]) + 0.02 * math.hypot(float(line[3]), float(line[4])))


def simulated_bag(path, poses, edges, *more):
    """Write a simulated world as a bag without its truth; more : options; return the path."""
    with tempfile.TemporaryDirectory() as name:
        graph = simulated(Path(name) / 'a.g2o', poses, edges, *more)
        assert main(['convert', str(graph), str(path)]) == 0
    return path


def write_g2o(path, pairs, measured, information, stamps=None, ids=None):
    """
    Write a graph file of edges alone, as other programs do, and stamps beside it; return the path.

    pairs : (m, 2), -1 first: of an absolute pose; measured : (m, 3), or (m, 7) with a quaternion;
    information : (m, d, d), of the angle; stamps : (n,) [ns]; ids : (n,); none: 0 and so on
    """
    size = information.shape[1]
    between, absolute = (('EDGE_SE2', 'EDGE_PRIOR_SE2') if size == 3 else
                         ('EDGE_SE3:QUAT', 'EDGE_SE3_PRIOR'))
    lines = [] if size == 3 else ['PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1']
    for (i, j), pose, matrix in zip(np.array(pairs).tolist(), measured.tolist(), information,
                                    strict=True):
        i, j = (k if ids is None or k < 0 else ids[k] for k in (i, j))
        ends = (between, i, j) if i >= 0 else (absolute, j) if size == 3 else (absolute, j, 0)
        lines.append(' '.join(map(str, (*ends, *pose, *matrix[np.triu_indices(size)].tolist()))))
    path.write_text('\n'.join(lines) + '\n')
    if stamps is not None:
        path.with_name(f'{path.name}.stamps.txt').write_text(''.join(
            f'{k if ids is None else ids[k]} {int(stamp) // 10**9}.{int(stamp) % 10**9:09}\n'
            for k, stamp in enumerate(stamps)))
    return path
