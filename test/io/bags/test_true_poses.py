# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""True poses go into a bag one for each vertex."""

import numpy as np
import pytest

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.io.bags.from_graph import write_graph_bag
from l1slam_ros.io.graphs.graph_file import GraphRecord


def test_what_messages_cannot_express_exactly(tmp_path):
    graph = FactorGraph(se2, 3)
    graph.add_between(np.array([0, 1]), np.array([1, 2]), np.zeros((2, 3)),
                      np.stack([np.eye(3)] * 2))
    record = GraphRecord(graph, None, np.array([0, 10, 20]))
    with pytest.raises(GraphError, match='2 true poses; expected 3, one for each vertex'):
        write_graph_bag(tmp_path / 'bag', record, np.zeros((2, 3)))
    assert list(tmp_path.iterdir()) == []
