# SPDX-License-Identifier: Apache-2.0
"""
A map that new factors move at once: what it costs hangs on what has come since it was factored.

In: a map, what is believed of its factors, and factors as they come. Out: which of them to
believe, and where all keyframes are. There are two borders on one linearisation: in that of least
squares a factor's innovation has a known distribution, so it is the gate; that of the weights
1 / sqrt(e^2 + mu^2) has its minimum where the L1 norm has it, nearly, so it is the map.

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
from l1slam_ros.core.graph.factor_graph import BetweenFactors, FactorGraph
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.graph.linear_system import anchor, linearise
from l1slam_ros.core.incremental.border import FIXED, Border, Steps
from l1slam_ros.core.robust.innovation import chi2_quantile, claimed_volume
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.optimality import smoothing

# Where the weights of the L1 map turn over, in mean |e|.
_SMOOTHING = 0.03
# One in so many true loops may be left to the judgement for its noise alone.
_REFUSED = 1e-3
# Of the loops admitted, one in so many may be false.
_SURE = 1000.0
# Rows of a border that one more update has the time for. What comes then waits for the next map.
MOST_ROWS = 1800


@dataclass(frozen=True)
class Gate:
    """
    What a factor is tested by.

    variance : (2,) of odometry and loops, in units of what they state; log_odds : of a false loop
    to a true one; log_volume : that the claims of false loops fill
    """

    variance: Array
    log_odds: float
    log_volume: float

    @staticmethod
    def of(manifold: Manifold, poses: Array, variance: Array, accepted: int,
           refused: int) -> 'Gate':
        """Return the gate of a map, poses (n, p), that so many loops were believed for or not."""
        volume = claimed_volume(manifold, poses, np.random.default_rng(0))
        return Gate(variance, max(0.0, float(np.log((refused + 1) / (accepted + 1)))), volume)


@dataclass(frozen=True)
class Look:
    """What a first look at a factor says of it; see `Judgement`."""

    accepted: bool
    suspect: bool
    sigmas: float


@dataclass(frozen=True)
class View:
    """The map at one moment, to be worked out at leisure: first (n, p), and steps from there."""

    manifold: Manifold
    first: Array
    steps: Steps

    @cached_property
    def poses(self) -> Array:
        """All keyframes that the front knows, (n, p)."""
        steps = self.steps.all()
        fixed = len(self.first) - len(steps)
        moved = self.manifold.retract(self.first[fixed:], steps)
        return np.concatenate((self.first[:fixed], moved))


@dataclass(frozen=True)
class _Factor:
    """One factor: its keyframes, measurement (1, p), root and whitened Jacobians (2, k, k)."""

    pair: tuple[int, int]
    measurement: Array
    root: Array
    blocks: Array


class Front:
    """
    The map since it was factored.

    Parameters
    ----------
    part : the factors that are believed
    poses : (n, p) their L1 map
    cholesky : of the part; the front keeps it
    loops : (m,) 1 for each factor that is a loop, 0 for odometry
    gate : see `Gate`
    rows : factors of the graph that grows, when `part` was taken from it

    Attributes
    ----------
    rows : how many of them it knows
    closed : it takes no more

    Raises
    ------
    GraphError : some keyframe is not tied to the anchor.

    """

    def __init__(self, part: FactorGraph, poses: Array, cholesky: BlockCholesky, loops: Indices,
                 gate: Gate, rows: int):
        self._manifold, self._gate, self.rows, self.closed = part.manifold, gate, rows, False
        self._fixed = anchor(part)
        system = linearise(part, poses)
        k, e = system.block_size, -system.b
        self._mu = _SMOOTHING * smoothing(e)
        variance = np.ones(len(e))
        variance[:len(loops) * k] = np.repeat(gate.variance[loops], k)
        other = BlockCholesky(cholesky.pattern, system.keyframe)
        if not (cholesky.factorise(system, 1 / np.hypot(e, self._mu))
                and other.factorise(system, 1 / variance)):
            raise GraphError('a part of the graph is not tied to the anchor')
        # From the L1 map to the L2 map.
        self._offset = other.solve(system.transposed_times(system.b / variance)).reshape(-1, k)
        self._l1, self._l2 = (Border(factored, system.size, k) for factored in (cholesky, other))
        self._first = GrowingArray((part.manifold.POSE_SIZE,))
        self._first.extend(poses)

    @property
    def keyframes(self) -> int:
        """How many keyframes it knows."""
        return len(self._first)

    @property
    def border(self) -> int:
        """How many rows the borders have."""
        return self._l1.rows

    @property
    def view(self) -> View:
        """The map as it is now."""
        return View(self._manifold, self._first.view(), self._l1.steps())

    @property
    def newest(self) -> Array:
        """The pose of the last keyframe it knows, (1, p)."""
        return self._pose(self.keyframes - 1, self._l1)

    def covariance(self, keyframe: int) -> Array:
        """Return the covariance of a keyframe's step from the least squares map, (k, k)."""
        k = self._manifold.TANGENT_SIZE
        blocks = np.stack((np.eye(k), np.zeros((k, k))))
        return self._l2.predict((self._end(keyframe), FIXED), blocks).covariance

    def add(self, factors: BetweenFactors, accept: bool | None) -> Look | None:
        """
        Take the next factor, row `rows`; None: that cannot be, and it takes no more.

        accept : whether to believe it, None: find out
        """
        row, count = self.rows, self.keyframes
        pair = int(factors.i[row]), int(factors.j[row])
        # Where something new is tied to nothing, or the gauge is another: the next map's.
        if self.border > MOST_ROWS or max(pair) > count or min(pair) < self._fixed - 1:
            self.closed = True
            return None
        self.rows += 1
        if accept is False:
            return Look(False, False, np.nan)
        measurement, root = factors.measurement[row:row + 1], factors.sqrt_information[row]
        new = count in pair
        if new:
            step = measurement if pair[1] == count else self._manifold.inverse(measurement)
            self._first.extend(self._manifold.compose(self._pose(min(pair), self._l1), step))
        J = self._manifold.residual_jacobians(
            measurement, *(self._first_pose(keyframe) for keyframe in pair))
        factor = _Factor(pair, measurement, root, np.stack([root @ side[0] for side in J]))
        look = self._commit(factor, accept or new, float(self._gate.variance[0 if new else 1]))
        if new:
            for border in (self._l1, self._l2):
                border.add_keyframe(factor.blocks[pair.index(count)])
        return look

    def _commit(self, factor: _Factor, sure: bool, variance: float) -> Look:
        """Look at a factor; make it part of the map where it is believed."""
        k, ends = len(factor.root), (self._end(factor.pair[0]), self._end(factor.pair[1]))
        predicted = self._l2.predict(ends, factor.blocks)
        residual, linear = self._residual(factor, self._l2)
        root = np.linalg.cholesky(predicted.covariance + variance * np.eye(k))
        innovation = np.linalg.solve(root, residual)
        square = float(innovation @ innovation)
        density = -square / 2 - k * np.log(2 * np.pi) / 2 - np.log(np.diag(root)).sum()
        ratio = density + self._gate.log_volume + np.log(np.diag(factor.root)).sum()
        fits = square < chi2_quantile(1 - _REFUSED, k)
        if not sure and (not fits or ratio < np.log(_SURE - 1) + self._gate.log_odds):
            return Look(False, fits, float(np.sqrt(square)))
        self._l2.add_factor(predicted, np.full(k, variance), linear)
        left = variance * np.linalg.solve(root.T, innovation)
        predicted = self._l1.predict(ends, factor.blocks)
        self._l1.add_factor(predicted, np.hypot(left, self._mu),
                            self._residual(factor, self._l1)[1])
        return Look(True, False, float(np.sqrt(left @ left / variance)))

    def _residual(self, factor: _Factor, border: Border) -> tuple[Array, Array]:
        """Return the residual (k,) where the keyframes are, and what it would be at no step."""
        at, linear = [], np.zeros(len(factor.root))
        for keyframe, block in zip(factor.pair, factor.blocks, strict=True):
            at.append(self._pose(keyframe, border))
            linear -= block @ self._step(keyframe, border)
        residual = factor.root @ self._manifold.residual(factor.measurement, *at)[0]
        return residual, residual + linear

    def _end(self, keyframe: int) -> int:
        """Return what a keyframe is called in the borders."""
        return max(keyframe - self._fixed, FIXED)

    def _step(self, keyframe: int, border: Border) -> Array:
        """Return how far a keyframe is from where it began, (k,)."""
        end = self._end(keyframe)
        step = border.step(end)
        if border is self._l2 and 0 <= end < len(self._offset):
            step = step + self._offset[end]
        return step

    def _pose(self, keyframe: int, border: Border) -> Array:
        return self._manifold.retract(self._first_pose(keyframe),
                                      self._step(keyframe, border)[None])

    def _first_pose(self, keyframe: int) -> Array:
        return self._first.view()[keyframe:keyframe + 1]
