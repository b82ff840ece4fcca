# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A factored normal matrix, bordered by what has come since: Woodbury's identity, row by row.

In: H = L L' of the keyframes there were, then factors and keyframes one by one. Out: steps of all
keyframes, and the exact covariance of any linear function of them.

A new keyframe is where the factor says that sees it first, see `points`; that gives the means m
and the covariance C of all keyframes. With A the blocks of all other factors, W^-1 their noise and
r their residuals, the least squares solution is

    x = m + C A' lambda,    S lambda = -(r + A m),    S = W^-1 + A C A',

where S, the covariance of the innovations, is kept as F F', F lower triangular. A factor that is
appended costs one substitution, and its pivot before the noise is added is the covariance of its
innovation given all others: who predicts a factor before appending it has the gate for free.

Hager, "Updating the inverse of a matrix", SIAM Review 31, 1989.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core import kernels
from l1slam_ros.core.bordered.points import FIXED, Points, PointsNow, triangle
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky


@dataclass(frozen=True)
class Prediction:
    """
    The innovation: what the map predicts for r + J x without the factor.

    residual : (k,) to expect; covariance : (k, k) of it, without the factor's own noise; rows :
    (k, rows) of F, to be; points (2,), blocks (2, k, k) : of the factor
    """

    residual: Array
    covariance: Array
    rows: Array
    points: Indices
    blocks: Array


@dataclass(frozen=True)
class Rows:
    """
    The factors of the border at one moment.

    ends : (b, 2) points; blocks : (b, 2, k, k), A; factor : the triangle F, row after row; right :
    (b k,) F^-1 times the right hand side
    """

    ends: Indices
    blocks: Array
    factor: Array
    right: Array

    def gradient(self, points: int) -> Array:
        """Return A' lambda at so many points, (t, k)."""
        gradient = np.zeros((points, self.blocks.shape[-1]))
        kernels.border.pull(self.factor, self.right, self.ends, self.blocks, gradient)
        return gradient


@dataclass(frozen=True)
class Steps:
    """The steps of all keyframes at one moment, worked out when they are asked for."""

    points: PointsNow
    rows: Rows

    def all(self) -> Array:
        """Return the steps of all keyframes, (n + b, k)."""
        return self.points.steps(self.rows.gradient(len(self.points.mean)))


class BorderedSystem:
    """
    The system of one weighting; keyframes are those of the factored system, new ones follow.

    Parameters
    ----------
    cholesky : holds the factor of H, which must stay
    size, k : keyframes that H has, numbers of the step of each
    points, rows : so many may come, and none of what is there is moved for it: that takes longer
        than to append

    """

    def __init__(self, cholesky: BlockCholesky, size: int, k: int, points: int = 0,
                 rows: int = 0):
        self._points = Points(cholesky, size, k, points)
        self._k = k
        self._ends = GrowingArray((2,), np.int64)
        self._blocks = GrowingArray((2, k, k))
        self._factor = GrowingArray(room=triangle(rows))
        self._right = GrowingArray()
        # A' lambda at the first points; nothing pulls at those that came since. Empty: not known.
        self._pulled = np.zeros((0, k))

    @property
    def rows(self) -> int:
        """How many rows S has."""
        return len(self._right)

    @property
    def keyframes(self) -> int:
        """How many keyframes there are, old and new."""
        return self._points.keyframes

    @property
    def points(self) -> int:
        """How many of them factors name, or are new."""
        return len(self._points)

    def begin(self, ends: tuple[int, int], blocks: Array, residual: Array, noise: Array) -> None:
        """
        Append a keyframe by the factor that sees it first; see `predict`, `add`.

        Raises
        ------
        LinAlgError : that does not say where it is; nothing is appended.

        """
        own = ends.index(self.keyframes)
        parent = self._points.of(ends[1 - own])
        inverse = np.linalg.inv(blocks[own])
        self._points.hang(parent, -inverse @ blocks[1 - own], -inverse @ residual,
                          inverse * noise @ inverse.T)

    def predict(self, ends: tuple[int, int], blocks: Array, residual: Array) -> Prediction:
        """
        Return what is known of r + J_i x_i + J_j x_j.

        ends : the keyframes i and j, `FIXED` for none; blocks : (2, k, k); residual : r, (k,)
        """
        points = np.array([self._points.of(end) for end in ends])
        rows = np.empty((self._k, self.rows))
        expected = residual.copy()
        covariance = np.empty((self._k, self._k))
        kernels.border.predict(
            self._points.covariance, self._points.mean, self._ends.view(), self._blocks.view(),
            self._factor.view(), self._right.view(), points, blocks, rows, covariance, expected)
        return Prediction(expected, covariance, rows, points, blocks)

    def add(self, predicted: Prediction, noise: Array) -> None:
        """
        Append a factor just predicted; noise : (k,) variances.

        Raises
        ------
        LinAlgError : beyond double precision; nothing is appended.

        """
        pivot = np.linalg.cholesky(predicted.covariance + np.diag(noise))
        before, k = self.rows, self._k
        factor = np.empty(triangle(before + k) - triangle(before))
        end = 0
        for r in range(k):  # row r ends at its diagonal
            begin, end = end, end + before + r + 1
            factor[begin:begin + before] = predicted.rows[r]
            factor[begin + before:end] = pivot[r, :r + 1]
        self._factor.extend(factor)
        self._right.extend(-np.linalg.solve(pivot, predicted.residual))
        self._ends.append(predicted.points)
        self._blocks.append(predicted.blocks)
        self._points.used.update(predicted.points.tolist())
        self._pulled = self._pulled[:0]

    def covariance(self, keyframe: int, other: int, turn: Array) -> Array:
        """
        Return the covariance of the step of a keyframe less that of another, turned, (k, k).

        keyframe, other : `FIXED` for none; turn : (k, k)
        """
        before = self.points
        blocks = np.stack((np.eye(self._k), -turn))
        covariance = self.predict((keyframe, other), blocks, np.zeros(self._k)).covariance
        self.forget_unused(before)
        return covariance

    def forget_unused(self, since: int) -> None:
        """Take back the points that came since there were so many, where no factor kept them."""
        if self.points > since:
            self._points.forget(since)
            self._pulled = self._pulled[:self.points]

    def step(self, keyframes: list[int]) -> Array:
        """Return the steps of some keyframes, (m, k); zero of those that are not here yet."""
        points = np.array([self._points.of(keyframe) if keyframe < self.keyframes else FIXED
                           for keyframe in keyframes])
        return kernels.border.move(
            self._points.covariance, self._points.mean, self._gradient(), points)

    def steps(self) -> Steps:
        """Return the steps of all keyframes as they are now."""
        return Steps(self._points.now(), self._now)

    @property
    def _now(self) -> Rows:
        return Rows(self._ends.view(), self._blocks.view(), self._factor.view(),
                    self._right.view())

    def _gradient(self) -> Array:
        """Return A' lambda at all points, (t, k)."""
        known = self._pulled
        if not len(known):
            self._pulled = self._now.gradient(self.points)
        elif len(known) < self.points:
            self._pulled = np.zeros((self.points, self._k))
            self._pulled[:len(known)] = known
        return self._pulled
