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
from l1slam_ros.core.incremental.border import Prediction
from l1slam_ros.core.incremental.growing_map import L1, L2, GrowingMap, Linearised, View
from l1slam_ros.core.robust.innovation import chi2_quantile, claimed_volume
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.optimality import smoothing

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
        volume = claimed_volume(manifold, poses)
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
    poses : their L1 map, (n, p), and their L2 map with the noise as it was found
    choleskys : of the part, the second holds the factor of that L2 map; the front keeps them
    gate : see `Gate`
    rows : factors of the graph that grows, when `part` was taken from it

    Attributes
    ----------
    rows : how many of them it knows; taken : of these have come since it was made
    closed : it takes no more

    Raises
    ------
    GraphError : some keyframe is not tied to the anchor.

    """

    def __init__(self, part: FactorGraph, poses: tuple[Array, Array],
                 choleskys: tuple[BlockCholesky, BlockCholesky], gate: Gate, rows: int):
        self.rows, self.taken, self.closed = rows, 0, False
        system, k = linearise(part, poses[L1]), part.manifold.TANGENT_SIZE
        # What a square stays below, and the log ratio but for what hangs on the factor.
        self._limit = float(chi2_quantile(1 - _REFUSED, np.array([k]))[0])
        self._volume = (gate.log_volume - k * np.log(2 * np.pi) / 2
                        - np.log(_SURE - 1) - gate.log_odds)
        self._variance = np.repeat(gate.variance[:, None], k, axis=1)
        self._mu = _SMOOTHING * smoothing(system.b)
        weights = 1 / np.hypot(system.b, self._mu)
        if not choleskys[L1].factorise(system, weights):
            raise GraphError('a part of the graph is not tied to the anchor')
        # Of a keyframe's first factor, whose residual the loops to come will say: it is weighed
        # as the others are in the mean, one without a residual among them.
        self._usual = 1 / np.append(weights, 1 / self._mu).mean()
        self._map = GrowingMap(part, poses, choleskys, _MOST_POINTS, _MOST_ROWS)

    @property
    def keyframes(self) -> int:
        """How many keyframes it knows."""
        return len(self._map)

    @property
    def border(self) -> int:
        """How many rows have come since it was factored."""
        return self._map.rows

    @property
    def views(self) -> tuple[View, View]:
        """The L1 and the L2 map as they are now."""
        return self._map.views

    @property
    def newest(self) -> Array:
        """The pose of the last keyframe it knows, (1, p)."""
        return self._map.newest

    def covariance(self, keyframe: int) -> Array:
        """Return the covariance of a keyframe's step from the L2 map, (k, k)."""
        return self._map.covariance(keyframe)

    def take(self, factors: BetweenFactors, accept: Indices) -> list[Look]:
        """
        Take the next factors, from row `rows` on, a few at a time; return looks at those it took.

        accept : of each 1 to believe it, 0 not to, `UNKNOWN`: find out. Fewer than these: the next
        one cannot be, and it takes no more.
        """
        looks: list[Look] = []
        self.closed = self._is_beyond(factors, int(accept[0]))
        if self.closed:
            return looks
        linearised = self._map.linearise(factors, slice(self.rows, self.rows + len(accept)))
        for at, known in enumerate(accept.tolist()):
            look = None if self._is_beyond(factors, known) else self._look(
                factors, linearised, at, known)
            self.closed = look is None
            if look is None:
                break
            self.rows += 1
            self.taken += 1
            looks.append(look)
        return looks

    def _is_beyond(self, factors: BetweenFactors, known: int) -> bool:
        """Tell whether the next factor is for the next map."""
        return (max(factors.i[self.rows], factors.j[self.rows]) > self.keyframes
                or (known == 1 and self._turns(factors))
                or self.border > _MOST_ROWS or self._map.points > _MOST_POINTS)

    def _turns(self, factors: BetweenFactors) -> bool:
        """Tell whether the next factor is the first that names the world: the gauge is another."""
        return bool(factors.i[self.rows] == WORLD) and self._map.fixed > 0

    def _look(self, factors: BetweenFactors, new: Linearised, at: int, known: int) -> Look | None:
        """Look at a factor, and make it part of the map where it is accepted; None: it cannot."""
        own = np.diag(factors.sqrt_information[self.rows])
        # What is silent of some component is for the judgement, too.
        if not known or (known == UNKNOWN and (self._turns(factors) or not own.all())):
            return Look(False, known == UNKNOWN, np.nan)
        first_seen = self.keyframes in (factors.i[self.rows], factors.j[self.rows])
        try:
            if first_seen:
                self._map.begin(L2, new, at, self._variance[0])
                self._map.begin(L1, new, at, np.full(len(own), self._usual))
                return Look(True, False, 0.0)
            variance, predicted = self._variance[1], self._map.predict(L2, new, at)
            look, left = self._test(predicted, own, variance, known == 1)
            if look.accepted:
                self._map.add(L2, predicted, variance)
                self._map.add(L1, self._map.predict(L1, new, at), np.hypot(left, self._mu))
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
