# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Part `inner`: seconds until min |A x - b|_1 is solved to 1e-3 and to 1e-4 above its optimum.

The optimum is Clarabel's at a tolerance of 1e-10, and proved: its dual, made exactly feasible,
gives a lower bound.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
from measuring import Row, interleaved, report_progress, row
from solvers.cases import Case, InnerProblem, inner_problems
from solvers.linear_peers import PEERS, clarabel_solution
from solvers.linear_solvers import LinearSolver, Setting, normal_factor
from solvers.ours import INNER, PLAIN

from l1slam_ros.core.geometry.manifold import Array

MARKS = (1e-3, 1e-4)
REFERENCE = PLAIN
_TIGHT = 1e-10
# Part of the cost by which two runs with one setting may differ.
_ROUNDING = 1e-6
# [s] What is known to end may take this long, by the wall of a busy machine.
_PATIENCE = 600.0


@dataclass(frozen=True)
class Optimum:
    """The lowest cost known of a problem, and the part of it that is not proved to be needed."""

    cost: float
    gap: float


def optimum(problem: InnerProblem) -> Optimum:
    """Return the optimum of a problem and how well it is known."""
    answer, y = clarabel_solution(problem, 'dual', _TIGHT, _PATIENCE)
    cost = problem.cost(answer.x)
    return Optimum(cost, 1 - lower_bound(problem, y) / cost)


def lower_bound(problem: InnerProblem, y: Array) -> float:
    """
    Return a lower bound of min |A x - b|_1 from nearly feasible y (rows,).

    y - A (A'A)^-1 A'y has A'y = 0; scaled into |y| <= 1, |A x - b|_1 >= y'(A x - b) = -b'y.
    """
    A = problem.A
    factor = normal_factor(A)
    for _ in range(2):  # the second time mends the rounding of the first
        y = y - A @ factor.solve(A.T @ y)
    return -float(problem.b @ y) / max(1.0, float(np.abs(y).max()))


def measure(cases: Iterable[Case], repeats: int, limit: float) -> list[Row]:
    """Return a row for each problem, mark and solver."""
    rows: list[Row] = []
    for case in cases:
        for problem in inner_problems(case):
            rows.extend(_problem_rows(problem, repeats, limit))
    return rows


def _problem_rows(problem: InnerProblem, repeats: int, limit: float) -> list[Row]:
    best = optimum(problem)
    costs = [best.cost * (1 + mark) for mark in MARKS]
    solvers = (*INNER, *PEERS)
    chosen: dict[tuple[str, float], tuple[LinearSolver, Setting]] = {}
    for solver in solvers:
        report_progress(f'inner: {problem.name}, {solver.name}')
        for mark, setting in zip(MARKS, solver.reach(problem, costs, limit), strict=True):
            if setting is not None:
                chosen[solver.name, mark] = solver, setting
    measured = interleaved({key: partial(solver.run, problem, setting, _PATIENCE)
                            for key, (solver, setting) in chosen.items()}, repeats, limit)
    rows, ours = [], {solver.name for solver in INNER}
    for mark in MARKS:
        for solver in solvers:
            found = measured.get((solver.name, mark))
            numbers = {'rows': problem.A.shape[0], 'optimum': best.cost, 'gap': best.gap}
            if found is not None:
                excess = problem.cost(found.x) / best.cost - 1
                numbers |= {'excess': excess, 'setting': str(chosen[solver.name, mark][1])}
                # It did reach the mark when its setting was looked for.
                found = found if excess <= mark + _ROUNDING else None
            rows.append(row(problem.name, f'to {mark:g}', solver.name, solver.name in ours,
                            found, **numbers))
    return rows

