# SPDX-License-Identifier: Apache-2.0
"""
The poses of a factored map, and of what has come since, by two weightings of the factors.

In: a graph, the poses it was factored at, new factors as they come. Out: poses of all keyframes.

Jacobians of new factors are taken where their keyframes were first linearised, residuals where
they are: with Jacobians at poses that have moved since, a map turns for which no factor speaks
(Huang, Mourikis and Roumeliotis, "Observability-based rules for designing consistent EKF SLAM
estimators", 2010).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import WORLD, BetweenFactors, FactorGraph
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.graph.linear_system import anchor
from l1slam_ros.core.incremental.border import FIXED, Border, Prediction, Steps
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky

# The two weightings.
L1, L2 = 0, 1


@dataclass(frozen=True)
class Linearised:
    """
    New factors, whitened, in both weightings.

    ends : (m, 2) what their keyframes are called in the borders; blocks : (m, 2, 2, k, k) by
    weighting and side; residual : (m, 2, k) at no step
    """

    ends: Indices
    blocks: Array
    residual: Array

    def of(self, weighting: int, at: int) -> tuple[tuple[int, int], Array, Array]:
        """Return the ends, blocks and residual of one of them."""
        i, j = self.ends[at].tolist()
        return (i, j), self.blocks[at, weighting], self.residual[at, weighting]


@dataclass(frozen=True)
class View:
    """
    The map at one moment, to be worked out at leisure.

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


class GrowingMap:
    """
    A map on which factors may be tried and put.

    Parameters
    ----------
    graph : what was factored
    poses : two of (n, p) at which it was, its optima
    choleskys : hold the factors, and must stay
    points, rows : see `Border`

    """

    def __init__(self, graph: FactorGraph, poses: tuple[Array, Array],
                 choleskys: tuple[BlockCholesky, BlockCholesky], points: int, rows: int):
        self._manifold, self.fixed = graph.manifold, anchor(graph)
        k, size = graph.manifold.TANGENT_SIZE, graph.n_poses - self.fixed
        self._borders = [Border(cholesky, size, k, points, rows) for cholesky in choleskys]
        self._first = GrowingArray((2, graph.manifold.POSE_SIZE))
        self._first.extend(np.stack(poses, axis=1))

    def __len__(self) -> int:
        # What a factor that failed wanted to see does not count.
        return self.fixed + self._borders[L1].keyframes

    @property
    def rows(self) -> int:
        """How many rows have come since it was factored."""
        return self._borders[L1].rows

    @property
    def points(self) -> int:
        """How many keyframes were asked for, or are new."""
        return self._borders[L2].points

    @property
    def views(self) -> tuple[View, View]:
        """The map as it is now."""
        first = self._first.view()[:len(self)]
        return (View(self._manifold, first[:, L1], self.fixed, self._borders[L1].steps()),
                View(self._manifold, first[:, L2], self.fixed, self._borders[L2].steps()))

    @property
    def newest(self) -> Array:
        """The L1 pose of the last keyframe, (1, p)."""
        last = len(self) - 1
        step = self._borders[L1].step([max(last - self.fixed, FIXED)])
        return self._manifold.retract(self._first.view()[last:last + 1, L1], step)

    def covariance(self, keyframe: int) -> Array:
        """Return the covariance of the step of a keyframe in the L2 map, (k, k)."""
        return self._borders[L2].covariance(max(keyframe - self.fixed, FIXED))

    def linearise(self, factors: BetweenFactors, rows: slice) -> Linearised:
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
        J = manifold.residual_jacobians(Z, *first.reshape(2, -1, p))
        e = manifold.residual(Z, *poses.reshape(2, -1, p)).reshape(-1, 2, k)
        sides = [root @ side.reshape(-1, 2, k, k) for side in J]
        residual = (root @ e[..., None])[..., 0]
        for side, step in zip(sides, steps.reshape(2, -1, 2, k), strict=True):
            residual -= (side @ step[..., None])[..., 0]
        return Linearised(np.maximum(pairs - self.fixed, FIXED), np.stack(sides, axis=2), residual)

    def begin(self, weighting: int, factors: Linearised, at: int, noise: Array) -> None:
        """
        Append the next keyframe by one of some factors, with variances (k,) of its rows.

        Raises
        ------
        LinAlgError : the factor does not say where it is.

        """
        self._borders[weighting].begin(*factors.of(weighting, at), noise)

    def predict(self, weighting: int, factors: Linearised, at: int) -> Prediction:
        """Return what is known of one of some factors."""
        return self._borders[weighting].predict(*factors.of(weighting, at))

    def add(self, weighting: int, predicted: Prediction, noise: Array) -> None:
        """
        Make a factor just predicted part of the map, with variances (k,) of its rows.

        Raises
        ------
        LinAlgError : beyond double precision.

        """
        self._borders[weighting].add(predicted, noise)

    def _moved(self, keyframes: Indices) -> tuple[Array, Array, Array]:
        """Return where keyframes began, their steps and where they are, (m, 2, p or k) each."""
        manifold = self._manifold
        first = self._first.view()[keyframes]
        first[keyframes == WORLD] = manifold.identity(1)
        ends = np.maximum(keyframes - self.fixed, FIXED).tolist()
        steps = np.stack([border.step(ends) for border in self._borders], axis=1)
        return first, steps, manifold.retract(first, steps)
