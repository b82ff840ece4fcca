# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Robust solve: which loops are inliers, and with what confidence.

In: a graph, with only odometry and trusted loops accepted. Out: the accepted loops, their L2 map,
and its doubts. Model and algorithm:

1. Noise. Stated variances may be off by a constant for each kind, odometry or loops, and
   component: translation and rotation, in space those of the floor and of the height apart. It is
   estimated from innovations of all loops (`gating.noise_variance`), then from residuals of
   accepted factors (`rounds`).
2. Rounds. The innovation r of an inlier, with covariance C by posterior samples (`innovation`),
   passes a gate on r'C^-1 r. Outliers are uniform over the extent of the map and all rotations, at
   a rate estimated from the loops (empirical Bayes, `gating`). Loops accepted together include an
   outlier with a probability of 1% at most; then the map is solved again, until nothing changes.
   Loops of a place (`places`) may share one error: together they count once.
3. Parts. Both sides of an odometry gap are joined where loops of two places agree
   (`pairwise_consistency`).
4. Hypotheses. Where loops do not fit, the odometry drifts, by a constant for each metre (`drift`),
   steps of it slipped (`slips`), or it is noisier along a run of loops (`hypotheses`): the
   likeliest is accepted where its log odds are positive (`repair`). Then again from 2.
5. Audit. Each place is predicted by all else (`audit`): clearly false ones are dropped, rejected
   ones that explain more than they cost accepted.
6. Confidence. Alternative maps have odds, and a probability that the map is wrong if they are
   right (`confidence`). Below 90% it is doubtful, with these doubts; below 80% by its norm alone.

No loop is a factor before it is accepted, so none bends the map that tests it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.parts import tied
from l1slam_ros.core.robust.as_measured import FAILURES, Believed, OnRound, as_measured
from l1slam_ros.core.robust.audit import Places, alternatives, audit, places_of
from l1slam_ros.core.robust.confidence import CONFIDENT, Alternative, Drawn, compared, drawn
from l1slam_ros.core.robust.innovation import spread_of
from l1slam_ros.core.robust.judgement import (
    DRIFTS,
    NORM,
    OTHER_MAP,
    SLIP,
    UNFINISHED,
    UNSOLVED,
    WEAK,
    Doubt,
    Judgement,
    doubt_of,
    judgement_of,
    so_far,
)
from l1slam_ros.core.robust.odometry.cuts import join
from l1slam_ros.core.robust.odometry.repair import Repair
from l1slam_ros.core.robust.odometry.slips import common_steps
from l1slam_ros.core.robust.pairwise_consistency import longest_run, spanned, strongest_group
from l1slam_ros.core.robust.rounds.evidence import TWO_PLACES
from l1slam_ros.core.robust.rounds.growth import Growth
from l1slam_ros.core.robust.rounds.landmarks import with_landmarks
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import l2_map
from l1slam_ros.core.solvers.nonlinear import Solution
from l1slam_ros.core.solvers.optimality import Status, l1_cost

# Below, a map is doubtful by its norm alone: its posterior takes the noise for independent.
_SURE_OF_NORM = 0.8
# Each round accepts a loop, so they end; this bounds the time.
_MOST_ROUNDS = 200


@with_landmarks
@as_measured
def robust_solve(
    graph: FactorGraph, report: OnRound = lambda round_, accepted: None,
    check: Callable[[], None] = lambda: None, known: Believed | None = None,
) -> Believed:
    """
    Return which loops to accept, from the graph alone, and their L2 map (n, p).

    On failure, those accepted before, doubtful; loops that were not judged never.

    report : called with the round and the number of accepted loops; check : called before long
    steps, raises to stop; known : result on failure, None: that of the last round
    """
    first = growth = Growth(graph, check)
    last = so_far(first), first.poses
    number = 0
    repair = Repair(graph, rounds, check)
    try:
        first.begin()
        for number, growth in enumerate(rounds(first, repair), 1):
            last = so_far(growth, repair.drift), growth.poses
            report(number, int(np.count_nonzero(growth.loops)))
        growth, places, others = audit(growth)
        if repair.rival:
            loops = np.flatnonzero(growth.loops)
            others.append(Alternative(DRIFTS, loops, -repair.odds, detail=f'{-repair.rival:+.2g}'))
        judgement = judged(growth, places, others, number < _MOST_ROUNDS)
        return replace(judgement, drift=repair.drift), growth.poses
    except FAILURES as error:
        judgement, poses = known or last
        return judgement.broken_off(graph, error), poses


@dataclass(frozen=True)
class RobustMap:
    """The map of accepted factors, the L2 map (n, p) it began with, the judgement."""

    solution: Solution
    seed: Array
    judgement: Judgement


def minimise_robustly(
    graph: FactorGraph, minimise: Callable[[FactorGraph, Array], Solution],
    report: OnRound = lambda round_, accepted: None, check: Callable[[], None] = lambda: None,
    known: Believed | None = None,
) -> RobustMap:
    """
    Return the map that `minimise` makes of accepted factors, else their L2 map.

    Loops are judged in L2, which spreads an error over all factors near it; L1 leaves it on a few.

    minimise : from a graph and poses (n, p) to its solution; report, check, known : see
    `robust_solve`
    """
    judgement, poses = robust_solve(graph, report, check, known)
    try:
        whole, seed = _least_squares(graph, judgement, poses, check)
        solution = minimise(whole, seed)
        check()
        sure = _sure_of_norm(graph, judgement, whole, seed, solution.poses)
        more = _norm_doubts(graph, judgement, sure)
        judgement = replace(judgement, confidence=judgement.confidence * sure)
    except FAILURES as error:
        solution = _standing(judgement.believed(graph), poses)
        seed = poses
        more = (_unsolved(graph, judgement, error),)
    rows = int(judgement.accepted.sum()) * graph.manifold.TANGENT_SIZE
    judgement = replace(judgement, doubts=judgement.doubts + more)
    return RobustMap(replace(solution, dual=solution.dual[:rows]), seed, judgement)


def _standing(graph: FactorGraph, poses: Array) -> Solution:
    residual = whitened_residual(graph, poses)
    cost = l1_cost(residual)
    return Solution(poses, cost, Status.STALLED, 0, 0, np.array([cost]), np.zeros(len(residual)))


def _unsolved(graph: FactorGraph, judgement: Judgement, error: Exception) -> Doubt:
    rows = judgement.accepted & ~graph.between.is_odometry
    return doubt_of(graph, rows, UNSOLVED, str(error))


def doubts_of_norm(graph: FactorGraph, judgement: Judgement, poses: Array,
                   check: Callable[[], None]) -> tuple[Doubt, ...]:
    """Return the doubts that `minimise_robustly` would have of a map, (n, p), by its norm."""
    if not len(graph.between):  # compiled loops would run past empty arrays
        return ()
    try:
        whole, seed = _least_squares(graph, judgement, poses, check)
        return _norm_doubts(graph, judgement,
                            _sure_of_norm(graph, judgement, whole, seed, poses))
    except FAILURES as error:
        return (_unsolved(graph, judgement, error),)


def _least_squares(graph: FactorGraph, judgement: Judgement, poses: Array,
                   check: Callable[[], None]) -> tuple[FactorGraph, Array]:
    whole = tied(judgement.believed(graph), poses)
    return whole, l2_map(whole, poses, cholesky_of(whole), lambda *_: check())


def _sure_of_norm(graph: FactorGraph, judgement: Judgement, whole: FactorGraph, seed: Array,
                  poses: Array) -> float:
    """
    Return how likely the map of a norm, (n, p), is right.

    With normal noise, as estimated, the truth is about the L2 map.

    whole, seed : accepted factors with parts tied, and their L2 map
    """
    noise = judgement.found_variance(graph)
    noise = np.concatenate((noise, np.ones(len(whole.between) - len(noise))))
    samples = spread_of(whole, seed, cholesky_of(whole), noise)
    other = Drawn.of(graph.manifold, seed, samples, np.zeros(len(seed), np.int64))
    return 1.0 - replace(other, poses=poses[compared(len(poses))]).harm(other)


def _norm_doubts(graph: FactorGraph, judgement: Judgement, sure: float) -> tuple[Doubt, ...]:
    """Return the doubt of a map that is likely wrong by its norm alone."""
    if sure >= _SURE_OF_NORM:
        return ()
    return (doubt_of(graph, judgement.accepted & ~graph.between.is_odometry, NORM),)


def rounds(
    growth: Growth, repaired: Callable[[Growth, Growth], Growth | None] | None = None
) -> Iterator[Growth]:
    """
    Yield the state after each round, until nothing more is accepted.

    repaired : returns a state to continue from, or None, given the last states by estimated noise
    and by max(estimated, stated)
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


def judged(growth: Growth, places: Places, others: list[Alternative], ended: bool = True
           ) -> Judgement:
    """
    Return the judgement of the given factors, with confidence and doubts.

    others : alternatives that were tried; ended : nothing more can be accepted
    """
    graph, given = growth.given.graph, growth.given
    map_ = drawn(growth)
    others = others + alternatives(growth, map_, places, others) + slips(growth) + agreeing(growth)
    left_out = np.flatnonzero(given.is_loop & ~growth.accepted)
    if len(left_out) and not growth.loops.any():  # nothing confirms the odometry
        others.append(Alternative(WEAK, left_out, 0.0))
    harms = np.array([one.chance * map_.harm(one.map) for one in others])
    judgement = judgement_of(growth)
    loops = given.is_loop[:given.size]
    if loops.any():
        judgement = replace(judgement, expected_error=map_.expected,
                            confidence=float(np.prod(1 - harms)))
    doubts = []
    if not ended:
        doubts.append(doubt_of(graph, left_out[left_out < given.size], UNFINISHED))
    if judgement.confidence < CONFIDENT:
        doubts += [doubt_about(growth, others[k]) for k in np.argsort(-harms, kind='stable')
                   if harms[k] > (1 - CONFIDENT) / 2]
        doubts = doubts or [doubt_about(growth, others[int(harms.argmax())])]
    return replace(judgement, doubts=tuple(dict.fromkeys(doubts)))


def doubt_about(growth: Growth, other: Alternative) -> Doubt:
    """Return the doubt that an alternative is right."""
    given = growth.given
    doubt = doubt_of(given.graph, other.loops[other.loops < given.size], other.kind, other.detail)
    if other.step >= 0:
        doubt = replace(doubt, first=int(given.low[other.step]), last=int(given.high[other.step]))
    return doubt


def slips(growth: Growth) -> list[Alternative]:
    """Return alternatives where a cut odometry factor did not slip, or another did."""
    given, found = growth.given, []
    for step, odds in growth.slip_odds.items():
        span = given.spanning(step)
        across = growth.accepted & span
        if across.any() and given.trusted[across].all():
            continue  # a person vouches for the motion
        found.append(Alternative(SLIP, np.flatnonzero(across if across.any() else span),
                                 -odds if growth.cut[step] else odds, step=step))
    return found


def agreeing(growth: Growth) -> list[Alternative]:
    """
    Return the map of rejected loops of places that agree, or of a long run across a gap.

    Several places span an odometry step that no accepted loop does: it slipped, or they are
    outliers that agree. Across a gap only loops are evidence. Either is as likely.
    """
    given, rows, accepted = growth.given, growth.undecided(), growth.loops
    across = spanned(given.low[accepted], given.high[accepted], given.graph.n_poses)
    group = strongest_group(growth, rows)
    steps = common_steps(growth, group)
    if given.count_places(group) >= TWO_PLACES and (
            (across[given.low[steps]] == 0) | given.gap[steps]).any():
        return [Alternative(OTHER_MAP, group, 0.0)]
    run = longest_run(growth, rows) if given.gap.any() else group[:0]
    if len(run) and given.gap[common_steps(growth, run)].any():
        return [Alternative(OTHER_MAP, run, 0.0)]
    return []


def judge(
    graph: FactorGraph, poses: Array, known: Judgement,
    check: Callable[[], None] = lambda: None,
) -> Believed:
    """
    Return the judgement after testing rejected loops again, and its L2 map.

    Slips are not searched for: that takes too long while driving. On failure `known` stays,
    doubtful.

    poses : (n, p) the map of accepted factors; check : see `robust_solve`
    """
    first = Growth(known.corrected(graph), check)
    try:
        first.resume(poses, known.accepted, known.variance_meant)
        *_, growth = rounds(first)
        judgement = replace(judged(growth, places_of(growth), []), drift=known.drift)
        units = known.variance / known.variance_meant
        return replace(judgement, variance=judgement.variance * units,
                       meant=known.meant), growth.poses
    except FAILURES as error:
        return known.broken_off(graph, error), poses
