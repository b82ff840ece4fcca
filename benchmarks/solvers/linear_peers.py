# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Clarabel, HiGHS and PDLP on min |A x - b|_1, each in the form that suits it best.

    split   min 1'(u + v)  with  A x - u + v = b,  u, v >= 0
    bound   min 1't        with  -t <= A x - b <= t
    dual    min b'y        with  A'y = 0,  -1 <= y <= 1;  x is the multiplier of A'y = 0

Measured on these problems: `dual` suits HiGHS, `dual` or `bound` Clarabel, `split` or `dual` PDLP.
Handing the matrices over is not counted, all that the solver then does is.
"""

import atexit
import json
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from measuring import Answer, timed
from solvers.cases import InnerProblem
from solvers.linear_solvers import TOLERANCES, ByTolerance, Setting

from l1slam_ros.core.geometry.manifold import Array

_FOLDER = Path(__file__).resolve().parents[1]


def clarabel_solution(problem: InnerProblem, form: str, tolerance: float,
                      limit: float) -> tuple[Answer, Array]:
    """Return x with its time, and the dual y (rows,), by Clarabel's interior point."""
    import clarabel

    A, b = problem.A, problem.b
    m, n = A.shape
    identity = sp.eye(m)
    if form == 'dual':
        G = sp.vstack([A.T, identity, -identity])
        q, h = b, np.concatenate((np.zeros(n), np.ones(2 * m)))
        cones = [clarabel.ZeroConeT(n), clarabel.NonnegativeConeT(2 * m)]
    else:
        G = sp.vstack([sp.hstack([A, -identity]), sp.hstack([-A, -identity])])
        q, h = np.concatenate((np.zeros(n), np.ones(m))), np.concatenate((b, -b))
        cones = [clarabel.NonnegativeConeT(2 * m)]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.time_limit = limit
    settings.tol_gap_abs = 0.0
    settings.tol_gap_rel = tolerance
    settings.tol_feas = tolerance
    arguments = sp.csc_matrix((len(q), len(q))), q, sp.csc_matrix(G), h, cones, settings
    found: list[Any] = []

    def solve() -> Array:
        found.append(clarabel.DefaultSolver(*arguments).solve())
        return np.array(-np.array(found[0].z[:n]) if form == 'dual' else found[0].x[:n])

    answer = timed(solve)
    z = np.array(found[0].z)
    return answer, np.array(found[0].x) if form == 'dual' else z[:m] - z[m:]


def _clarabel(problem: InnerProblem, setting: Setting, limit: float) -> Answer:
    assert isinstance(setting, tuple)
    form, tolerance = setting
    return clarabel_solution(problem, form, tolerance, limit)[0]


def _highs(problem: InnerProblem, setting: Setting, limit: float) -> Answer:
    """Solve the dual; `simplex` is HiGHS's own choice of simplex method."""
    import highspy

    assert isinstance(setting, tuple)
    method, tolerance = setting
    A, b = problem.A, problem.b
    m, n = A.shape
    transpose = sp.csc_matrix(A.T)
    model = highspy.HighsLp()
    model.num_col_, model.num_row_ = m, n
    model.col_cost_ = b
    model.col_lower_ = -np.ones(m)
    model.col_upper_ = np.ones(m)
    model.row_lower_, model.row_upper_ = np.zeros(n), np.zeros(n)
    model.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    model.a_matrix_.start_ = transpose.indptr
    model.a_matrix_.index_, model.a_matrix_.value_ = transpose.indices, transpose.data
    highs = highspy.Highs()
    options = {'output_flag': False, 'threads': 1, 'time_limit': limit, 'solver': method}
    if method == 'ipm':
        options |= {'run_crossover': 'off', 'ipm_optimality_tolerance': tolerance}
    for name, value in options.items():
        highs.setOptionValue(name, value)
    highs.passModel(model)

    def solve() -> Array:
        highs.run()
        return np.array(highs.getSolution().row_dual)

    return timed(solve)


def _pdlp(problem: InnerProblem, setting: Setting, limit: float) -> Answer:
    """Ask the process that PDLP has to itself; it measures the solver alone."""
    assert isinstance(setting, tuple)
    form, tolerance = setting
    process, folder = _pdlp_process()
    A = problem.A
    np.savez(folder / 'problem.npz', data=A.data, indices=A.indices, indptr=A.indptr,
             shape=A.shape, b=problem.b)
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(json.dumps({'form': form, 'tolerance': tolerance, 'limit': limit}) + '\n')
    process.stdin.flush()
    seconds = float(json.loads(process.stdout.readline()))
    return Answer(np.load(folder / 'x.npy'), seconds)


@cache
def _pdlp_process() -> tuple['subprocess.Popen[str]', Path]:
    folder = tempfile.TemporaryDirectory(prefix='l1slam-')
    # What PDLP says of badly scaled problems is not ours to print.
    process = subprocess.Popen([sys.executable, '-m', 'solvers.pdlp_process', folder.name],
                               cwd=_FOLDER, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                               stderr=subprocess.DEVNULL, text=True)

    def end() -> None:
        process.kill()
        process.wait()
        folder.cleanup()

    atexit.register(end)
    return process, Path(folder.name)


def _with_tolerances(word: str) -> tuple[Setting, ...]:
    return tuple((word, tolerance) for tolerance in TOLERANCES)


PEERS = (
    ByTolerance('Clarabel', (_with_tolerances('dual'), _with_tolerances('bound')), _clarabel),
    ByTolerance('HiGHS', ((('simplex', 0.0),), _with_tolerances('ipm')), _highs),
    ByTolerance('PDLP', (_with_tolerances('split'), _with_tolerances('dual')), _pdlp),
)
