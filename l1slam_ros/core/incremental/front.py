# SPDX-License-Identifier: Apache-2.0
"""
A map that new factors move at once: what it costs hangs on what has come since it was factored.

In: a map, what is believed of its factors, and factors as they come. Out: which of them to
believe, and where all keyframes are. It is two maps: in that of least squares a factor's
innovation has a known distribution, so it is the gate; that of the weights 1 / sqrt(e^2 + mu^2)
has its optimum where the L1 norm has it, nearly, so it is the map that is shown.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import WORLD, BetweenFactors, FactorGraph
from l1slam_ros.core.graph.linear_system import linearise
from l1slam_ros.core.incremental.growing_map import Factor, GrowingMap, Predicted, View
from l1slam_ros.core.robust.innovation import chi2_quantile, claimed_volume
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.optimality import smoothing

# Where the weights of the L1 map turn over, in mean |e|.
_SMOOTHING = 0.03
# One in so many true loops may be left to the judgement for its noise alone.
_REFUSED = 1e-3
# Of the loops admitted, one in so many may be false.
_SURE = 1000.0
# Rows of a border, and keyframes touched, that one more update has the time and the memory for.
# What comes then waits for the next map.
_MOST_ROWS, _MOST_TOUCHED = 1800, 700


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
        return Gate(variance, max(0.0, float(np.log((refused + 1) / (accepted + 1)))),
                    float(volume.sum()))


@dataclass(frozen=True)
class Look:
    """What a first look at a factor says of it; see `Judgement`."""

    accepted: bool
    suspect: bool
    sigmas: float


class Front:
    """
    The map since it was factored.

    Parameters
    ----------
    part : the factors that are believed
    poses, l2_poses : (n, p) their L1 map, and their L2 map with the noise as it was found
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

    def __init__(self, part: FactorGraph, poses: Array, l2_poses: Array, cholesky: BlockCholesky,
                 loops: Indices, gate: Gate, rows: int):
        self._gate, self.rows, self.closed = gate, rows, False
        system, k = linearise(part, poses), part.manifold.TANGENT_SIZE
        self._mu = _SMOOTHING * smoothing(system.b)
        other, l2_system = BlockCholesky(cholesky.pattern, system.keyframe), linearise(
            part, l2_poses)
        variance = np.ones(len(system.b))
        variance[:len(loops) * k] = np.repeat(gate.variance[loops], k)
        if not (cholesky.factorise(system, 1 / np.hypot(system.b, self._mu))
                and other.factorise(l2_system, 1 / variance)):
            raise GraphError('a part of the graph is not tied to the anchor')
        self._l1, self._l2 = (GrowingMap(part, poses, cholesky),
                              GrowingMap(part, l2_poses, other))

    @property
    def keyframes(self) -> int:
        """How many keyframes it knows."""
        return len(self._l1)

    @property
    def border(self) -> int:
        """How many rows have come since it was factored."""
        return self._l1.rows

    @property
    def views(self) -> tuple[View, View]:
        """The L1 and the L2 map as they are now."""
        return self._l1.view, self._l2.view

    @property
    def newest(self) -> Array:
        """The pose of the last keyframe it knows, (1, p)."""
        return self._l1.pose(self.keyframes - 1)

    def covariance(self, keyframe: int) -> Array:
        """Return the covariance of a keyframe's step from the L2 map, (k, k)."""
        return self._l2.covariance(keyframe)

    def add(self, factors: BetweenFactors, accept: bool | None) -> Look | None:
        """
        Take the next factor, row `rows`; None: that cannot be, and it takes no more.

        accept : whether to believe it, None: find out
        """
        row, count = self.rows, self.keyframes
        pair = int(factors.i[row]), int(factors.j[row])
        # The first that is believed of those that name the world gives the map another gauge.
        other_gauge = min(pair) == WORLD and self._l1.fixed > 0
        if (max(pair) > count or (accept and other_gauge) or self.border > _MOST_ROWS
                or self._l2.touched > _MOST_TOUCHED):
            self.closed = True
            return None
        self.rows += 1
        factor = Factor(pair, factors.measurement[row:row + 1], factors.sqrt_information[row])
        # What is silent of some component is for the judgement, too.
        if accept is False or other_gauge or (accept is None and not np.diag(factor.root).all()):
            return Look(False, accept is None, np.nan)
        new = count in pair
        variance = np.full(len(factor.root), self._gate.variance[0 if new else 1])
        predicted = self._l2.predict(factor)
        look, left = self._look(predicted, variance, bool(accept) or new)
        if look.accepted:
            self._l2.add(predicted, variance)
            self._l1.add(self._l1.predict(factor), np.hypot(left, self._mu))
        return look

    def _look(self, predicted: Predicted, variance: Array, sure: bool) -> tuple[Look, Array]:
        """Return what to make of a factor, and its residual once it is part of the map, (k,)."""
        k = len(variance)
        root = np.linalg.cholesky(predicted.covariance + np.diag(variance))
        innovation = np.linalg.solve(root, predicted.residual)
        square = float(innovation @ innovation)
        own = np.diag(predicted.factor.root)
        log_ratio = (self._gate.log_volume + np.log(own[own > 0]).sum()
                     - square / 2 - k * np.log(2 * np.pi) / 2 - np.log(np.diag(root)).sum())
        fits = square < float(chi2_quantile(1 - _REFUSED, np.array([k]))[0])
        left = variance * np.linalg.solve(root.T, innovation)
        if sure or (fits and float(log_ratio) > np.log(_SURE - 1) + self._gate.log_odds):
            return Look(True, False, float(np.sqrt((left * left / variance).sum()))), left
        return Look(False, fits, float(np.sqrt(square))), left
