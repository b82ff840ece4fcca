# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
One run of a solver on a graph with lies, judged by what we compute from its poses.

In: cases and solvers. Out: `Run`, one for each. Each run is a process of its own, ended by the
system when it has used up its time: a solver that cannot be stopped is stopped all the same.
"""

import multiprocessing
import signal
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from measuring import report_progress
from robust.cases import FalseCase, false_case
from robust.kinds import (
    EXCUSES,
    EXCUSES_LOST,
    HOLDS,
    HOLDS_ELSEWHERE,
    MUST,
    NEVER,
    ODOMETRY,
    Bar,
    Kind,
)
from robust.places import Place, error_by_time
from robust.solvers import DOUBTFUL, REFUSED, Found, RobustSolver
from robust.variants import VARIANTS
from scipy.stats import chi2

from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph, component_labels
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import AUTO, choose, minimise_by

# Where a solver is started: its poses (n, p) of a case.
STARTS: dict[str, Callable[[FalseCase], Array]] = {
    'odometry': lambda case: case.start,
    'seed': lambda case: seed_poses(case.graph, choose(AUTO, case.graph).cholesky),
    'stored': lambda case: case.start if case.place.stored is None else case.place.stored,
}
# A solver that does not say what it believes believes the loops whose residual is no larger.
KEPT_PROBABILITY = 0.999
# [m] No map on the way is by more worse than that of the odometry.
WORSE = 1.0


@dataclass(frozen=True)
class Run:
    """
    What came of one run.

    seconds : None where the time was up, and then all else is empty; error : [m] to the truth of a
    recording, else to the map of all true loops in the solver's norm; truth : [m] to the truth,
    None where it is not known; false, kept, true, lost : loops; slips, named : odometry factors
    that lie, and those that are said to; wrongly : which of these do not; parts : that what is
    believed leaves; status, why : the solver's own word; right : the map is right; passed : the
    bar; way, worse : of a running back end, mean error [m] on the way, and by how much a map was
    worse than the odometry at most.
    """

    suite: str
    graph: str
    kind: str
    share: float
    seed: int
    solver: str
    seconds: float | None = None
    error: float | None = None
    truth: float | None = None
    false: int = 0
    kept: int = 0
    true: int = 0
    lost: int = 0
    slips: int = 0
    named: int = 0
    wrongly: int = 0
    parts: int = 1
    status: str = ''
    why: str = ''
    way: float | None = None
    worse: float | None = None
    right: bool = False
    passed: bool = False

    @property
    def key(self) -> tuple[str, str, str, float, int, str]:
        """What tells it from all others."""
        return self.suite, self.graph, self.kind, self.share, self.seed, self.solver

    def __str__(self) -> str:
        """Return one line."""
        head = (f'{"pass" if self.passed else "FAIL"}  {self.graph} {self.kind} {self.share:.0%} '
                f'seed {self.seed}  {self.solver}: ')
        if self.seconds is None or self.error is None:
            return head + 'the time was up'
        return head + ', '.join((
            f'kept {self.kept}/{self.false}', f'lost {self.lost}/{self.true}',
            f'slips {self.named - self.wrongly}/{self.slips}'
            + (f' and {self.wrongly} wrong' if self.wrongly else ''),
            f'{self.parts} part{"s" * (self.parts > 1)}', f'error {self.error:.4f} m',
            *([] if self.truth is None else [f'to truth {self.truth:.3f} m']),
            *([] if self.worse is None else [f'on the way {self.worse:+.2f} m']),
            f'{self.seconds:.2f} s', f'{self.status or "says nothing"} {self.why}'.rstrip()))


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


def measure(place: Place, kind: Kind, share: float, seeds: Iterable[int],
            solvers: Sequence[RobustSolver], limit: float) -> list[Run]:
    """Return the runs of all seeds; a solver whose time was up does not run again."""
    runs: list[Run] = []
    left = list(solvers)
    drawn = kind.lies or kind.change not in ('', *VARIANTS)
    for seed in seeds if drawn else (0,):
        case = false_case(place, kind, share, seed)
        for solver in tuple(left):
            # A back end is fed by one odometry without a gap.
            if solver.online and kind.suite == 'sessions':
                continue
            run = run_of(case, solver, limit)
            report_progress(str(run))
            if run.seconds is None:
                left.remove(solver)
            runs.append(run)
    return runs


def merged(before: Iterable[Run], runs: Iterable[Run]) -> list[Run]:
    """Return all runs, the later where there are two of the same."""
    by_key = {run.key: run for run in (*before, *runs)}
    return [by_key[key] for key in sorted(by_key)]


def run_of(case: FalseCase, solver: RobustSolver, limit: float) -> Run:
    """Return the run of a solver; limit : [s] of its start and the solving together."""
    name = (case.kind.suite, case.place.name, case.kind.name, case.share, case.seed, solver.name)
    found = within(limit, lambda: solver.solve(case.graph, STARTS[solver.start](case)))
    if found is None:
        return Run(*name)
    return judged(name, case, found, error_of(case, solver.norm, found.poses))


def judged(name: tuple[str, str, str, float, int, str], case: FalseCase, found: Found,
           error: float) -> Run:
    """Return the run, by the counts of its loops and the bar of the case."""
    graph = case.graph
    bar = case.bar
    judges = found.accepted is not None
    accepted = fitting(graph, found.poses) if found.accepted is None else found.accepted
    kept, lost = ((accepted & case.is_false).sum(), (~accepted & case.is_true).sum())
    wrongly = len(set(found.slips) - set(case.slips.tolist()))
    parts = int(component_labels(graph.subset(accepted)).max()) + 1 if judges else 1
    known = case.place.truth_error
    way, worse = _on_the_way(case, found) if found.maps and case.place.timed else (None, None)
    # Beside a slip its neighbour may be named: what counts then is the map.
    honest = (kept <= bar.kept * case.is_false.sum() and found.status != REFUSED
              and (not wrongly or len(case.slips) > 0))
    whole = not judges or parts == case.session.max() + 1
    most = (error_of(case, 'l2', case.start) if bar.error == ODOMETRY
            else HOLDS.get(case.place.name, HOLDS_ELSEWHERE) if bar.error is None
            else float(bar.error))
    near = (error <= most and lost <= bar.lost * case.is_true.sum() and whole
            and (worse is None or worse <= WORSE))
    return Run(
        *name, found.seconds, error,
        None if known is None else known(graph.manifold.positions(found.poses)),
        int(case.is_false.sum()), int(kept), int(case.is_true.sum()), int(lost), len(case.slips),
        len(found.slips), wrongly, parts, found.status, found.why, way, worse,
        bool(honest and near), bool(_passes(bar, honest, near, found.status == DOUBTFUL)))


def _passes(bar: Bar, honest: bool, near: bool, doubtful: bool) -> bool:
    """Tell whether a run passes; what each word on doubt means, `kinds` says."""
    if bar.doubt == MUST:
        return doubtful
    if bar.doubt == EXCUSES and doubtful:
        return True
    if bar.doubt == EXCUSES_LOST and doubtful:
        return honest
    return honest and near and not (bar.doubt == NEVER and doubtful)


def error_of(case: FalseCase, norm: str, poses: Array) -> float:
    """Return the error [m] of poses (n, p), of the worst of the sessions that nothing joins."""
    positions = case.graph.manifold.positions
    if case.kind.suite in ('recorded', 'variants') and case.place.truth_error is not None:
        return case.place.truth_error(positions(poses))
    best = positions(true_map(case.clean, case.place, norm))
    return case.place.unit * max(
        absolute_trajectory_error(positions(poses)[case.session == k], best[case.session == k])
        for k in range(case.session.max() + 1))


def true_map(clean: FactorGraph, place: Place, norm: str) -> Array:
    """Return the map (n, p) of a graph all of whose loops are true."""
    least = minimise_l2(clean, place.best, LeastSquaresOptions(), cholesky_of(clean)).poses
    if norm == 'l2':
        return least
    return minimise_by(choose(AUTO, clean), clean, least, OptimiserOptions())[0].poses


def _on_the_way(case: FalseCase, found: Found) -> tuple[float, float]:
    """Return the mean error [m] of the maps, and by how much one was worse than the odometry."""
    positions, place = case.graph.manifold.positions, case.place
    error = place.truth_error or error_by_time(positions(place.best))
    errors = np.array([error(positions(poses)) for poses in found.maps])
    odometry = np.array([error(positions(case.start[: len(poses)])) for poses in found.maps])
    return float(errors.mean()), float((errors - odometry).max())


def fitting(graph: FactorGraph, poses: Array) -> Mask:
    """Return which between factors agree with poses (n, p), (m,) bool."""
    k, count = graph.manifold.TANGENT_SIZE, len(graph.between)
    rows = whitened_residual(graph, poses)[: count * k].reshape(count, k)
    fits: Mask = (rows**2).sum(axis=1) < chi2.ppf(KEPT_PROBABILITY, k)
    return fits
