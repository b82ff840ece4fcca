# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Maps that survive lies: which factors to rely on, by growing outward from the odometry.

In: a graph, of which nothing is accepted but the odometry and the trusted loops. Out: the loops
that are accepted, and the L2 map of these. It is the inference of this model:

Noise
    What a file states of its noise may be off by a constant, one for odometry and one for loops:
    `gating.noise_variance` finds both from the loops themselves (expectation and maximisation),
    `rounds` measures them again as the map grows. In the last rounds factors may be as noisy as
    they say, so that no loop is refused for what it was predicted too well; but only loops that
    fit by the noise that was found, and last of all its tail (`Growth.accept_tail`).
A true loop
    measures where its keyframes are, with normal noise. Predicted by the map without it, its
    innovation r has a covariance C from samples of the map (`innovation`), and r'C^-1 r stays
    below the gate for all but one in a thousand.
A lie
    claims anything: its innovation is uniform over as much as the map is wide, with any rotation.
    How many of the loops lie is not assumed: the odds come from the loops (empirical Bayes). A
    loop is accepted where it and all accepted with it lie with a probability of 1% at most. Of two
    that contradict each other one lies, so each has to be the likelier of both by as much.
A place
    is what loops near each other are of, in metres along the way (`places`). Lies of one place
    may be one mistake: together they count once. A loop most of whose neighbours there are refused
    is the less likely, the rarer true ones were found beside such. The evidence of several places
    adds up (`pairwise_consistency`).
A slip
    is an odometry factor that says anything, while the robot moved on as ever (`motion`); of all
    of them one is expected to be; and one is a motion like no other, which is none. A gap, or the
    seam of two sessions, is one whose place is known. The sides of it are right in themselves, so
    the true loops across agree with each other. A slip is one explanation of loops that do not
    fit, lies are the other: `slips` compares their odds, with half a gate for each place that one
    of them calls a lie.
A drift
    is an error of all steps, the same on each metre: a third explanation, asked before slips. It
    is taken where it makes the loops likelier (`drift`); of one learnt as noise residuals tell.
A part
    is what accepted factors tie together. Parts are joined where loops of two places agree.
A doubt
    is a rival explanation nearly as good as the one that won: `reasons` names it.

No loop is factored before it is accepted, so none bends what it is judged by. Read on in `rounds`,
`gating`, `innovation`, `places`, `pairwise_consistency`, `motion`, `untold`, `cuts`, `slips`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core import kernels
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.parts import tied
from l1slam_ros.core.robust.as_measured import FAILURES, Believed, OnRound, as_measured
from l1slam_ros.core.robust.forecast import CONFIDENT, drift_taken_for_noise, right_within
from l1slam_ros.core.robust.gating import log_odds_of_false, probability
from l1slam_ros.core.robust.innovation import BY_CHANCE, chi2_quantile, covariances, spread_of
from l1slam_ros.core.robust.inspection import OFF_SCALE
from l1slam_ros.core.robust.judgement import (
    NORM,
    UNSOLVED,
    Doubt,
    Judgement,
    doubt_of,
    judgement_of,
    listed,
    so_far,
)
from l1slam_ros.core.robust.odometry.cuts import join
from l1slam_ros.core.robust.odometry.drift import Straight, likeliest, straightened
from l1slam_ros.core.robust.odometry.drift_likelihood import likely_drifts
from l1slam_ros.core.robust.odometry.noisier import with_runs
from l1slam_ros.core.robust.odometry.slips import without_slip
from l1slam_ros.core.robust.reasons import doubts
from l1slam_ros.core.robust.rounds.growth import Growth
from l1slam_ros.core.robust.rounds.landmarks import with_landmarks
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import l2_map
from l1slam_ros.core.solvers.nonlinear import Solution
from l1slam_ros.core.solvers.optimality import Status, l1_cost

# Every round accepts a loop, hence there is an end; this one is for the patience of people.
_MOST_ROUNDS = 200


@with_landmarks
@as_measured
def robust_solve(
    graph: FactorGraph, report: OnRound = lambda round_, accepted: None,
    check: Callable[[], None] = lambda: None, known: Believed | None = None,
) -> Believed:
    """
    Return which loops to accept, from the graph alone, and the L2 map (n, p) of these.

    Where that fails, what was believed so far, doubtful: loops that nobody judged are never taken
    for true.

    Parameters
    ----------
    report : called with the round and the loops accepted so far
    check : called before long steps, raises where the work shall stop
    known : what was believed before and stays if this fails; None: what was in the last round

    """
    first = growth = Growth(graph, check)
    last = so_far(first), first.poses
    number = 0
    repair = _Repair(graph, check)
    try:
        first.begin()
        for number, growth in enumerate(rounds(first, repair), 1):
            last = so_far(growth, repair.drift), growth.poses
            report(number, int(np.count_nonzero(growth.loops)))
        growth, uncontested, sure = with_uncontested(growth)
        unconfirmed = uncontested[:0] if sure >= CONFIDENT else uncontested
        reasons = doubts(growth, number < _MOST_ROUNDS, repair.rival, unconfirmed)
        return judgement_of(growth, reasons, repair.drift, repair.odds, sure), growth.poses
    except FAILURES as error:
        judgement, poses = known or last
        return judgement.broken_off(graph, error), poses


class _Repair:
    """
    What loops that are left out may be right by.

    drift : that of the odometry [rad/m]; rival : by how much more it may be; odds : ln of those of
    the one against all its rivals.
    """

    def __init__(self, graph: FactorGraph, check: Callable[[], None]):
        self._graph = graph
        self._check = check
        self._asked = False
        self.drift = self.rival = 0.0
        self.odds = np.inf

    def __call__(self, found: Growth, as_stated: Growth) -> Growth | None:
        """Return a state without a drift, asked once, or without a slip; None: there is none."""
        straight = None if self._asked else self._straightened(found, as_stated)
        self._asked = True
        return straight or without_slip(found, as_stated)

    def _straightened(self, found: Growth, as_stated: Growth) -> Growth | None:
        """Return the state without a drift that explains the loops, or was taken for noise."""
        best = stated = Straight(0.0, found, as_stated)
        # Odometry that is so much noisier than it states may drift.
        asked = len(as_stated.undecided()) or as_stated.noise.variance[0] > OFF_SCALE
        drifts = likely_drifts(self._graph).tolist() if asked else []
        if drifts:
            some = [stated, *(end for drift in drifts for end in self._without(drift))]
            begun = None if len(stated.loops) else with_runs(found)
            some += self._ends(0.0, begun) if begun else []
            best, self.rival, self.odds = likeliest(some)
        taken = drift_taken_for_noise(as_stated) if best is stated else 0.0
        if taken:
            best = next((end for end in self._without(taken) if end.keeps_places(as_stated)), best)
        self.drift = best.drift
        return None if best is stated else best.found

    def _without(self, drift: float) -> list[Straight]:
        """Return what odometry without a drift leads to."""
        growth = Growth(straightened(self._graph, drift), self._check)
        growth.begin()
        return self._ends(drift, growth)

    def _ends(self, drift: float, growth: Growth) -> list[Straight]:
        """Return where rounds from a state end, by runs again if without loops; [] : nowhere."""
        ends: list[Straight] = []

        def ended(*states: Growth) -> Growth | None:
            ends.append(Straight(drift, *states))
            return None if len(ends[-1].loops) else with_runs(states[0])

        for _ in rounds(growth, ended):
            self._check()
        return ends


@dataclass(frozen=True)
class RobustMap:
    """The map of the accepted factors, the L2 map (n, p) it began with, the judgement on all."""

    solution: Solution
    seed: Array
    judgement: Judgement


def minimise_robustly(
    graph: FactorGraph, minimise: Callable[[FactorGraph, Array], Solution],
    report: OnRound = lambda round_, accepted: None, check: Callable[[], None] = lambda: None,
    known: Believed | None = None,
) -> RobustMap:
    """
    Return the map that `minimise` makes of the factors that are accepted.

    They are judged in L2, which spreads a doubt over all factors near it, where L1 leaves it on a
    few. Where it cannot be made, the map by which they were judged.

    minimise : from a graph and poses (n, p) to its solution; report, check, known : see
    `robust_solve`
    """
    judgement, poses = robust_solve(graph, report, check, known)
    try:
        whole, seed = _least_squares(graph, judgement, poses, check)
        solution = minimise(whole, seed)
        check()
        more = _norm_doubts(graph, judgement, whole, seed, solution.poses)
    except FAILURES as error:
        solution = _standing(judgement.believed(graph), poses)
        seed = poses
        more = (_unsolved(graph, judgement, error),)
    rows = int(judgement.accepted.sum()) * graph.manifold.TANGENT_SIZE
    judgement = replace(judgement, doubts=judgement.doubts + more)
    return RobustMap(replace(solution, dual=solution.dual[:rows]), seed, judgement)


def _standing(graph: FactorGraph, poses: Array) -> Solution:
    """Return poses (n, p) as a solution that nothing was found by."""
    residual = whitened_residual(graph, poses)
    cost = l1_cost(residual)
    return Solution(poses, cost, Status.STALLED, 0, 0, np.array([cost]), np.zeros(len(residual)))


def _unsolved(graph: FactorGraph, judgement: Judgement, error: Exception) -> Doubt:
    rows = judgement.accepted & ~graph.between.is_odometry
    return doubt_of(graph, rows, UNSOLVED, str(error))


def doubts_of_norm(graph: FactorGraph, judgement: Judgement, poses: Array,
                   check: Callable[[], None]) -> tuple[Doubt, ...]:
    """Return the doubts that `minimise_robustly` would have of a map, (n, p), by its norm."""
    if not len(graph.between):  # of nothing: compiled loops would go past its arrays
        return ()
    try:
        whole, seed = _least_squares(graph, judgement, poses, check)
        return _norm_doubts(graph, judgement, whole, seed, poses)
    except FAILURES as error:
        return (_unsolved(graph, judgement, error),)


def _least_squares(graph: FactorGraph, judgement: Judgement, poses: Array,
                   check: Callable[[], None]) -> tuple[FactorGraph, Array]:
    """Return the accepted factors, in one piece, and their L2 map (n, p), from poses (n, p)."""
    whole = tied(judgement.believed(graph), poses)
    return whole, l2_map(whole, poses, cholesky_of(whole), lambda *_: check())


def _norm_doubts(graph: FactorGraph, judgement: Judgement, whole: FactorGraph, seed: Array,
                 poses: Array) -> tuple[Doubt, ...]:
    """
    Return a doubt where half of a map, (n, p), is further off the L2 map than noise makes it.

    Of normal noise, as it was found, the difference has pi/2 - 1 of the covariance of the L2 map
    at most, which is what L1 pays for it. Of the keyframes of one way all may err together. No
    doubt where either map is right if the other one is.

    whole, seed : see `_least_squares`
    """
    manifold = graph.manifold
    other = manifold.positions(seed)
    if absolute_trajectory_error(manifold.positions(poses), other) < right_within(other):
        return ()
    noise = judgement.found_variance(graph)
    noise = np.concatenate((noise, np.ones(len(whole.between) - len(noise))))
    spread = covariances(spread_of(whole, seed, cholesky_of(whole), noise))
    step = manifold.local(seed, poses)[len(poses) - len(spread):]
    square = kernels.prediction.normalise(spread, step)[0]
    explained = (np.pi / 2 - 1) * chi2_quantile(1 - BY_CHANCE, np.array([manifold.TANGENT_SIZE]))
    if np.count_nonzero(np.isfinite(square) & (square > explained)) <= len(square) / 2:
        return ()
    loops = graph.between.pairs[judgement.accepted & ~graph.between.is_odometry]
    return (Doubt(NORM, len(loops), 0, graph.n_poses - 1, pairs=listed(loops)),)


def rounds(
    growth: Growth, repaired: Callable[[Growth, Growth], Growth | None] | None = None
) -> Iterator[Growth]:
    """
    Yield the state after each round, until there is nothing more to accept but the noise's tail.

    That comes in after the last one, into the state that was yielded last.

    repaired : asked in the end for another state, from the one with the noise as it was found and
    the one where all may be as noisy as they say; None: there is none, or nobody looks for one.
    """
    found = None
    for _ in range(_MOST_ROUNDS):
        news = growth.news()
        growth.accepted[news] = True
        if len(news):
            growth.solve()
        elif not join(growth):
            if not found:
                found = growth.copy() if repaired else growth
                growth.take_at_their_word()
                growth.solve()
            else:
                other = repaired(found, growth) if repaired else None
                growth.slip_odds = found.slip_odds
                if not other:
                    break
                growth = other
                found = None
        yield growth
    growth.accept_tail()


def with_uncontested(growth: Growth) -> tuple[Growth, Indices, float]:
    """
    Return a state with the loops that are left out, where all fit the map and each other.

    Then nothing is an outlier but by the prior: few loops against uncertain odometry, which false
    ones would fit as well. The likelier map has them. Also which they are, (k,), and how likely it
    is that none is an outlier; a place may be one mistake, so it counts once.
    """
    given = growth.given
    rows = np.flatnonzero(given.is_loop & ~growth.accepted)
    if not len(rows) or growth.across()[rows].any() or (growth.cut & ~given.gap).any():
        return growth, rows[:0], 1.0
    found = growth.innovations(rows)
    if (found.square >= given.gate(found.freedom)).any():
        return growth, rows[:0], 1.0
    state = growth.copy()
    state.accepted[rows] = True
    state.solve()
    if not state.accepted[rows].all():
        return growth, rows[:0], 1.0
    log_ratio = found.log_ratio()
    odds = log_odds_of_false(log_ratio, 0, int(np.count_nonzero(growth.loops)))
    false = np.zeros(given.place[rows].max() + 1)
    np.maximum.at(false, given.place[rows], probability(odds - log_ratio))
    return state, rows, float(np.prod(1 - false))


def judge(
    graph: FactorGraph, poses: Array, known: Judgement,
    check: Callable[[], None] = lambda: None,
) -> Believed:
    """
    Return what is to be accepted, after looking again at all loops that are not, and its L2 map.

    A slip of the odometry is not looked for: that takes too long to do while driving. Where it
    fails, what is known stays, doubtful.

    Parameters
    ----------
    poses : (n, p) the map of what was accepted
    check : called before long steps, raises where the work shall stop

    """
    first = Growth(known.corrected(graph), check)
    try:
        first.resume(poses, known.accepted, known.variance_meant)
        *_, growth = rounds(first)
        judgement = judgement_of(growth, doubts(growth), drift=known.drift)
        units = known.variance / known.variance_meant
        return replace(judgement, variance=judgement.variance * units,
                       meant=known.meant), growth.poses
    except FAILURES as error:
        return known.broken_off(graph, error), poses
