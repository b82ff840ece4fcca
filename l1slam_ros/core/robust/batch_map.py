# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Solve a whole graph in a given norm, robustly or with all loops.

In: a graph, its stored poses, if any, and options. Out: the solution, its solver, and the
judgement of the loops.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph, component_labels
from l1slam_ros.core.graph.landmarks import by_first_sightings
from l1slam_ros.core.graph.linear_system import linearise, whitened_residual
from l1slam_ros.core.graph.parts import (
    bridged,
    initial_poses,
    odometry_gaps,
    part_labels,
    require_connected,
)
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.names import SAME
from l1slam_ros.core.robust.as_measured import OnRound
from l1slam_ros.core.robust.batch import RobustMap, minimise_robustly
from l1slam_ros.core.robust.inspection import FEWEST, densest_part, lacked_step
from l1slam_ros.core.robust.judgement import UNSOLVED, Judgement
from l1slam_ros.core.robust.odometry.drift import straightened
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, Report, Solution
from l1slam_ros.core.solvers.seed import first_poses, seed_poses
from l1slam_ros.core.solvers.solve import (
    AUTO,
    GAUSS_NEWTON,
    PRIMAL_DUAL,
    Method,
    choose,
    minimise_by,
    norm_for,
)

# With more gaps than this part of its steps, a graph has no usable odometry.
_MOST_GAPS = 0.1


@dataclass(frozen=True)
class SolveOptions:
    """
    Options of a solve; see `core.names`.

    solver : for L1; robust : reject outlier loops, None: if there is odometry to judge them by
    """

    start: str = 'seed'
    norm: str = 'l1'
    loop_norm: str = SAME
    solver: str = AUTO
    robust: bool | None = None
    options: OptimiserOptions = OptimiserOptions()
    least_squares: LeastSquaresOptions = LeastSquaresOptions()


@dataclass(frozen=True)
class Outcome:
    """
    Result of `solve`; costs are in the given norm.

    Attributes
    ----------
    solver, reason : its name, and a clause why
    seed_cost : None without a seed
    judgement : of a robust solve, whose costs count accepted factors
    unjudged : why loops were not judged though options allow it, else empty
    parts : number of connected components
    offset : see `shared_offset`

    """

    solution: Solution
    solver: str
    reason: str
    initial_cost: float
    seed_cost: float | None
    seconds: float
    judgement: Judgement | None
    unjudged: str
    parts: int
    offset: Array | None


def solve(
    graph: FactorGraph, stored: Array | None, asked: SolveOptions,
    report: Report = lambda iteration, cost: None,
    on_round: OnRound = lambda round_, accepted: None, ids: Indices | None = None,
    on_choice: Callable[[Method], None] = lambda method: None,
) -> Outcome:
    """
    Solve a graph; seconds: solving alone.

    Parameters
    ----------
    stored : (n, p) poses to start from with `start='file'`, and of the initial cost; None: those
        of the odometry, or with gaps, of a tree
    report : called with each iteration and its cost
    on_round : see `robust_solve`
    ids : (n,) names of keyframes in errors; None: their numbers
    on_choice : called with the method

    Raises
    ------
    GraphError : the graph lacks this start, or its numbers leave double precision; or it is not
        connected and loops are not to be judged.

    """
    ids = np.arange(graph.n_poses) if ids is None else ids
    whole = graph
    graph = graph.without_struck()  # struck factors are never used
    initial = _initial(graph, stored, asked, ids)
    seed = None
    minimiser = _Minimiser(asked, report, on_choice)
    began = time.perf_counter()
    robust, unjudged = _robust_map(graph, asked, minimiser, on_round, ids)
    if robust:
        solution, seed = robust.solution, robust.seed
        graph = straightened(graph, robust.judgement.drift).subset(robust.judgement.accepted)
    else:
        method = minimiser.choose(graph)
        seed = _seed(graph, method) if asked.start == 'seed' else None
        solution = minimiser.minimise_by(method, graph, initial if seed is None else seed)
    seconds = time.perf_counter() - began
    norm = norm_for(graph, asked.norm, asked.loop_norm, asked.least_squares.huber_delta)

    def cost(poses: Array) -> float:
        return norm.cost(whitened_residual(graph, poses))

    seed_cost = None if seed is None else cost(seed)
    if robust:
        # Cost in the given norm with stated noise, whatever was assumed or failed.
        solution = replace(solution, cost=cost(solution.poses))
    if not np.isfinite([cost(initial), seed_cost or 0.0, solution.cost]).all():
        raise GraphError('the cost leaves double precision: measurements and information of the '
                         'graph are too large, or too different from each other')
    judgement = robust.judgement.of_all(whole).with_parts(whole) if robust else None
    labels = part_labels if robust else component_labels
    offset = shared_offset(whole, solution.poses, judgement) if judgement else None
    return Outcome(solution, minimiser.solver, minimiser.reason, cost(initial), seed_cost, seconds,
                   judgement, unjudged, int(labels(graph).max()) + 1, offset)


def _seed(graph: FactorGraph, method: Method) -> Array:
    """Return the initial poses of a solve; for the paper's Algorithm 4 by its Algorithm 3."""
    if method.cholesky is None or method.solver == PRIMAL_DUAL:
        return seed_poses(graph, method.cholesky)
    return first_poses(graph, method.cholesky)


def _robust_map(graph: FactorGraph, asked: SolveOptions, minimiser: '_Minimiser',
                on_round: OnRound, ids: Indices) -> tuple[RobustMap | None, str]:
    """Return the robust map, or None and, if the options left it open, why."""
    # A robot's first keyframe has no odometry before it; that is no gap.
    unjudged = ''
    gaps = np.setdiff1d(odometry_gaps(graph), graph.firsts - 1)
    if asked.robust is None and len(gaps) > _MOST_GAPS * (graph.n_poses - 1):
        unjudged = f'{_no_edge(ids, gaps)} to judge loops by'
    elif asked.robust is not False:
        robust = minimise_robustly(graph, minimiser.minimise, on_round)
        if any(doubt.kind == UNSOLVED for doubt in robust.judgement.doubts):
            minimiser.fail()
        return robust, ''
    require_connected(graph, ids)
    return None, unjudged


class _Minimiser:
    """Minimises the given norm; solver, reason : the last used, and why."""

    def __init__(self, asked: SolveOptions, report: Report, on_choice: Callable[[Method], None]):
        self._asked = asked
        self._report = report
        self._on_choice = on_choice
        self.solver = self.reason = ''

    def choose(self, graph: FactorGraph) -> Method:
        method = choose(self._asked.solver, graph, self._asked.norm, self._asked.loop_norm)
        self._on_choice(method)
        return method

    def minimise(self, graph: FactorGraph, poses: Array) -> Solution:
        return self.minimise_by(self.choose(graph), graph, poses)

    def minimise_by(self, method: Method, graph: FactorGraph, poses: Array) -> Solution:
        asked = self._asked
        self.solver = method.solver
        self.reason = method.reason
        solution, self.solver = minimise_by(method, graph, poses, asked.options, self._report,
                                            asked.least_squares)
        if self.solver != method.solver:
            self.reason = f'it went on where {method.solver} came no further'
        return solution

    def fail(self) -> None:
        """Note that the L2 map of the judgement stands in."""
        self.solver = GAUSS_NEWTON
        self.reason = 'the loops were judged by its map'


def shared_offset(graph: FactorGraph, poses: Array, judgement: Judgement) -> Array | None:
    """Return the step (k,) that accepted loops lack in a map (n, p); see `lacked_step`."""
    variance = judgement.found_variance(graph)
    part, keyframes, is_loop = densest_part(
        judgement.believed(graph).subset(np.arange(len(variance)), variance))
    if (len(part.between) - part.n_poses) * graph.manifold.TANGENT_SIZE < FEWEST:
        return None
    cholesky = cholesky_of(part)
    system = linearise(part, poses[keyframes])
    if not cholesky.factorise(system, np.ones_like(system.b)):
        return None

    def left_of(b: Array) -> Array:
        return np.stack([one - system.times(cholesky.solve(system.transposed_times(one)))
                         for one in np.ascontiguousarray(b.T)], axis=1)

    return lacked_step(part, is_loop, system.b, np.ones(2), left_of)


def _initial(graph: FactorGraph, stored: Array | None, asked: SolveOptions,
             ids: Indices) -> Array:
    """Return the poses to start from, or of the initial cost, (n, p)."""
    way, number = by_first_sightings(graph)
    order = np.argsort(number)
    _require_start(way, stored, asked, ids[order])
    if asked.start == 'odometry':
        return odometry_poses(way)[number]
    return initial_poses(way if asked.robust is False else bridged(way),
                         None if stored is None else stored[order], ids[order])[number]


def _require_start(graph: FactorGraph, stored: Array | None, asked: SolveOptions,
                   ids: Indices) -> None:
    if asked.robust is False:
        require_connected(graph, ids)
    if asked.start == 'file' and stored is None:
        raise GraphError('the input stores no poses to start from; expected --start seed or '
                         'odometry')
    if asked.start == 'odometry':
        gaps = odometry_gaps(graph)
        if len(gaps):
            raise GraphError(f'{_no_edge(ids, gaps)} to start from; expected --start seed')


def _no_edge(ids: Indices, gaps: Indices) -> str:
    return (f'no edge between the consecutive vertices {ids[gaps[0]]} and {ids[gaps[0] + 1]}, so '
            'no chain of odometry')
