# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The solvers by name, and the choice of a solver for a graph.

In: a graph and poses. Out: the solution, the name of its solver, and why that was chosen.
"""

from dataclasses import dataclass
from typing import Protocol

from l1slam_ros.core.errors import FillError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.memory import Needs
from l1slam_ros.core.names import NORMS, SAME, SOLVERS
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky, Pattern, cholesky_of
from l1slam_ros.core.solvers.block_cholesky import needs as needs_of
from l1slam_ros.core.solvers.exact import minimise_interior_point
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, gauss_newton
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, Report, Solution, minimise
from l1slam_ros.core.solvers.optimality import Mixed, SmoothNorm, Status, norm_of
from l1slam_ros.core.solvers.primal_dual_newton import minimise_norm

AUTO, PRIMAL_DUAL, INTERIOR_POINT, *_ = SOLVERS
L1_NORM, GROUP_L1_NORM, *_ = NORMS
# The solvers of other norms.
GAUSS_NEWTON, PRIMAL_DUAL_NEWTON = 'gauss-newton', 'primal-dual-newton'
# Seconds of the primal-dual method for a factor and entry of its Jacobian, some 14,000 passes over
# the factors; on a large graph it takes more of them, as that is wider: so many times as often as
# the keyframes beyond this number.
_SECONDS_OF_PASSES = 1.6e-5
_WIDE = 50_000
# Why a solver was chosen.
_SPARSE = 'the graph is sparse'
_DENSE = 'the graph is dense'


class L1Solver(Protocol):
    """A method for the L1 norm; arguments and result as those of `nonlinear.minimise`."""

    def __call__(self, graph: FactorGraph, poses: Array, options: OptimiserOptions,
                 cholesky: BlockCholesky, *, report: Report) -> Solution:
        """Return poses of lower cost; cholesky : of the graph."""


# Each of `names.SOLVERS` but `auto`.
L1_SOLVERS: dict[str, L1Solver] = {
    PRIMAL_DUAL: minimise,
    INTERIOR_POINT: minimise_interior_point,
}


@dataclass(frozen=True)
class Method:
    """
    The solver of a graph.

    cholesky : of the graph, None where it does not fit into memory; solver : of `SOLVERS`, not
    `auto`; reason : a clause that says why; falls_back : another solver may go on where it fails;
    norm : what is minimised of odometry; loop_norm : of all else; needs : what an exact L1 map
    takes, None where another method was chosen.
    """

    cholesky: BlockCholesky | None
    solver: str
    reason: str
    falls_back: bool = False
    norm: str = L1_NORM
    loop_norm: str = SAME
    needs: Needs | None = None


def norm_for(graph: FactorGraph, norm: str, loop_norm: str, delta: float) -> SmoothNorm:
    """
    Return what is minimised of the odometry and of all other factors; delta : of Huber.

    L2 and Huber count half where they are mixed with another norm: at one sigma a factor then
    pulls as hard as in L1, and of normal noise they are the log density.
    """
    k, is_odometry = graph.manifold.TANGENT_SIZE, graph.between.is_odometry
    if loop_norm in (SAME, norm):
        return norm_of(norm, k, delta)
    return Mixed(((norm_of(norm, k, delta, 0.5), is_odometry),
                  (norm_of(loop_norm, k, delta, 0.5), ~is_odometry)))


def choose(solver: str, graph: FactorGraph, norm: str = L1_NORM, loop_norm: str = SAME,
           before: Pattern | None = None) -> Method:
    """
    Resolve one of `SOLVERS`: `auto` goes by predicted memory and time.

    Norms other than L1 have one solver each, and mixed ones another. before : see `find_pattern`

    Raises
    ------
    FillError : what was asked for needs a factorisation, and that does not fit into memory.

    """
    if loop_norm not in (SAME, norm):
        return Method(cholesky_of(graph), PRIMAL_DUAL_NEWTON,
                      f'the norm is {norm}, of loops {loop_norm}', False, norm, loop_norm)
    if norm != L1_NORM:
        found_by = PRIMAL_DUAL_NEWTON if norm == GROUP_L1_NORM else GAUSS_NEWTON
        return Method(cholesky_of(graph), found_by, f'the norm is {norm}', norm=norm)
    try:
        cholesky = cholesky_of(graph, before)
    except FillError as error:
        if solver not in (AUTO, PRIMAL_DUAL):
            raise
        return Method(None, PRIMAL_DUAL, str(error))
    needs = needs_of(graph, cholesky.pattern.blocks, cholesky.pattern.work)
    if solver != AUTO:
        return Method(cholesky, solver, 'asked for',
                      needs=needs if solver == INTERIOR_POINT else None)
    passes = (_SECONDS_OF_PASSES * graph.manifold.TANGENT_SIZE**2 * len(graph.between)
              * max(1.0, graph.n_poses / _WIDE))
    if needs.seconds <= passes:
        return Method(cholesky, INTERIOR_POINT, _SPARSE, falls_back=True, needs=needs)
    return Method(cholesky, PRIMAL_DUAL, _DENSE, falls_back=True)


def minimise_by(
    method: Method, graph: FactorGraph, poses: Array, options: OptimiserOptions,
    report: Report = lambda iteration, cost: None,
    least_squares: LeastSquaresOptions | None = None,
) -> tuple[Solution, str]:
    """
    Minimise the norm of the whitened residuals; return the solution and what found it.

    Where nobody asked for the interior point and it does not converge, Algorithm 4 goes on from
    its best poses.
    """
    cholesky = method.cholesky
    least_squares = least_squares or LeastSquaresOptions()
    norm = norm_for(graph, method.norm, method.loop_norm, least_squares.huber_delta)
    if cholesky and method.solver == PRIMAL_DUAL_NEWTON:
        return minimise_norm(graph, poses, norm, options, cholesky, report), method.solver
    if cholesky and method.solver == GAUSS_NEWTON:
        return gauss_newton(graph, poses, norm, least_squares, cholesky, report), method.solver
    if method.solver == PRIMAL_DUAL or cholesky is None:
        return minimise(graph, poses, options, cholesky, report=report), PRIMAL_DUAL
    solution = L1_SOLVERS[method.solver](graph, poses, options, cholesky, report=report)
    content = solution.status is Status.CONVERGED or not options.outer_iterations
    if content or not method.falls_back:
        return solution, method.solver
    return minimise(graph, solution.poses, options, cholesky, report=report), PRIMAL_DUAL
