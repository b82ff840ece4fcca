# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
PDLP in a process of its own: OR-Tools brings libraries that other solvers bring too.

    python pdlp_process.py FOLDER

For each line {form, tolerance, limit} on standard input, solves the problem in
`FOLDER/problem.npz`, writes `FOLDER/x.npy`, and prints the seconds that took. It starts from
least squares, as ours do, which is counted and helps it a lot.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from measuring import clock
from ortools.pdlp import solvers_pb2
from ortools.pdlp.python import pdlp
from solvers.linear_solvers import least_squares_start

from l1slam_ros.core.geometry.manifold import Array


def model(A: sp.csr_array, b: Array, form: str) -> Any:
    """Return the problem in one of the forms of `linear_peers`."""
    m, n = A.shape
    quadratic = pdlp.QuadraticProgram()
    if form == 'dual':
        matrix, bounds = A.T, np.zeros(n)
        quadratic.objective_vector = b
        quadratic.variable_lower_bounds, quadratic.variable_upper_bounds = -np.ones(m), np.ones(m)
    else:
        matrix, bounds = sp.hstack([A, -sp.eye(m), sp.eye(m)]), b
        quadratic.objective_vector = np.concatenate((np.zeros(n), np.ones(2 * m)))
        quadratic.variable_lower_bounds = np.concatenate((np.full(n, -np.inf), np.zeros(2 * m)))
        quadratic.variable_upper_bounds = np.full(n + 2 * m, np.inf)
    quadratic.constraint_lower_bounds = quadratic.constraint_upper_bounds = bounds
    quadratic.constraint_matrix = sp.csc_matrix(matrix)
    return quadratic


def start(A: sp.csr_array, b: Array, form: str) -> Any:
    """Return least squares, and the dual that its residuals suggest."""
    x, y = least_squares_start(A, b)
    solution = pdlp.PrimalAndDualSolution()
    if form == 'dual':
        solution.primal_solution, solution.dual_solution = y, x
    else:
        r = A @ x - b
        solution.primal_solution = np.concatenate((x, np.maximum(r, 0), np.maximum(-r, 0)))
        solution.dual_solution = -y
    return solution


def parameters(tolerance: float, limit: float) -> Any:
    """Return one thread, and the same tolerance relative and absolute: the dual's A'y = 0."""
    chosen = solvers_pb2.PrimalDualHybridGradientParams()
    chosen.num_threads = 1
    criteria = chosen.termination_criteria
    criteria.simple_optimality_criteria.eps_optimal_absolute = tolerance
    criteria.simple_optimality_criteria.eps_optimal_relative = tolerance
    criteria.time_sec_limit = limit
    return chosen


def main() -> None:
    """Answer until the input ends."""
    folder = Path(sys.argv[1])
    # PDLP prints its warnings on standard output: they go where errors go, answers where they did.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), 'w')
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    for line in sys.stdin:
        wanted = json.loads(line)
        form = wanted['form']
        stored = np.load(folder / 'problem.npz')
        A = sp.csr_array((stored['data'], stored['indices'], stored['indptr']),
                         shape=tuple(stored['shape']))
        b = stored['b']
        handed_over = model(A, b, form)
        chosen = parameters(wanted['tolerance'], wanted['limit'])
        began = clock()
        result = pdlp.primal_dual_hybrid_gradient(handed_over, chosen, start(A, b, form))
        seconds = clock() - began
        x = result.dual_solution if form == 'dual' else result.primal_solution[: A.shape[1]]
        np.save(folder / 'x.npy', np.array(x))
        print(seconds, file=answers, flush=True)


if __name__ == '__main__':
    main()
