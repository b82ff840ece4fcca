# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Robots with a short drive each: the first keyframe of a robot is no gap of its odometry."""

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.batch_map import SolveOptions, solve

ROBOTS, OWN = 8, 6


def test_loops_of_many_short_drives_are_doubted():
    """All drive one street beside each other, each keyframe sees that of the next robot."""
    graph, rng = FactorGraph(se2), np.random.default_rng(0)
    for robot in range(ROBOTS):
        graph.add_poses(OWN, robot)
    truth = np.array([(k, 0.5 * robot, 0.0) for robot in range(ROBOTS) for k in range(OWN)])
    k = np.arange(len(truth))
    steps, beside = k[k % OWN < OWN - 1], k[:-OWN]
    i, j = np.concatenate((steps, beside)), np.concatenate((steps + 1, beside + OWN))
    noise = 0.01 * rng.standard_normal((len(i), 3))
    measured = se2.retract(se2.between(truth[i], truth[j]), noise)
    graph.add_between(np.append(i, 3), np.append(j, 40),
                      np.concatenate((measured, [[20.0, 20.0, 2.0]])),
                      np.broadcast_to(1e4 * np.eye(3), (len(i) + 1, 3, 3)))
    outcome = solve(graph, None, SolveOptions())
    assert not outcome.unjudged and not outcome.judgement.accepted[-1]
