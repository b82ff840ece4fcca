# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A graph whose map is not to be relied on: refused loops of many places agree on another."""

import numpy as np

from l1slam_ros.core.geometry import se2

_SHIFT = np.array([[8.0, -6.0, 0.4]])


def shifted_runs(world, starts, length):
    """Return the graph with runs of loops (i + k, j + k) that say with one voice that j is off."""
    graph, k = world.graph.copy(), np.arange(length)
    for i, j in starts:
        far = se2.compose(np.broadcast_to(_SHIFT, (length, 3)), world.truth[j + k])
        graph.add_between(i + k, j + k, se2.between(world.truth[i + k], far),
                          np.tile(np.diag([400.0, 400.0, 1e4]), (length, 1, 1)))
    return graph
