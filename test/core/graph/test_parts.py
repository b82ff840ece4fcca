# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Where the odometry of a graph has gaps."""

import numpy as np
import pytest

from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.parts import vague_odometry


@pytest.mark.parametrize('manifold', [se2, se3])
@pytest.mark.parametrize(('times', 'says_nothing'), [(15, False), (30, True)])
def test_a_step_says_nothing_from_the_same_sigmas_on_in_the_plane_and_in_space(
        manifold, times, says_nothing):
    graph, k = FactorGraph(manifold, 6), np.arange(5)
    roots = np.tile(10 * np.eye(manifold.TANGENT_SIZE), (5, 1, 1))
    roots[3] /= times
    graph.append_between(k, k + 1, manifold.identity(5), roots)
    assert vague_odometry(graph).tolist() == [False, False, False, says_nothing, False]
