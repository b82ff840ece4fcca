# SPDX-License-Identifier: Apache-2.0
"""
Maps that survive lies: which loops to believe, by growing outward from the odometry.

In: a graph, of which nothing is believed but the odometry and the trusted loops. Out: the loops
that are believed, and the L2 map of these. No loop is factored before it is believed, so none bends
what it is judged by. Each round

1. predicts every undecided loop with its covariance (`prediction`),
2. accepts those that hardly can be false (`belief`); where there is none, pairs of loops that
   vouch for each other: a group that looks alike has one vote; where there is none either, asks
   whether an odometry factor lies (`slips`),
3. solves, and doubts the factors that all others speak against.

What fits where it stands, but could as well be chance, stays suspect. The noise of odometry and of
loops is measured on the way: files are often off by a constant. Source: ours, defended by
`test_robust.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.belief import DOUBT, believable, common_scale, log_odds_of_false
from l1slam_ros.core.cholesky import cholesky_of
from l1slam_ros.core.graph import FactorGraph
from l1slam_ros.core.initial import odometry_poses
from l1slam_ros.core.l2 import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.least_squares import weighted_least_squares
from l1slam_ros.core.linearise import anchor, linearise, step_poses, whitened_residual
from l1slam_ros.core.manifold import Array, Indices
from l1slam_ros.core.noise import Mask
from l1slam_ros.core.optimality import l2_cost
from l1slam_ros.core.prediction import (
    Innovations,
    Posterior,
    chi2_quantile,
    claimed_volume,
    innovations,
    left_out_quantile,
    sample_posterior,
)
from l1slam_ros.core.slips import find_slip
from l1slam_ros.core.subgraph import SubGraph

# One in so many true loops may be refused for its noise alone; and of accepted ones, dropped.
_REFUSED = 1e-3
_DROPPED = 2e-5
# Probability that any true factor of a round is doubted for what the others say.
_DOUBTED = 0.01
_ROUNDS = 200
_STEPS = 60
# A loop that was dropped that often is not tried again.
_CHANCES = 2
# The scale of the noise moves by what is measured as fast as if it had been measured before on so
# many factors.
_KNOWN = 20
# The same samples each time: the answer is that of the graph, not of chance.
_SEED = 20140601
# Pairs are formed of so many loops that fit best.
_CANDIDATES = 200
# [keyframes] Loops nearer to each other than that may be one and the same mistake.
APART = 40


@dataclass(frozen=True)
class RobustSolution:
    """
    What a robust solve believes.

    poses : (n, p) the L2 map of the accepted factors; accepted : (m,) bool of the between factors;
    suspect : (m,) bool, those that fit but could as well be chance; sigmas : (m,) root of the
    squared residual, of the innovation where it is not accepted, in units of the noise as it was
    found; slips : (k,) the odometry factors that lie; variance : (2,) of odometry and loops, in
    units of what they state; rounds : how many it took.
    """

    poses: Array
    accepted: Mask
    suspect: Mask
    sigmas: Array
    slips: Indices
    variance: Array
    rounds: int


Report = Callable[[int, int], None]


def robust_solve(
    graph: FactorGraph, trusted: Mask | None = None,
    report: Report = lambda round_, accepted: None,
) -> RobustSolution:
    """
    Find out which loops to believe, from the graph alone.

    Parameters
    ----------
    trusted : (m,) bool, between factors that are never doubted
    report : called with the round and the loops accepted so far

    Raises
    ------
    GraphError : the odometry has a gap.

    """
    growth = Growth(graph, trusted)
    growth.settle()
    growth.learn_common_scale()
    rounds = 0
    while rounds < _ROUNDS and growth.grow():
        growth.settle()
        rounds += 1
        report(rounds, int(growth.is_loop[growth.accepted].sum()))
    return growth.solution(rounds)


def reconsider(graph: FactorGraph, poses: Array, solution: RobustSolution,
               trusted: Mask | None = None) -> Mask:
    """
    Return which factors to keep at a finished map of the accepted ones, (m,) bool.

    All loops are tested alike, in the units that they state; where the accepted ones are noisier
    than that, in theirs. To be repeated with the map of what it returns until that is the same.
    """
    factors, k = graph.between, graph.manifold.TANGENT_SIZE
    rows = whitened_residual(graph, poses)[: len(factors) * k]
    square = (rows.reshape(-1, k) ** 2).sum(axis=1)
    is_loop = ~factors.is_odometry
    believed = square[solution.accepted & is_loop]
    scale = max(1.0, float(believed.mean()) / k) if len(believed) else 1.0
    keep: Mask = square < scale * chi2_quantile(1 - _REFUSED, k)
    keep = np.where(is_loop, keep, solution.accepted)
    return keep if trusted is None else keep | trusted


class Growth:
    """
    The state of a robust solve.

    accepted, is_loop, trusted : (m,) bool of the between factors; variance : (2,) of odometry and
    loops; poses : (n, p).
    """

    def __init__(self, graph: FactorGraph, trusted: Mask | None):
        factors = graph.between
        self.graph, self.factors = graph, factors
        self.is_loop: Mask = ~factors.is_odometry
        self.trusted = np.zeros(len(factors), bool) if trusted is None else trusted
        self.accepted: Mask = ~self.is_loop | self.trusted
        self.poses = odometry_poses(graph)
        self.variance = np.ones(2)
        self._rng = np.random.default_rng(_SEED)
        self._drops = np.zeros(len(factors), np.int64)
        self._posterior: Posterior

    def part(self, rows: Indices) -> SubGraph:
        """Return the graph of some factors, with the noise as it was found."""
        return SubGraph(self.graph, rows, self.variance[self.is_loop[rows].astype(np.int64)])

    def settle(self) -> None:
        """Solve for the accepted factors; drop those that do not fit any more."""
        k = self.graph.manifold.TANGENT_SIZE
        while True:
            rows = np.flatnonzero(self.accepted)
            part = self.part(rows)
            cholesky = cholesky_of(part)
            self.poses = solve(part, self.poses)
            self._posterior = sample_posterior(part, self.poses, cholesky, self._rng)
            drop = self._misfits(rows)
            if not len(drop):
                break
            self.accepted[drop] = False
            self._drops[drop] += 1
        self._learn_scales(rows, k)

    def _misfits(self, rows: Indices) -> Indices:
        """Return the accepted loops that do not fit, or that all others speak against."""
        posterior, k = self._posterior, self.graph.manifold.TANGENT_SIZE
        may_go = self.is_loop[rows] & ~self.trusted[rows]
        far = (posterior.residual**2).sum(axis=1) > chi2_quantile(1 - _DROPPED, k)
        against = np.where(may_go, posterior.left_out(), 0.0)
        # Next to a false loop the true ones look bad too: only the worst go.
        limit = left_out_quantile(1 - _DOUBTED / len(rows), k)
        far |= against > max(limit, against.max(initial=0.0) / 2)
        return rows[far & may_go]

    def _learn_scales(self, rows: Indices, k: int) -> None:
        """Compare the residuals with what the noise makes of them, for odometry and for loops."""
        kind = self.is_loop[rows]
        found = np.bincount(kind, (self._posterior.residual**2).sum(axis=1), 2)
        stated = np.bincount(kind, np.trace(self._posterior.moment, axis1=1, axis2=2), 2)
        self.variance = self.variance * (found + k * _KNOWN) / (stated + k * _KNOWN)

    def learn_common_scale(self) -> None:
        """Measure the noise before any loop is accepted: as one number."""
        rows = np.flatnonzero(~self.accepted)
        if len(rows):
            self.variance = self.variance * common_scale(self.innovations(rows))

    def innovations(self, rows: Indices) -> Innovations:
        """Return how undecided factors fit the map."""
        volume = claimed_volume(self.graph.manifold, self.poses, self._rng)
        return innovations(self.part(rows), self.poses, self._posterior, volume)

    def grow(self) -> bool:
        """Accept what can be believed; False: nothing."""
        rows = np.flatnonzero(~self.accepted & (self._drops < _CHANCES))
        if not len(rows):
            return False
        found = self.innovations(rows)
        fits = np.flatnonzero(found.square < self.gate())
        log_ratio = found.log_ratio()[fits]
        odds = log_odds_of_false(log_ratio, len(rows) - len(fits))
        news = believable(log_ratio, odds)
        if not len(news):
            news = self._pairs(found, rows, fits, odds)
        self.accepted[rows[fits[news]]] = True
        return len(news) > 0 or self._mend_slip(rows, found)

    def gate(self) -> float:
        """Return what the square of a true loop's innovation stays below."""
        return chi2_quantile(1 - _REFUSED, self.graph.manifold.TANGENT_SIZE)

    def _pairs(self, found: Innovations, rows: Indices, fits: Indices, odds: float) -> Indices:
        """Return loops that vouch for another one far from them, as places in `fits`."""
        log_ratio = found.log_ratio()[fits]
        best = np.argsort(-log_ratio, kind='stable')[:_CANDIDATES]
        a, b = (best[side] for side in np.triu_indices(len(best), 1))
        i, j = self.factors.i[rows[fits]], self.factors.j[rows[fits]]
        apart = np.abs(i[a] - i[b]) + np.abs(j[a] - j[b]) > APART
        a, b = a[apart], b[apart]
        if not len(a):
            return a
        square, log_det = found.joint(self._posterior, fits[a], fits[b])
        k = self.graph.manifold.TANGENT_SIZE
        claim = found.log_claim[fits]
        ratio = claim[a] + claim[b] - (2 * k * np.log(2 * np.pi) + log_det + square) / 2
        sure = ratio > np.log(1 / DOUBT - 1) + odds + max(odds, 0.0)
        good = sure & (square < chi2_quantile(1 - _REFUSED, 2 * k))
        return np.unique(np.concatenate((a[good], b[good])))

    def _mend_slip(self, rows: Indices, found: Innovations) -> bool:
        """Let an odometry factor go that loops agree is wrong, and accept these; False: none."""
        best_first = rows[np.argsort(found.log_det, kind='stable')]
        slip = find_slip(self.graph.manifold, self.factors, self.accepted, best_first, self.poses,
                         self._judge, APART)
        if slip is None:
            return False
        self.accepted[slip.loops] = True
        self.accepted[slip.factor] = False
        self.poses = slip.poses
        return True

    def _judge(self, rows: Indices, poses: Array) -> Array:
        """Return the log odds of undecided factors to be true at other poses."""
        volume = claimed_volume(self.graph.manifold, poses, np.random.default_rng(_SEED))
        found = innovations(self.part(rows), poses, self._posterior, volume)
        # What proposed the poses is as uncertain as what is judged by it.
        log_ratio = found.log_ratio(2.0)
        fits = found.square < 2 * self.gate()
        odds = log_odds_of_false(log_ratio[fits], int(np.count_nonzero(~fits)))
        return np.where(fits, log_ratio - odds - np.log(1 / DOUBT - 1), -np.inf)

    def solution(self, rounds: int) -> RobustSolution:
        """Return the answer."""
        square = np.zeros(len(self.factors))
        inside, outside = np.flatnonzero(self.accepted), np.flatnonzero(~self.accepted)
        square[inside] = (self._posterior.residual**2).sum(axis=1)[: len(inside)]
        square[outside] = self.innovations(outside).square
        suspect = ~self.accepted & (square < self.gate())
        slips = np.flatnonzero(~self.is_loop & ~self.accepted)
        return RobustSolution(self.poses, self.accepted, suspect, np.sqrt(square), slips,
                              self.variance, rounds)


def solve(graph: FactorGraph, poses: Array) -> Array:
    """
    Return the L2 map of a graph to within its noise: chi2 one above the optimum or less.

    From poses that may be far off: rotations alone, then translations, each of which is linear;
    then Gauss-Newton.
    """
    manifold, cholesky = graph.manifold, cholesky_of(graph)
    linear = poses
    for part in (manifold.ROTATION, manifold.TRANSLATION):
        system = linearise(graph, linear).part(part)
        x = weighted_least_squares(system, cholesky, np.ones_like(system.b))
        step = np.zeros((graph.n_poses - anchor(graph), manifold.TANGENT_SIZE))
        step[:, part] = x.reshape(len(step), -1)
        linear = step_poses(graph, linear, step)
    if _chi2(graph, linear) < _chi2(graph, poses):
        poses = linear
    freedom = len(graph.between) - graph.n_poses + 2
    tolerance = 1 / (manifold.TANGENT_SIZE * max(freedom, 1))
    return minimise_l2(graph, poses, LeastSquaresOptions(_STEPS, tolerance), cholesky).poses


def _chi2(graph: FactorGraph, poses: Array) -> float:
    return l2_cost(whitened_residual(graph, poses))
