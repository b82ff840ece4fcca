# SPDX-License-Identifier: Apache-2.0
"""
A map that new factors move at once: what it costs hangs on what has come since it was factored.

In: a map, what is believed of its factors, and factors as they come. Out: which of them to
believe, and where all keyframes are. It is two maps: in that of least squares a factor's
innovation has a known distribution, so it is the gate; that of the weights 1 / sqrt(e^2 + mu^2)
has its optimum where the L1 norm has it, nearly, so it is the map that is shown.

Jacobians of new factors are taken where their keyframes were first linearised, residuals where
they are: with Jacobians at poses that have moved since, a map turns for which no factor speaks
(Huang, Mourikis and Roumeliotis, "Observability-based rules for designing consistent EKF SLAM
estimators", 2010).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import WORLD, BetweenFactors, FactorGraph
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.graph.linear_system import anchor, linearise
from l1slam_ros.core.incremental.border import FIXED, Border, Prediction, Steps
from l1slam_ros.core.robust.innovation import chi2_quantile, claimed_volume
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.optimality import smoothing

# The two maps.
L1, L2 = 0, 1
# Where the weights of the L1 map turn over, in mean |e|.
_SMOOTHING = 0.1
# One in so many true loops may be left to the judgement for its noise alone.
_REFUSED = 1e-3
# Of the loops admitted, one in so many may be false.
_SURE = 1000.0
# Rows of a border, and keyframes it touches, that one more update has the time and the memory for.
# What comes then waits for the next map.
_MOST_ROWS, _MOST_POINTS = 1800, 1400
# In the place of whether to believe a factor: the front finds out.
UNKNOWN = -1


@dataclass(frozen=True)
class Look:
    """What a first look at a factor says of it; see `Judgement`."""

    accepted: bool
    suspect: bool
    sigmas: float


# At what is left to the judgement, or was taken before.
_LEFT = Look(False, False, np.nan)


@dataclass(frozen=True)
class Linearised:
    """
    New factors, whitened, in both maps.

    ends : (m, 2) what their keyframes are called in the borders; blocks : (m, 2, 2, k, k) by map
    and side; residual : (m, 2, k) at no step
    """

    ends: Indices
    blocks: Array
    residual: Array

    def of(self, which: int, at: int) -> tuple[tuple[int, int], Array, Array]:
        """Return the ends, blocks and residual of one of them, in one of the maps."""
        i, j = self.ends[at].tolist()
        return (i, j), self.blocks[at, which], self.residual[at, which]


@dataclass(frozen=True)
class View:
    """
    One of the maps at one moment, to be worked out at leisure.

    first : (n, p) where the keyframes began; fixed : so many are held fixed; steps : of the others
    """

    manifold: Manifold
    first: Array
    fixed: int
    steps: Steps

    @cached_property
    def poses(self) -> Array:
        """All keyframes, (n, p)."""
        moved = self.manifold.retract(self.first[self.fixed:], self.steps.all())
        return np.concatenate((self.first[:self.fixed], moved))


class Front:
    """
    The map since it was factored.

    Parameters
    ----------
    part : the factors that are believed
    poses : their L1 map, (n, p), and their L2 map with the noise as it was found
    choleskys : of the part, the second holds the factor of that L2 map; the front keeps them
    variance : (2,) of odometry and loops, in units of what they state
    log_odds : of a false loop to a true one
    rows : factors of the graph that grows, when `part` was taken from it

    Attributes
    ----------
    rows : how many of them it knows; taken : of these it was to take, or to look at
    closed : it takes no more
    pattern : of its factors

    Raises
    ------
    GraphError : some keyframe is not tied to the anchor.

    """

    def __init__(self, part: FactorGraph, poses: tuple[Array, Array],
                 choleskys: tuple[BlockCholesky, BlockCholesky], variance: Array,
                 log_odds: float, rows: int):
        self.rows, self.taken, self.closed = rows, 0, False
        self.pattern = choleskys[L1].pattern
        self._manifold, self._fixed = part.manifold, anchor(part)
        system, k = linearise(part, poses[L1]), part.manifold.TANGENT_SIZE
        # What a square stays below, and the log ratio but for what hangs on the factor.
        self._limit = float(chi2_quantile(1 - _REFUSED, np.array([k]))[0])
        self._volume = (float(claimed_volume(part.manifold, poses[L1]).sum())
                        - k * np.log(2 * np.pi) / 2 - np.log(_SURE - 1) - log_odds)
        self._variance = np.repeat(variance[:, None], k, axis=1)
        self._mu = _SMOOTHING * smoothing(system.b)
        weights = 1 / np.hypot(system.b, self._mu)
        if not choleskys[L1].factorise(system, weights):
            raise GraphError('a part of the graph is not tied to the anchor')
        # What residual is left of a new factor, those to come will say: till then a keyframe's
        # first one is weighed as the others are in the mean, one without a residual among them,
        # and a loop halfway between that and what it says itself.
        self._usual = np.full(k, 1 / np.append(weights, 1 / self._mu).mean())
        self._borders = [Border(cholesky, system.size, k, _MOST_POINTS, _MOST_ROWS)
                         for cholesky in choleskys]
        self._first = GrowingArray((2, part.manifold.POSE_SIZE))
        self._first.extend(np.stack(poses, axis=1))

    @property
    def keyframes(self) -> int:
        """How many keyframes it knows."""
        # What a factor that failed wanted to see does not count.
        return self._fixed + self._borders[L1].keyframes

    @property
    def border(self) -> int:
        """How many rows have come since it was factored."""
        return self._borders[L1].rows

    @property
    def views(self) -> tuple[View, View]:
        """The L1 and the L2 map as they are now."""
        first = self._first.view()[:self.keyframes]
        return (View(self._manifold, first[:, L1], self._fixed, self._borders[L1].steps()),
                View(self._manifold, first[:, L2], self._fixed, self._borders[L2].steps()))

    @property
    def newest(self) -> Array:
        """The L1 pose of the last keyframe it knows, (1, p)."""
        last = self.keyframes - 1
        step = self._borders[L1].step([max(last - self._fixed, FIXED)])
        return self._manifold.retract(self._first.view()[last:last + 1, L1], step)

    def covariance(self, keyframe: int) -> Array:
        """Return the covariance of a keyframe's step from the L2 map, (k, k)."""
        return self._borders[L2].covariance(max(keyframe - self._fixed, FIXED))

    def take(self, factors: BetweenFactors, accept: Indices) -> list[Look]:
        """
        Take the next factors, from row `rows` on, a few at a time; return looks at those it took.

        accept : of each 1 to believe it, 0 not to, `UNKNOWN`: find out. Fewer than these: the next
        one cannot be, and it takes no more.
        """
        looks: list[Look] = []
        asked = np.flatnonzero(accept)
        if not len(asked):
            self.rows += len(accept)
            return len(accept) * [_LEFT]
        self.closed = self._is_beyond(factors, self.rows + asked[0], accept[asked[0]])
        if self.closed:
            return looks
        # Only these: each keyframe that is touched makes the next one cost more.
        linearised = self._linearise(factors, self.rows + asked)
        for known, at in zip(accept.tolist(), np.cumsum(accept != 0).tolist(), strict=True):
            look = (_LEFT if not known else
                    None if self._is_beyond(factors, self.rows, known) else
                    self._look(factors, linearised, at - 1, known))
            self.closed = look is None
            if look is None:
                break
            self.rows += 1
            self.taken += known != 0
            looks.append(look)
        return looks

    def _is_beyond(self, factors: BetweenFactors, row: int, known: int) -> bool:
        """Tell whether a factor is for the next map."""
        return (max(factors.i[row], factors.j[row]) > self.keyframes
                or (known == 1 and self._turns(factors, row))
                or self.border > _MOST_ROWS or self._borders[L2].points > _MOST_POINTS)

    def _turns(self, factors: BetweenFactors, row: int) -> bool:
        """Tell whether a factor is the first that names the world: the gauge is another."""
        return bool(factors.i[row] == WORLD) and self._fixed > 0

    def _look(self, factors: BetweenFactors, new: Linearised, at: int, known: int) -> Look | None:
        """Look at a factor, and make it part of the map where it is accepted; None: it cannot."""
        own = np.diag(factors.sqrt_information[self.rows])
        # What is silent of some component is for the judgement.
        if known == UNKNOWN and (self._turns(factors, self.rows) or not own.all()):
            return Look(False, True, np.nan)
        first_seen = self.keyframes in (factors.i[self.rows], factors.j[self.rows])
        l1, l2 = self._borders
        try:
            if first_seen:
                l2.begin(*new.of(L2, at), self._variance[0])
                l1.begin(*new.of(L1, at), self._usual)
                return Look(True, False, 0.0)
            variance, predicted = self._variance[1], l2.predict(*new.of(L2, at))
            look, left = self._test(predicted, own, variance, known == 1)
            if look.accepted:
                l2.add(predicted, variance)
                noise = np.sqrt(self._usual * np.hypot(left, self._mu))
                l1.add(l1.predict(*new.of(L1, at)), noise)
        except np.linalg.LinAlgError:
            # Beyond double precision: the next map may be able to.
            return None
        return look

    def _test(self, predicted: Prediction, own: Array, variance: Array,
              sure: bool) -> tuple[Look, Array]:
        """Return what to make of a loop, and its residual once it is part of the map, (k,)."""
        covariance = predicted.covariance + np.diag(variance)
        whitened = np.linalg.solve(covariance, predicted.residual)
        square, left = float(predicted.residual @ whitened), variance * whitened
        sigmas = float(np.sqrt(left @ (left / variance)))
        if sure:
            return Look(True, False, sigmas), left
        log_ratio = float(self._volume + np.log(own).sum() - square / 2
                          - np.linalg.slogdet(covariance)[1] / 2)
        fits = square < self._limit
        accepted = fits and log_ratio > 0
        return Look(accepted, fits and not accepted,
                    sigmas if accepted else float(np.sqrt(square))), left

    def _linearise(self, factors: BetweenFactors, rows: Indices) -> Linearised:
        """
        Return some factors as the borders want them.

        Those that see keyframes for the first time see them in their order: these are put where
        the factors want them. After a gap in that order none is returned.
        """
        manifold = self._manifold
        pairs = np.stack((factors.i[rows], factors.j[rows]), axis=1)
        known = np.maximum.accumulate(np.append(len(self._first) - 1, pairs.max(axis=1)))
        gaps = np.flatnonzero(np.diff(known) > 1)
        pairs = pairs[:gaps[0] if len(gaps) else None]
        Z = factors.measurement[rows][:len(pairs)]
        for row in np.flatnonzero((pairs >= len(self._first)).any(axis=1)).tolist():
            if pairs[row].max() == len(self._first):
                step = Z[row] if pairs[row, 1] == len(self._first) else manifold.inverse(Z[row])
                self._first.extend(manifold.compose(
                    self._moved(pairs[row].min(keepdims=True))[2], step))
        first, steps, poses = self._moved(pairs.T.ravel())
        p, k = first.shape[2], steps.shape[2]
        Z, root = np.repeat(Z, 2, axis=0), factors.sqrt_information[rows][:len(pairs), None]
        J = manifold.residual_jacobians(Z, *first.reshape(2, -1, p)).reshape(-1, 2, 2, k, k)
        e = manifold.residual(Z, *poses.reshape(2, -1, p)).reshape(-1, 2, k)
        blocks, steps = root[:, None] @ J, steps.reshape(2, -1, 2, k).transpose(1, 2, 0, 3)
        residual = (root @ e[..., None])[..., 0] - (blocks @ steps[..., None])[..., 0].sum(axis=2)
        return Linearised(np.maximum(pairs - self._fixed, FIXED), blocks, residual)

    def _moved(self, keyframes: Indices) -> tuple[Array, Array, Array]:
        """Return where keyframes began, their steps and where they are, (m, 2, p or k) each."""
        manifold = self._manifold
        first = self._first.view()[keyframes]
        first[keyframes == WORLD] = manifold.identity(1)
        ends = np.maximum(keyframes - self._fixed, FIXED).tolist()
        steps = np.stack([border.step(ends) for border in self._borders], axis=1)
        return first, steps, manifold.retract(first, steps)
