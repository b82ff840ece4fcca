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
