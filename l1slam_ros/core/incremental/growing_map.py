# SPDX-License-Identifier: Apache-2.0
"""
The poses of a factored map, and of what has come since, by one weighting of the factors.

In: a graph, the poses it was factored at, new factors one by one. Out: poses of all keyframes.

Jacobians of new factors are taken where their keyframes were first linearised, residuals where
they are: with Jacobians at poses that have moved since, a map turns for which no factor speaks
(Huang, Mourikis and Roumeliotis, "Observability-based rules for designing consistent EKF SLAM
estimators", 2010).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.graph.factor_graph import WORLD, FactorGraph
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.graph.linear_system import anchor
from l1slam_ros.core.incremental.border import FIXED, Border, Prediction, Steps
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky


@dataclass(frozen=True)
class Factor:
    """One factor: its keyframes, measurement (1, p) and root (k, k)."""

    pair: tuple[int, int]
    measurement: Array
    root: Array


@dataclass(frozen=True)
class Predicted:
    """
    A factor before it is part of the map.

    residual : (k,) where the keyframes are, whitened; covariance : (k, k) of what the map says of
    it, without its own noise; the rest is for `GrowingMap.add`.
    """

    factor: Factor
    residual: Array
    blocks: Array
    by_border: Prediction

    @property
    def covariance(self) -> Array:
        """See above."""
        return self.by_border.covariance


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
    poses : (n, p) at which it was, its optimum
    cholesky : holds the factor, and must stay

    """

    def __init__(self, graph: FactorGraph, poses: Array, cholesky: BlockCholesky):
        self._manifold, self.fixed = graph.manifold, anchor(graph)
        k = graph.manifold.TANGENT_SIZE
        self._border = Border(cholesky, len(poses) - self.fixed, k)
        self._first = GrowingArray((graph.manifold.POSE_SIZE,))
        self._first.extend(poses)

    def __len__(self) -> int:
        # What a factor that failed wanted to see does not count.
        return self.fixed + self._border.keyframes

    @property
    def rows(self) -> int:
        """How many rows have come since it was factored."""
        return self._border.rows

    @property
    def touched(self) -> int:
        """How many old keyframes were asked for."""
        return self._border.touched

    @property
    def view(self) -> View:
        """The map as it is now."""
        return View(self._manifold, self._first.view()[:len(self)], self.fixed,
                    self._border.steps())

    def pose(self, keyframe: int) -> Array:
        """Return where a keyframe is, (1, p)."""
        step = self._border.step(self._end(keyframe))
        return self._manifold.retract(self._first_pose(keyframe), step[None])

    def covariance(self, keyframe: int) -> Array:
        """Return the covariance of the step of a keyframe, (k, k)."""
        k = self._manifold.TANGENT_SIZE
        blocks = np.stack((np.eye(k), np.zeros((k, k))))
        return self._border.predict((self._end(keyframe), FIXED), blocks).covariance

    def predict(self, factor: Factor) -> Predicted:
        """
        Return what is known of a factor.

        One of its keyframes may be new: it is put where the factor wants it.
        """
        manifold, count = self._manifold, len(self)
        if count in factor.pair:
            step = factor.measurement
            if factor.pair[0] == count:
                step = manifold.inverse(step)
            self._first.extend(manifold.compose(self.pose(min(factor.pair)), step))
        J = manifold.residual_jacobians(factor.measurement,
                                        *(self._first_pose(end) for end in factor.pair))
        blocks = np.stack([factor.root @ side[0] for side in J])
        at = (self.pose(end) for end in factor.pair)
        residual = factor.root @ manifold.residual(factor.measurement, *at)[0]
        ends = self._end(factor.pair[0]), self._end(factor.pair[1])
        return Predicted(factor, residual, blocks, self._border.predict(ends, blocks))

    def add(self, predicted: Predicted, noise: Array) -> None:
        """Make a factor just predicted part of the map, with variances (k,) of its rows."""
        pair, blocks = predicted.factor.pair, predicted.blocks
        ends = [self._end(end) for end in pair]
        moved = sum(block @ self._border.step(end)
                    for block, end in zip(blocks, ends, strict=True))
        self._border.add_factor(predicted.by_border, noise, predicted.residual - moved)
        for end, block in zip(ends, blocks, strict=True):
            if end == self._border.keyframes:
                self._border.add_keyframe(block)

    def _end(self, keyframe: int) -> int:
        """Return what a keyframe is called in the border."""
        return max(keyframe - self.fixed, FIXED)

    def _first_pose(self, keyframe: int) -> Array:
        if keyframe == WORLD:
            return self._manifold.identity(1)
        return self._first.view()[keyframe:keyframe + 1]
