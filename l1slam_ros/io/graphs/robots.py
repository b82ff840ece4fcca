# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Which robot a vertex belongs to, by its id: a symbol of GTSAM has the robot's letter in it."""

import numpy as np

from l1slam_ros.core.geometry.manifold import Indices, Manifold
from l1slam_ros.core.graph.factor_graph import FactorGraph

# A symbol has a character in its highest byte, and an index below.
_INDEX_BITS = 56


def symbol(letter: str, index: int) -> int:
    """Return the vertex id of a robot's keyframe."""
    return ord(letter) << _INDEX_BITS | index


def robots_of(ids: Indices) -> Indices:
    """Return the character code of the robot of each vertex id, (n,); 0: the id has no letter."""
    codes = ids >> _INDEX_BITS
    letters = ((codes >= ord('A')) & (codes <= ord('Z'))) | (
        (codes >= ord('a')) & (codes <= ord('z')))
    return np.where(letters, codes, 0)


def robot_names(ids: Indices) -> list[str]:
    """Return the letters of the robots of some vertex ids, in order; numbers have no name."""
    return [chr(code) for code in np.unique(robots_of(ids)).tolist() if code]


def keyframes_of(ids: Indices, manifold: Manifold) -> FactorGraph:
    """Return a graph of a keyframe for each vertex id (n,), ascending; each robot has a chain."""
    graph = FactorGraph(manifold)
    for robot, count in enumerate(np.unique(robots_of(ids), return_counts=True)[1].tolist()):
        graph.add_poses(count, robot)
    return graph
