# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Parts `whole` and `starts`: whole graphs, ours against gtsam and g2o, from the same poses.

Every cost is recomputed here from the poses that came back: the L1 norm and chi2 of the residual
whitened by the Cholesky root.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from measuring import Measured, Row, interleaved, report_progress, row
from solvers.cases import STARTS, Case
from solvers.graph_peers import GAUSS_NEWTON, IN_SPACE, LAGO, PEERS
from solvers.graph_solvers import GraphSolver
from solvers.ours import DEFAULT, FROM_NOTHING, WHOLE

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.solvers.optimality import l1_cost, l2_cost

REFERENCE = GAUSS_NEWTON.name
# Where the poses come from the graph alone, and finding them is counted.
NOTHING = 'nothing'
REFERENCE_FROM_NOTHING = LAGO.name
_OURS = {solver.name for solver in (*WHOLE, *FROM_NOTHING)}
# The lowest L1 cost that anybody has found.
LOWEST = {'intel': 961.77375, 'manhattan3500': 971.66316, 'city10000': 3772.00977,
          'sphere2500': 2931.72800, 'parking-garage': 87.76003, 'real/torus3D': 17441.34772}
PERTURBED = 20


def measure(cases: Iterable[Case], repeats: int, limit: float) -> list[Row]:
    """Return a row for each graph, start and solver."""
    rows: list[Row] = []
    for case in cases:
        peers, from_nothing = PEERS, (*FROM_NOTHING, LAGO)
        if case.graph.manifold is not se2:
            peers, from_nothing = IN_SPACE, FROM_NOTHING
        found = []
        for start in STARTS:
            if start == 'stored' and np.array_equal(case.stored, case.starts['odometry']):
                continue
            found += _group_rows(case, start, case.starts[start], (*WHOLE, *peers), repeats, limit)
        found += _group_rows(case, NOTHING, case.stored, from_nothing, repeats, limit)
        rows += with_excess(found, LOWEST.get(case.name, np.inf))
    return rows


def measure_starts(cases: Iterable[Case], repeats: int, limit: float) -> list[Row]:
    """Return, for each graph, a row for each of `PERTURBED` starts and solver; each runs once."""
    rows: list[Row] = []
    for case in cases:
        found = []
        for number in range(PERTURBED):
            start = case.perturbed(number)
            found += _group_rows(case, f'perturbed {number:02}', start, (DEFAULT, GAUSS_NEWTON),
                                 1, limit)
        rows += with_excess(found, LOWEST.get(case.name, np.inf))
    return rows


def with_excess(rows: list[Row], lowest: float) -> list[Row]:
    """Return the rows of one graph with their L1 cost's part above the lowest known."""
    lowest = min(lowest, *(r.numbers['l1'] for r in rows))
    return [replace(r, numbers=r.numbers | {'excess': r.numbers['l1'] / lowest - 1}) for r in rows]


def _group_rows(case: Case, start: str, poses: Array, solvers: tuple[GraphSolver, ...],
                repeats: int, limit: float) -> list[Row]:
    report_progress(f'whole: {case.name}, from {start}')
    runs = {solver.name: solver.prepare(case, poses) for solver in solvers}
    measured = interleaved(runs, repeats, limit)
    return [row(case.name, start, name, name in _OURS, found, **_costs(case, found))
            for name, found in measured.items()]


def _costs(case: Case, found: Measured) -> Mapping[str, float]:
    residual = whitened_residual(case.graph, found.x)
    return {'l1': l1_cost(residual), 'chi2': l2_cost(residual)}
