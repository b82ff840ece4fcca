# SPDX-License-Identifier: Apache-2.0
"""
The rounds of a robust solve: predict, believe, solve, doubt.

In: a graph and what is believed of it. Out: the same with more loops believed. See `batch`.
"""

import copy
from collections.abc import Callable
from functools import cached_property

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph, component_labels, ends_in_time
from l1slam_ros.core.graph.first_fixes import first_fixes
from l1slam_ros.core.graph.linear_system import anchor, linearise, step_poses, whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.graph.world_frame import placed
from l1slam_ros.core.robust.gating import (
    DOUBT,
    believable,
    common_scale,
    log_odds_of_false,
    one_of_each_group,
)
from l1slam_ros.core.robust.innovation import (
    Innovations,
    Posterior,
    chi2_quantile,
    claimed_volume,
    innovations,
    sample_posterior,
    sampled_quantile,
)
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky, cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.nonlinear import Report
from l1slam_ros.core.solvers.optimality import l2_cost
from l1slam_ros.core.solvers.reweighting import weighted_least_squares

# The same samples each time: the answer is that of the graph, not of chance.
_SEED = 2014
# One in so many true loops may be refused for its noise alone; and of accepted ones, dropped.
REFUSED = 1e-3
_DROPPED = 2e-5
# Probability that any true factor of a round is doubted for what the others say.
_DOUBTED = 0.01
# Gauss-Newton begins where chi2 is at most so many times what the noise makes of it.
_FITS = 3
# Steps of Gauss-Newton at most in one round.
_STEPS = 60
# A loop that was dropped that often is not tried again.
_CHANCES = 2
# What is measured of the noise counts against as many factors on which it was measured before.
_KNOWN = 20
# The noise is learnt to be no less than this part of the variance that is stated: factors that
# fit exactly, as of a simulator, say of ever less that it is still too much. At a thirtieth of
# the stated deviations the map has long stopped to change.
_LEAST_VARIANCE = 1e-3
# While driving so many of the last absolute factors are looked at, with their neighbours.
_LATEST = 50
# Pairs are formed of so many loops that fit best.
_CANDIDATES = 200
# [keyframes] Loops whose ends are nearer to each other, in sum, may be one and the same mistake.
_APART = 40


class Growth:
    """
    The state of a robust solve.

    accepted, is_loop, trusted : (m,) bool of the between factors; low, high : (m,) the earlier and
    the later keyframe of each; poses : (n, p) the L2 map of the accepted; posterior : of these;
    variance : (2,) of odometry and loops in units of what they state; check : called before long
    steps, raises where the work shall stop.
    """

    def __init__(self, graph: FactorGraph, check: Callable[[], None] = lambda: None):
        self._check = check
        self.graph, self.factors, self.trusted = graph, graph.between, graph.between.trusted
        self.rng = np.random.default_rng(_SEED)
        self.low = np.minimum(self.factors.i, self.factors.j)
        self.high = np.maximum(self.factors.i, self.factors.j)
        self.is_loop: Mask = ~self.factors.is_odometry
        self.accepted: Mask = ~self.is_loop | self.trusted
        self.poses = placed(self.graph.subset(self.accepted), odometry_poses(graph))
        self.variance = np.ones(2)
        self._least_variance = _LEAST_VARIANCE
        self.posterior: Posterior
        self._drops = np.zeros(len(self.factors), np.int64)

    @cached_property
    def forward(self) -> Array:
        """The measurement of the later keyframe from the earlier one, (m, p)."""
        return ends_in_time(self.graph)[2]

    def slips(self) -> Indices:
        """Return the odometry factors that lie, (k,)."""
        return np.flatnonzero(~self.accepted & ~self.is_loop)

    def begin(self) -> None:
        """Solve for what is accepted, and learn from the loops how large their noise is."""
        self._tie_to_world()
        self.settle()
        rows = self.undecided_loops()
        if len(rows):
            self._scale_variance(common_scale(self.innovations(rows)))
            self.settle()

    def resume(self, poses: Array, accepted: Mask, variance: Array) -> None:
        """Go on from an earlier state: poses (n, p), accepted (m,), variance (2,)."""
        self.poses, self.variance = poses, variance.copy()
        self.accepted = accepted | self.trusted
        self._tie_to_world(_LATEST)
        if (self.accepted & self.is_loop).any():
            self.settle()
        else:
            self.begin()

    @property
    def may_be_predicted(self) -> Mask:
        """(m,) bool: not absolute factors while none of these is accepted."""
        absolute = self.factors.is_absolute
        return ~absolute | (self.accepted & absolute).any()

    def _tie_to_world(self, latest: int | None = None) -> None:
        """
        Accept the absolute factors that agree with their neighbours, if these are more than are.

        Until some are, the map says nothing of any; and behind a long way, little of the next.

        latest : so many of them are looked at; None: all
        """
        absolute = self.factors.is_absolute
        held = self.accepted & absolute
        if (held != absolute).any():
            # As many may have been accepted for want of others.
            count = np.count_nonzero(held)
            known = count > self.graph.manifold.TRANSLATION.stop
            rows, variance = first_fixes(self.graph, latest, self.variance[0] if known else None)
            if known and held[rows].any():
                self.accepted[rows] = True
            elif len(rows) > count:
                self.accepted &= ~absolute | self.trusted
                self.accepted[rows] = True
                self.variance[0] = max(variance, _LEAST_VARIANCE)
        self.poses = placed(self.graph.subset(self.accepted), self.poses)

    def copy(self) -> 'Growth':
        """Return a state to try something in."""
        clone = copy.copy(self)
        clone.accepted, clone._drops = self.accepted.copy(), self._drops.copy()
        return clone

    def part(self, rows: Indices) -> FactorGraph:
        """Return the graph of some factors, with the noise as it was found."""
        self._check()  # with this, each long step begins
        variance = np.maximum(self.variance, self._least_variance)
        return self.graph.subset(rows, np.where(
            self.factors.is_absolute[rows], 1.0, variance[self.is_loop[rows].astype(np.int64)]))

    def take_at_their_word(self) -> None:
        """From now on let factors be as noisy as they say, if they are not noisier."""
        self._least_variance = 1.0
        self._drops[:] = 0

    @property
    def takes_at_their_word(self) -> bool:
        """Whether `take_at_their_word` was called."""
        return self._least_variance == 1.0

    def undecided(self) -> Indices:
        """Return the factors that may yet be accepted, (k,)."""
        may = ~self.accepted & (self._drops < _CHANCES)
        undecided: Indices = np.flatnonzero(may & self.may_be_predicted)
        return undecided

    def undecided_loops(self) -> Indices:
        """Return the loops between keyframes among them, (k,)."""
        rows = self.undecided()
        return rows[(self.is_loop & ~self.factors.is_absolute)[rows]]

    def gate(self, freedom: Indices) -> Array:
        """Return what squared innovations of true factors stay below, (m,); freedom : theirs."""
        return sampled_quantile(1 - REFUSED, freedom)

    def settle(self) -> None:
        """Solve for the accepted factors, drop what does not fit any more, measure the noise."""
        drop = np.zeros(1, np.int64)
        while len(drop):
            self._keep_connected()
            rows = np.flatnonzero(self.accepted)
            part = self.part(rows)
            cholesky = cholesky_of(part)
            self._check()
            self.poses = solve(part, self.poses, cholesky, lambda *_: self._check())
            self._check()
            self.posterior = sample_posterior(part, self.poses, cholesky, self.rng)
            drop = self._misfits(rows)
            self.accepted[drop] = False
            self._drops[drop] += 1
        if not self.takes_at_their_word:
            self._learn_variance(rows)

    def _keep_connected(self) -> None:
        """Take all odometry back where the graph would fall apart without it."""
        if component_labels(self.part(np.flatnonzero(self.accepted))).any():
            self.accepted |= ~self.is_loop

    def _misfits(self, rows: Indices) -> Indices:
        """Return the accepted loops that do not fit, or that all others speak against."""
        freedom = self.factors.freedom[rows]
        may_go = self.is_loop[rows] & ~self.trusted[rows]
        far = (self.posterior.residual**2).sum(axis=1) > chi2_quantile(1 - _DROPPED, freedom)
        against = np.where(may_go, self.posterior.left_out(), 0.0)
        # Next to a false loop the true ones look bad too: only the worst go.
        far |= against > np.maximum(self.doubted(freedom), against.max(initial=0.0) / 2)
        misfits: Indices = rows[far & may_go]
        return misfits

    def doubted(self, freedom: Indices) -> Array:
        """Return what `Posterior.left_out` stays below, (m,), if all accepted ones are true."""
        accepted = int(np.count_nonzero(self.accepted))
        return sampled_quantile(1 - _DOUBTED / accepted, freedom)

    def _learn_variance(self, rows: Indices) -> None:
        """
        Compare the residuals with what the noise makes of them, for odometry and for loops.

        Absolute factors are as noisy as they say: of theirs a few tell nothing.
        """
        kind, known = self.is_loop[rows], _KNOWN * self.graph.manifold.TANGENT_SIZE
        own = np.where(self.factors.is_absolute[rows], 0.0, 1.0)
        found = np.bincount(kind, own * (self.posterior.residual**2).sum(axis=1), 2)
        stated = np.bincount(kind, own * np.trace(self.posterior.moment, axis1=1, axis2=2), 2)
        self._scale_variance((found + known) / (stated + known))

    def _scale_variance(self, scale: Array | float) -> None:
        self.variance = np.maximum(self.variance * scale, _LEAST_VARIANCE)

    def innovations(self, rows: Indices) -> Innovations:
        """Return how factors that are not accepted fit the map."""
        volume = claimed_volume(self.graph.manifold, self.poses, self.rng)
        return innovations(self.part(rows), self.poses, self.posterior, volume)

    def believable(self, rows: Indices) -> Indices:
        """Return which factors that are not accepted may be believed: each, or as pairs, (k,)."""
        if not len(rows):
            return rows
        found = self.innovations(rows)
        fits = np.flatnonzero(found.square < self.gate(found.freedom))
        log_ratio = found.log_ratio()[fits]
        # Taken at their word all are noisier than they are, so that more fit by chance: then only
        # the rest says how many of the rest are false.
        true = 0 if self.takes_at_their_word else np.count_nonzero(self.accepted & self.is_loop)
        odds = log_odds_of_false(log_ratio, len(rows) - len(fits), int(true))
        good = believable(log_ratio, odds)
        if not len(good):
            best = fits[np.argsort(-log_ratio, kind='stable')[:_CANDIDATES]]
            return self._pairs(found, rows, best, odds)
        believed: Indices = rows[fits[good]]
        return believed

    def _pairs(self, found: Innovations, rows: Indices, best: Indices, odds: float) -> Indices:
        """Return those of the best that vouch for each other, far from each other, (k,)."""
        a, b = (best[side] for side in np.triu_indices(len(best), 1))
        low, high = self.low[rows], self.high[rows]
        apart = np.abs(low[a] - low[b]) + np.abs(high[a] - high[b]) > _APART
        a, b = a[apart], b[apart]
        if not len(a):
            return rows[:0]
        square, log_ratio = found.joint(self.posterior, a, b)
        # To both being false by chance, the second one being so is as likely as the first.
        sure = log_ratio > np.log(1 / DOUBT - 1) + odds + max(odds, 0.0)
        good = sure & (square < self.gate(found.freedom[a] + found.freedom[b]))
        believed: Indices = rows[np.unique(np.concatenate((a[good], b[good])))]
        return believed

    def heads(self, rows: Indices) -> Indices:
        """Return which of some factors have a vote: the first of each group of them, (k,)."""
        return one_of_each_group(self.low[rows], self.high[rows], _APART)

    def some(self, rows: Indices, count: int) -> Indices:
        """Return so many of some factors, at random, or all, (k,)."""
        chosen: Indices = self.rng.permutation(rows)[:count]
        return chosen


def solve(graph: FactorGraph, poses: Array, cholesky: BlockCholesky,
          report: Report = lambda iteration, cost: None) -> Array:
    """
    Return the L2 map of a graph to within its noise: chi2 one above the optimum or less.

    From poses (n, p) that may be far off: where they do not fit to within the noise, first
    rotations alone, then translations, each of which is linear; then Gauss-Newton.
    """
    # In units of its noise, chi2 is about as large as there are spare measurements.
    k = graph.manifold.TANGENT_SIZE
    spare = max(int(graph.between.freedom.sum()) - k * (graph.n_poses - anchor(graph)), k)
    chi2 = _chi2(graph, poses)
    if chi2 > _FITS * spare:
        linear = _two_linear_steps(graph, poses, cholesky)
        poses = linear if _chi2(graph, linear) < chi2 else poses
    return minimise_l2(graph, poses, LeastSquaresOptions(_STEPS, 1 / spare), cholesky,
                       report).poses


def _two_linear_steps(graph: FactorGraph, poses: Array, cholesky: BlockCholesky) -> Array:
    manifold = graph.manifold
    for part in (manifold.ROTATION, manifold.TRANSLATION):
        system = linearise(graph, poses).part(part)
        x = weighted_least_squares(system, cholesky, np.ones_like(system.b))
        step = np.zeros((graph.n_poses - anchor(graph), manifold.TANGENT_SIZE))
        step[:, part] = x.reshape(len(step), -1)
        poses = step_poses(graph, poses, step)
    return poses


def _chi2(graph: FactorGraph, poses: Array) -> float:
    return l2_cost(whitened_residual(graph, poses))
