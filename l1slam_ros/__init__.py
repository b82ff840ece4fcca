# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A pose-graph SLAM back end that minimises the L1 norm and refuses loop closures that lie.

    import l1slam_ros as l1

    graph, poses = l1.read_graph('intel.g2o')
    solution = l1.solve(graph)
    l1.write_graph('solved.g2o', graph, solution.poses)

Importing this imports neither ROS nor NumPy; a name is fetched when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for editors and type checkers, which run nothing
    from l1slam_ros.core.errors import L1SlamError as L1SlamError
    from l1slam_ros.core.graph.factor_graph import FactorGraph as FactorGraph
    from l1slam_ros.core.graph.measurements import LoopClosure as LoopClosure
    from l1slam_ros.core.graph.measurements import OdometrySample as OdometrySample
    from l1slam_ros.core.robust.door import Solution as Solution
    from l1slam_ros.core.robust.door import solve as solve
    from l1slam_ros.core.running.backend import Backend as Backend
    from l1slam_ros.core.running.backend import BackendOptions as BackendOptions
    from l1slam_ros.io.formats import read_graph as read_graph
    from l1slam_ros.io.formats import write_graph as write_graph

_HOMES = {
    'read_graph': 'io.formats',
    'write_graph': 'io.formats',
    'solve': 'core.robust.door',
    'Solution': 'core.robust.door',
    'FactorGraph': 'core.graph.factor_graph',
    'OdometrySample': 'core.graph.measurements',
    'LoopClosure': 'core.graph.measurements',
    'Backend': 'core.running.backend',
    'BackendOptions': 'core.running.backend',
    'L1SlamError': 'core.errors',
}

__all__ = list(_HOMES)  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
