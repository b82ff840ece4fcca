# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Two robots that only false loops join."""

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.batch import robust_solve

LOOPS, KEYFRAMES = 30, 60


def test_loops_between_two_robots_that_all_lie_are_all_refused():
    """No two of them agree, so that there is not even a run of them to look at."""
    rng, graph = np.random.default_rng(0), FactorGraph(se2)
    for robot in range(2):
        graph.add_poses(KEYFRAMES, robot)
    i = np.delete(np.arange(2 * KEYFRAMES - 1), KEYFRAMES - 1)
    root = 10 * np.eye(3)
    graph.append_between(i, i + 1, np.tile((1.0, 0, 0.02), (len(i), 1)),
                         np.tile(root, (len(i), 1, 1)))
    first = rng.integers(0, KEYFRAMES, LOOPS)
    lies = np.column_stack((rng.uniform(-20, 20, (LOOPS, 2)), rng.uniform(-3, 3, LOOPS)))
    graph.append_between(first, rng.integers(KEYFRAMES, 2 * KEYFRAMES, LOOPS), lies,
                         np.tile(root, (LOOPS, 1, 1)))
    judgement, _ = robust_solve(graph)
    assert judgement.accepted[:len(i)].all() and not judgement.accepted[len(i):].any()
