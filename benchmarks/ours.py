# SPDX-License-Identifier: Apache-2.0
"""
Our own solvers, as the measurements call them: the only module that knows their names.

`INNER` are those of one linear problem, `WHOLE` those of a whole graph, and `ITERATIONS` a single
iteration, for the comparison with the bytes that it has to move.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from graph_solvers import SAME_TOLERANCE, GraphSolver
from linear_solvers import ByIterations, ByTolerance, LinearSolver, Setting
from measuring import Answer, timed
from problems import Case, InnerProblem

from l1slam_ros.core.choice import AUTO, INTERIOR_POINT, PRIMAL_DUAL, minimise_by
from l1slam_ros.core.graph import FactorGraph
from l1slam_ros.core.l2 import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.least_squares import reweighted_start, weighted_least_squares
from l1slam_ros.core.manifold import Array
from l1slam_ros.core.optimiser import OptimiserOptions
from l1slam_ros.core.primal_dual import (
    PrimalDualOptions,
    diagonal_step_sizes,
    minimise_l1,
    primal_dual,
    primal_weight,
)
from l1slam_ros.core.seed import seed_poses

# What the ratios of the inner problems are to.
PLAIN = 'Algorithm 2, plain'
# More than any limit lets it take.
_MANY = 10**7


def algorithm_2(problem: InnerProblem, x: Array, omega: float) -> Iterator[Array]:
    """Yield the x of Algorithm 2 as the paper has it (omega = 1), on SciPy's sparse products."""
    tau, sigma = diagonal_step_sizes(problem.A)
    tau, sigma = tau / omega, sigma * omega
    sigma_b = sigma * problem.b
    for x, _ in primal_dual(problem.A, lambda v: np.clip(v - sigma_b, -1, 1), lambda v: v,
                            x, np.zeros(len(problem.b)), tau, sigma):
        yield x


def _plain(problem: InnerProblem) -> Iterator[Array]:
    yield from algorithm_2(problem, weighted_least_squares(problem.A, problem.b), 1.0)


def _weighted(problem: InnerProblem) -> Iterator[Array]:
    x = weighted_least_squares(problem.A, problem.b)
    yield from algorithm_2(problem, x, primal_weight(problem.A, problem.b, x))


def _reweighted(problem: InnerProblem, setting: Setting, limit: float) -> Answer:
    """Solve as the package does: from reweighted least squares, x and y."""
    assert isinstance(setting, float)
    A, b, options = problem.A, problem.b, PrimalDualOptions(_MANY, setting)
    deadline = time.monotonic() + limit
    return timed(lambda: minimise_l1(A, b, *reweighted_start(A, b), options, deadline).x)


INNER: tuple[LinearSolver, ...] = (
    ByIterations(PLAIN, _plain),
    ByIterations('Algorithm 2, primal weight', _weighted),
    ByTolerance('Algorithm 2, reweighted start', (tuple(10.0**-k for k in range(1, 8)),),
                _reweighted),
)


def _l1(solver: str) -> GraphSolver:
    """Solve by one of `choice.SOLVERS`, from given poses."""
    return _from_poses(f'ours, L1 {solver}', lambda graph, poses: minimise_by(
        solver, graph, poses, OptimiserOptions())[0].poses)


def _l2(graph: FactorGraph, poses: Array) -> Array:
    return minimise_l2(graph, poses, LeastSquaresOptions(tolerance=SAME_TOLERANCE)).poses


def _seed(graph: FactorGraph, poses: Array) -> Array:
    """Return Algorithm 3's poses, which come from the graph alone."""
    return seed_poses(graph)


def _seed_and_l1(graph: FactorGraph, poses: Array) -> Array:
    return minimise_by(AUTO, graph, seed_poses(graph), OptimiserOptions())[0].poses


def _from_poses(name: str, solve: Callable[[FactorGraph, Array], Array]) -> GraphSolver:
    """Count all from the factor graph on; a copy of it brings nothing from the last run."""

    def prepare(case: Case, poses: Array) -> Callable[[], Answer]:
        def run() -> Answer:
            graph = case.graph.copy()
            return timed(lambda: solve(graph, poses))

        return run

    return GraphSolver(name, prepare)


DEFAULT = _l1(AUTO)
WHOLE = (DEFAULT, _l1(INTERIOR_POINT), _l1(PRIMAL_DUAL), _from_poses('ours, L2', _l2))
FROM_NOTHING = (_from_poses('ours, seed', _seed), _from_poses('ours, seed and L1', _seed_and_l1))


@dataclass(frozen=True)
class Iteration:
    """
    One iteration of a method on a problem.

    start : problem -> a function that does so many iterations; bytes_per_edge : what one of them
    has to read and write for each edge, None where nobody counted.
    """

    name: str
    start: Callable[[InnerProblem], Callable[[int], None]]
    bytes_per_edge: float | None = None


def _two_products(problem: InnerProblem) -> Callable[[int], None]:
    """Do Algorithm 2: two sparse products of SciPy and the updates of the vectors."""
    iterates = algorithm_2(problem, np.zeros(problem.A.shape[1]), 1.0)

    def iterate(count: int) -> None:
        for _ in range(count):
            next(iterates)

    return iterate


ITERATIONS = (Iteration('SciPy, Algorithm 2', _two_products),)
