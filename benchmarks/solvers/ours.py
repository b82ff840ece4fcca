# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Our own solvers, as the measurements call them: the only module that knows their names.

`INNER` are those of one linear problem, `WHOLE` those of a whole graph, and `ITERATIONS` a single
iteration, for the comparison with the bytes that it has to move.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from measuring import Answer, timed
from solvers.cases import Case, InnerProblem, seed_of
from solvers.graph_solvers import SAME_TOLERANCE, GraphSolver
from solvers.linear_solvers import (
    TOLERANCES,
    ByIterations,
    ByTolerance,
    LinearSolver,
    Setting,
    least_squares_start,
)

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.l1_problem import LinearProblem
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.interior_point import interior_point
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import smoothing
from l1slam_ros.core.solvers.primal_dual import (
    PrimalDualOptions,
    PrimalDualSolution,
    diagonal_step_sizes,
    primal_dual,
    primal_weight,
)
from l1slam_ros.core.solvers.restarted_pdhg import minimise_l1_halpern
from l1slam_ros.core.solvers.reweighting import weighted_least_squares
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import AUTO, INTERIOR_POINT, PRIMAL_DUAL, choose, minimise_by

# What the ratios of the inner problems are to.
PLAIN = 'Algorithm 2, plain'
# Iterations with which the search begins for how many are needed; then twice as many.
_FEWEST = 160
_STEPS = 100


def algorithm_2(problem: InnerProblem, x: Array, omega: float) -> Iterator[Array]:
    """Yield the x of Algorithm 2 as the paper has it (omega = 1), on SciPy's sparse products."""
    tau, sigma = diagonal_step_sizes(problem.A)
    tau, sigma = tau / omega, sigma * omega
    sigma_b = sigma * problem.b
    iterates = primal_dual(problem.A, lambda v: np.clip(v - sigma_b, -1, 1), lambda v: v, x,
                           np.zeros(len(problem.b)), tau, sigma)
    yield from (x for x, _ in iterates)


def _plain(problem: InnerProblem) -> Iterator[Array]:
    x, _ = least_squares_start(problem.A, problem.b)
    yield from algorithm_2(problem, x, 1.0)


def _weighted(problem: InnerProblem) -> Iterator[Array]:
    x, _ = least_squares_start(problem.A, problem.b)
    yield from algorithm_2(problem, x, primal_weight(problem.A, problem.b, x))


@dataclass(frozen=True)
class _Halpern:
    """The fused primal-dual method from least squares, ordering counted; a setting: iterations."""

    name: str = 'ours, primal-dual'

    def reach(self, problem: InnerProblem, costs: Sequence[float],
              limit: float) -> list[Setting | None]:
        """Look up in the history of a run that is long enough where each cost is reached."""
        deadline, count = time.monotonic() + limit, _FEWEST
        while True:
            solution = _halpern(problem, PrimalDualOptions(count, 0.0), limit)
            iterations, values = solution.history.T
            if values.min() <= min(costs) or time.monotonic() > deadline:
                break
            count *= 2
        return [int(iterations[np.argmax(values <= cost)]) or 1 if values.min() <= cost else None
                for cost in costs]

    def run(self, problem: InnerProblem, setting: Setting, limit: float) -> Answer:
        """Iterate that often."""
        assert isinstance(setting, int)
        return timed(lambda: _halpern(problem, PrimalDualOptions(setting, 0.0), limit).x)


def _halpern(problem: InnerProblem, options: PrimalDualOptions,
             limit: float) -> PrimalDualSolution:
    deadline, system = time.monotonic() + limit, problem.system
    x = weighted_least_squares(system, cholesky_of(problem.graph), np.ones(len(system.b)))
    r = system.times(x) - system.b
    return minimise_l1_halpern(system, x, np.clip(r / smoothing(r), -1, 1), options,
                               deadline=deadline)


def _interior_point(problem: InnerProblem, setting: Setting, limit: float) -> Answer:
    """Solve from least squares, ordering counted; it knows no time limit, and needs none."""
    assert isinstance(setting, float)
    system = problem.system

    def solve() -> Array:
        cholesky = cholesky_of(problem.graph)
        x = weighted_least_squares(system, cholesky, np.ones(len(system.b)))
        return interior_point(LinearProblem(system), x, cholesky, _STEPS, setting).poses

    return timed(solve)


INNER: tuple[LinearSolver, ...] = (
    ByIterations(PLAIN, _plain),
    ByIterations('Algorithm 2, primal weight', _weighted),
    _Halpern(),
    ByTolerance('ours, interior point', (TOLERANCES,), _interior_point),
)


def _l1(solver: str) -> GraphSolver:
    """Solve by one of `names.SOLVERS`, from given poses."""

    def solve(graph: FactorGraph, poses: Array) -> Array:
        return minimise_by(choose(solver, graph), graph, poses, OptimiserOptions())[0].poses

    return _from_poses(f'ours, L1 {solver}', solve)


def _l2(graph: FactorGraph, poses: Array) -> Array:
    options = LeastSquaresOptions(tolerance=SAME_TOLERANCE)
    return minimise_l2(graph, poses, options, cholesky_of(graph)).poses


def _seed(graph: FactorGraph, poses: Array) -> Array:
    """Return Algorithm 3's poses, which come from the graph alone."""
    return seed_of(graph)


def _seed_and_l1(graph: FactorGraph, poses: Array) -> Array:
    return seed_and_l1(graph)[1]


def seed_and_l1(graph: FactorGraph) -> tuple[Array, Array]:
    """Return the seed and the map, (n, p) each, by the default solver; one ordering for both."""
    method = choose(AUTO, graph)
    seed = seed_poses(graph, method.cholesky)
    return seed, minimise_by(method, graph, seed, OptimiserOptions())[0].poses


def _from_poses(name: str, solve: Callable[[FactorGraph, Array], Array]) -> GraphSolver:
    """Count all from the factor graph on; a copy of it brings nothing from the last run."""

    def prepare(case: Case, poses: Array) -> Callable[[], Answer]:
        def run() -> Answer:
            graph = case.graph.copy()
            return timed(lambda: solve(graph, poses))

        return run

    return GraphSolver(name, prepare)


DEFAULT = _l1(AUTO)
L2 = _from_poses('ours, L2', _l2)
WHOLE = (DEFAULT, _l1(INTERIOR_POINT), _l1(PRIMAL_DUAL), L2)
FROM_NOTHING = (_from_poses('ours, seed', _seed), _from_poses('ours, seed and L1', _seed_and_l1))


@dataclass(frozen=True)
class Iteration:
    """
    One iteration of a method on a problem.

    run : does so many iterations; bytes_per_edge : what one of them has to read and write for each
    edge of the problem, None where nobody counted.
    """

    name: str
    run: Callable[[InnerProblem, int], None]
    bytes_per_edge: Callable[[InnerProblem], float] | None = None


def _two_products(problem: InnerProblem, count: int) -> None:
    """Do Algorithm 2: two sparse products of SciPy and the updates of the vectors."""
    iterates = algorithm_2(problem, np.zeros(problem.A.shape[1]), 1.0)
    for _ in range(count):
        next(iterates)


def _fused(problem: InnerProblem, count: int) -> None:
    """Do the fused iteration, with a look every 40, as it is used."""
    x, y = np.zeros(problem.A.shape[1]), np.zeros(len(problem.b))
    minimise_l1_halpern(problem.system, x, y, PrimalDualOptions(count, 0.0))


def _fused_bytes(problem: InnerProblem) -> float:
    """
    Return the bytes of `native.halpern.iterate` for each edge.

    Read: both blocks, b, y and y0 in single precision, two 32-bit keyframes; written: y. For each
    keyframe x, z and g are read and written once by the sweep over keyframes, and z read and g
    written once, if the cache holds what neighbouring factors share.
    """
    k, edges = problem.system.block_size, len(problem.system.blocks)
    each_edge = 4 * (2 * k * k + 3 * k) + 4 * k + 2 * 4
    each_keyframe = 4 * k * 8
    return float(each_edge + each_keyframe * problem.system.size / edges)


ITERATIONS = (Iteration('SciPy, Algorithm 2', _two_products),
              Iteration('ours, fused', _fused, _fused_bytes))
