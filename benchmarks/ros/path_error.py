# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The error of a Path that was heard, by the very measure that `solve --reference` prints."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from l1slam_ros.cli.reference import position_error, read_truth
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.scans.scan_path import ScanPath

# [m] Farther from its keyframe no scan is: there a part of the drive ends.
_FARTHEST = 10.0


def path_error(keyframes: Indices, poses: Array, stamps: Indices, odometry: Array, truth: Path
               ) -> float:
    """
    Return the RMSE of positions [m].

    Where the truth has more poses than the map, that is at the keyframes; where it has fewer, at
    its own stamps, by odometry from the keyframe before. So the map of a recording is measured,
    and the numbers differ by several percent: errors between keyframes are of the odometry.

    Parameters
    ----------
    keyframes, poses : of the Path, (n,) [ns] and (n, 3)
    stamps, odometry : of `scan_odom`, (m,) [ns] and (m, 3)
    truth : a table of `stamp,x,y,theta`

    """
    graph = FactorGraph(se2)
    graph.add_poses(len(keyframes))
    record = GraphRecord(graph, None, np.arange(len(keyframes)), keyframes)
    before = np.maximum(np.searchsorted(keyframes, stamps, side='right') - 1, 0)
    known = read_truth(str(truth), record, truth, ScanPath(stamps, odometry, before))
    if known.steps is not None:
        # Between the last scan of a part and the first of the next there is no odometry.
        near = np.hypot(known.steps[:, 0], known.steps[:, 1]) < _FARTHEST
        known = replace(known, rows=known.rows[near], poses=known.poses[near],
                        steps=known.steps[near])
    return position_error(record, poses, known)
