# SPDX-License-Identifier: Apache-2.0
"""
One run of a solver on a graph with lies, judged by what we compute from its poses.

In: cases and solvers. Out: `Run`, one for each. Each run is a process of its own, ended by the
system when it has used up its time: a solver that cannot be stopped is stopped all the same.
"""

import multiprocessing
import signal
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from measuring import report_progress
from robust_cases import FalseCase, Place, false_case
from robust_kinds import CLEAN, NOISIER
from robust_oracle import undecidable
from robust_solvers import Driven, Found, OnlineSolver, RobustSolver

from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.robust.innovation import chi2_quantile
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import AUTO, choose

# Where a solver is started: its poses (n, p) of a case.
STARTS: dict[str, Callable[[FalseCase], Array]] = {
    'odometry': lambda case: odometry_poses(case.graph),
    'seed': lambda case: seed_poses(case.graph, choose(AUTO, case.graph).cholesky),
    'stored': lambda case: case.place.stored,
}
# A solver that does not say what it believes believes the loops whose residual is no larger.
KEPT_PROBABILITY = 0.999
# [m] A map holds when it is no further from that of the clean graph.
HOLDS = {'intel': 0.05, 'manhattan3500': 0.3, 'city10000': 0.02}
# Parts of the false loops that may be kept, and of the true ones lost, where the loops are right.
MOST_KEPT, MOST_LOST = 0.002, 0.01
# Online: poses between two looks; the error may be so many times the clean run's, and so many
# metres more.
EVERY, TIMES, MORE = 50, 3.0, 0.5


@dataclass(frozen=True)
class Run:
    """
    What came of one run.

    seconds : None where the time was up, and then all else is empty; error : [m] to the map that
    the same solver makes of the clean graph, of an online run the mean of all looks to the truth;
    truth : [m] to the truth, None where it is not known; false, kept, true, lost : loops; holds,
    told : whether the map holds and whether the loops are told apart; numbers : what else.
    """

    graph: str
    kind: str
    share: float
    seed: int
    solver: str
    ours: bool
    seconds: float | None = None
    error: float | None = None
    truth: float | None = None
    false: int = 0
    kept: int = 0
    true: int = 0
    lost: int = 0
    holds: bool = False
    told: bool = False
    numbers: dict[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> tuple[str, str, float, int, str]:
        """What tells it from all others."""
        return self.graph, self.kind, self.share, self.seed, self.solver


def within(limit: float, work: Callable[[], Any]) -> Any:
    """Return what `work` returns, or None if its process took more than `limit` [s]."""
    context = multiprocessing.get_context('fork')
    here, there = context.Pipe(duplex=False)
    child = context.Process(target=_send, args=(there, limit, work))
    child.start()
    there.close()
    try:
        answer = here.recv()
    except EOFError:
        answer = None
    child.join()
    if isinstance(answer, Exception):
        raise answer
    return answer


def _send(there: Connection, limit: float, work: Callable[[], Any]) -> None:
    # No handler: the signal ends the process wherever it is, in a foreign library too.
    signal.setitimer(signal.ITIMER_PROF, limit)
    try:
        there.send(work())
    except Exception as error:
        there.send(error)


def measure(place: Place, kind: str, share: float, seeds: int,
            solvers: Sequence[RobustSolver | OnlineSolver], limit: float) -> list[Run]:
    """Return the runs of all seeds; a solver whose time was up does not run again."""
    runs: list[Run] = []
    left = list(solvers)
    for seed in range(1 if kind == CLEAN else seeds):
        report_progress(f'{place.name}, {kind} {share:.0%}, seed {seed}')
        case = false_case(place, kind, share, seed)
        for solver in tuple(left):
            run = (online_run(case, solver, limit) if isinstance(solver, OnlineSolver)
                   else batch_run(case, solver, limit))
            if run.seconds is None:
                left.remove(solver)
            runs.append(run)
    return runs


def merged(before: Iterable[Run], runs: Iterable[Run]) -> list[Run]:
    """Return all runs, the later where there are two of the same."""
    by_key = {run.key: run for run in (*before, *runs)}
    return [by_key[key] for key in sorted(by_key)]


def batch_run(case: FalseCase, solver: RobustSolver, limit: float) -> Run:
    """
    Return the run of a solver, judged by its own map of the clean graph.

    limit : [s] of start, building and solving together
    """
    reference = _clean_map(case, solver, limit)
    found = within(limit, lambda: solver.solve(case.graph, STARTS[solver.start](case)))
    if found is None or reference is None:
        return Run(*_name(case), solver.name, solver.ours)
    positions = case.graph.manifold.positions
    error = absolute_trajectory_error(positions(found.poses), positions(reference.poses))
    holds = error <= HOLDS.get(case.place.name, MORE) and not found.refused
    return _judged(case, solver, found, error, holds, _own_numbers(case, found, reference))


def _own_numbers(case: FalseCase, found: Found, clean: Found) -> dict[str, Any]:
    """Return what only a solver says that judges the factors."""
    if found.accepted is None or clean.accepted is None:
        return {}
    of_loops = ~case.clean.between.is_odometry
    numbers: dict[str, Any] = {'refused': found.refused,
                               'clean_lost': int((~clean.accepted & of_loops).sum())}
    if case.slip >= 0:
        numbers['named'] = case.slip in found.slips
    if case.kind in NOISIER:
        numbers['undecidable'] = undecidable(case)
    return numbers


def _clean_map(case: FalseCase, solver: RobustSolver, limit: float) -> Found | None:
    """Return what the solver makes of the clean graph, from the L2 map; None: no time left."""
    maps, name = case.place.maps, solver.name
    if case.clean is case.place.graph and name in maps:
        return maps[name]
    found: Found | None = within(limit, lambda: solver.solve(case.clean, case.place.best))
    if case.clean is case.place.graph:
        maps[name] = found
    return found


def online_run(case: FalseCase, solver: OnlineSolver, limit: float) -> Run:
    """Return the run of a back end, judged by its own run on the clean graph."""
    clean = within(limit, lambda: solver.drive(case.clean, EVERY))
    driven = within(limit, lambda: solver.drive(case.graph, EVERY))
    if driven is None or clean is None:
        return Run(*_name(case), solver.name, solver.ours)
    errors, before = _running(case, driven), _running(case, clean)
    over = float((errors - TIMES * before - MORE).max(initial=-MORE))
    numbers = {'largest': float(errors.max(initial=0)), 'over': over,
               'clean': float(before.mean()), 'clean_seconds': clean.seconds}
    found = Found(driven.last, driven.seconds, driven.accepted)
    return _judged(case, solver, found, float(errors.mean()), over <= 0, numbers)


def _running(case: FalseCase, driven: Driven) -> Array:
    """Return the error [m] of each map, to the truth or where nobody knows it, to the L2 map."""
    positions = case.graph.manifold.positions
    truth = positions(case.place.best) if case.place.truth is None else case.place.truth
    return np.array([absolute_trajectory_error(positions(poses), truth[: len(poses)])
                     for poses in driven.maps])


def _judged(case: FalseCase, solver: RobustSolver | OnlineSolver, found: Found, error: float,
            holds: bool, numbers: dict[str, Any]) -> Run:
    graph, is_false = case.graph, case.is_false
    is_loop = ~graph.between.is_odometry
    accepted = fitting(graph, found.poses) if found.accepted is None else found.accepted
    kept, lost = int((accepted & is_false).sum()), int((~accepted & is_loop & ~is_false).sum())
    false, true = int(is_false.sum()), int((is_loop & ~is_false).sum())
    truth = case.place.truth
    to_truth = None if truth is None else absolute_trajectory_error(
        graph.manifold.positions(found.poses), truth)
    told = kept <= MOST_KEPT * false and lost <= MOST_LOST * true
    return Run(*_name(case), solver.name, solver.ours, found.seconds, error, to_truth, false,
               kept, true, lost, bool(holds), told, numbers)


def fitting(graph: FactorGraph, poses: Array) -> Mask:
    """Return which between factors agree with poses (n, p), (m,) bool."""
    k, count = graph.manifold.TANGENT_SIZE, len(graph.between)
    rows = whitened_residual(graph, poses)[: count * k].reshape(count, k)
    fits: Mask = (rows**2).sum(axis=1) < chi2_quantile(KEPT_PROBABILITY, k)
    return fits


def _name(case: FalseCase) -> tuple[str, str, float, int]:
    return case.place.name, case.kind, case.share, case.seed
