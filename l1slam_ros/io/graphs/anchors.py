# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Vertices of a graph file that only fix the graph in the world; they are not poses of a robot."""

import numpy as np

from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.io.files import TextLines
from l1slam_ros.io.graphs.rows import Rows


def fixed_in(groups: dict[str, TextLines]) -> list[str]:
    """Return the names of the vertices that a file holds fixed."""
    return ' '.join(groups['FIX'].texts).split() if 'FIX' in groups else []


def anchors_of(groups: dict[str, TextLines], ids: Indices, edges: Rows) -> Indices:
    """
    Return the vertices that only fix a graph in the world, no poses of the robot, (k,).

    hdl_graph_slam writes them. Such a vertex is fixed and has a single edge, and another edge
    joins the vertices with the ids just below and above. The map is the same without them; with
    them the odometry would have a gap.
    """
    fixed = fixed_in(groups)
    if not fixed:  # as in most files; else each vertex gets a name to compare
        return ids[:0]
    anchors = []
    ends = np.sort(edges.ids, axis=1)
    for k in np.flatnonzero(np.isin(ids.astype(str), fixed)):
        passed = (ends == ids[[k - 1, (k + 1) % len(ids)]]).all(axis=1)
        if (ends == ids[k]).any(axis=1).sum() == 1 and passed.any():
            anchors.append(ids[k])
    return np.array(anchors, np.int64)
