# SPDX-License-Identifier: Apache-2.0
"""Solvers of graphs with false loops: what they are to the measurements, and our own."""

from collections.abc import Callable
from dataclasses import dataclass

import incremental
import numpy as np
from measuring import clock

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.spanning_tree import odometry_poses, pair_key
from l1slam_ros.core.online.backend import Backend, BackendOptions
from l1slam_ros.core.online.graph_builder import GraphBuilderOptions
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.online.loop_states import ACCEPTED
from l1slam_ros.core.robust.judgement import INCONSISTENT
from l1slam_ros.core.robust.robust_map import minimise_robustly
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, Solution
from l1slam_ros.core.solvers.solve import AUTO, choose, minimise_by
from l1slam_ros.io.graphs.graph_file import GraphRecord

# Online: an update after so many keyframes, for so long [s].
_EVERY, _BUDGET = 10, 0.1
# Updates after the last keyframe, to settle what has waited.
_LAST_UPDATES, _LAST_BUDGET = 5, 0.5


@dataclass(frozen=True)
class Found:
    """
    A map and what it took.

    poses : (n, p); seconds : [s]; accepted : (m,) bool, None where the solver does not say;
    slips : rows of odometry factors it takes for lies; refused : it says that there is no map.
    """

    poses: Array
    seconds: float
    accepted: Mask | None = None
    slips: tuple[int, ...] = ()
    refused: bool = False


@dataclass(frozen=True)
class RobustSolver:
    """start : of `robust_runs.STARTS`; solve : from a graph and poses (n, p) to what it found."""

    name: str
    ours: bool
    start: str
    solve: Callable[[FactorGraph, Array], Found]


@dataclass(frozen=True)
class Driven:
    """
    What a back end did.

    maps : (k, p) each, at the times asked for; last : (n, p) at the end; seconds : of all updates;
    accepted : (m,) bool at the end, None where it does not say.
    """

    maps: list[Array]
    last: Array
    seconds: float
    accepted: Mask | None = None


@dataclass(frozen=True)
class OnlineSolver:
    """drive : a graph in order of time, after how many poses its map is asked for each time."""

    name: str
    ours: bool
    drive: Callable[[FactorGraph, int], Driven]


def _l1(graph: FactorGraph, poses: Array) -> Solution:
    return minimise_by(choose(AUTO, graph), graph, poses, OptimiserOptions())[0]


def _l2(graph: FactorGraph, poses: Array) -> Solution:
    return minimise_l2(graph, poses, LeastSquaresOptions(), cholesky_of(graph))


def _robust(
    minimise: Callable[[FactorGraph, Array], Solution]
) -> Callable[[FactorGraph, Array], Found]:
    """Count all from the factor graph on; the poses are not looked at."""

    def solve(graph: FactorGraph, poses: Array) -> Found:
        began = clock()
        found = minimise_robustly(graph, minimise)
        if found.judgement.doubt and found.judgement.doubt.kind == INCONSISTENT:
            return Found(odometry_poses(graph), clock() - began, graph.between.is_odometry.copy(),
                         refused=True)
        return Found(found.solution.poses, clock() - began, found.judgement.accepted,
                     tuple(found.judgement.slips.tolist()))

    return solve


OURS = (RobustSolver('ours, L1', True, 'odometry', _robust(_l1)),
        RobustSolver('ours, L2', True, 'odometry', _robust(_l2)))


def _drive(graph: FactorGraph, every: int) -> Driven:
    """Feed the back end as the node does, robust as it is by default."""
    growth = GraphBuilderOptions(KeyframeOptions(0.0, 0.0, 0.0), OdometryOptions('increment'))
    backend = Backend(BackendOptions(growth.keyframe, growth.odometry, growth.loop))
    record = GraphRecord(graph, None, np.arange(graph.n_poses))
    maps, seconds = [], 0.0
    for k, (sample, loops) in enumerate(incremental.measurements(record), 1):
        backend.add_odometry(sample)
        for loop in loops:
            backend.add_loop(loop)
        if k % _EVERY == 0:
            seconds += _updated(backend, _BUDGET)
        if k % every == 0:
            maps.append(backend.poses)
    for _ in range(_LAST_UPDATES):
        seconds += _updated(backend, _LAST_BUDGET)
    return Driven(maps, backend.poses, seconds, _accepted(backend, graph))


def _updated(backend: Backend, budget: float) -> float:
    began = clock()
    backend.update(budget)
    return clock() - began


def _accepted(backend: Backend, graph: FactorGraph) -> Mask:
    """Return which factors of the graph, whose rows have another order, the back end uses."""
    states, grown = backend.loop_states(), backend.snapshot().graph
    is_accepted = states.state[: len(states.rows)] == ACCEPTED
    accepted = graph.between.is_odometry.copy()
    accepted[_by_pair(graph, np.flatnonzero(~accepted))] = is_accepted[
        np.argsort(_pairs(grown, states.rows), kind='stable')]
    return accepted


def _pairs(graph: FactorGraph, rows: Indices) -> Indices:
    factors = graph.between
    return pair_key(factors.i[rows], factors.j[rows], graph.n_poses)


def _by_pair(graph: FactorGraph, rows: Indices) -> Indices:
    """Return the rows by their pairs, those of one pair in their order."""
    ordered: Indices = rows[np.argsort(_pairs(graph, rows), kind='stable')]
    return ordered


ONLINE_OURS = (OnlineSolver('ours, online', True, _drive),)
