# SPDX-License-Identifier: Apache-2.0
"""
What has come since a map was factored, as a small dense system on top of it.

In: a factored normal matrix H = L L' of the keyframes there were, then factors and keyframes one
by one. Out: steps of all keyframes, and the exact covariance of any linear function of them.

A keyframe is where the factor says that sees it first: it hangs on that factor's other end, x_j =
T x_i + c and noise. With C the covariance that makes of H^-1, m the mean, A the blocks of all
other factors, W^-1 their noise and r their residuals, the least squares solution is

    x = m + C A' lambda,    (W^-1 + A C A') lambda = -(r + A m),

whose matrix is kept as F F', F lower triangular. A row that is appended costs one substitution,
and its pivot before the noise is added is the covariance of the factor's residual as all others
predict it: who asks before appending has the test of a factor for free.

C is needed between the keyframes that factors touch only. Each of the old ones takes one climb of
the elimination tree, L^-1 e_p, which is zero but between p and the root.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core import kernels
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky

# In the place of a keyframe: one that is held fixed.
FIXED = -1


@dataclass(frozen=True)
class Prediction:
    """
    What the map says of r + J x before the factor tells.

    residual : (k,) to expect; covariance : (k, k) of it, without the factor's own noise; the rest
    is for the border to append the factor.
    """

    residual: Array
    covariance: Array
    rows: Array
    points: Indices
    blocks: Array


@dataclass(frozen=True)
class Steps:
    """
    The steps of all keyframes at one moment.

    cholesky, size : see `Border`; old, new : points that are old keyframes, as many keyframes
    each, (2, t), and points that are the new ones; mean, gradient : of points, (t, k); parent,
    turn, noise : see `kernels.border`.
    """

    cholesky: BlockCholesky
    size: int
    old: Indices
    new: list[int]
    mean: Array
    gradient: Array
    parent: Indices
    turn: Array
    noise: Array

    def all(self) -> Array:
        """Return the steps of all keyframes, (n + b, k)."""
        gradient, (points, keyframes) = self.gradient.copy(), self.old
        kernels.border.pull_parents(self.parent, self.turn, gradient)
        right = np.zeros((self.size, gradient.shape[1]))
        right[keyframes] = gradient[points]
        old = self.cholesky.solve(right.ravel()) if len(points) else right
        moved = np.zeros_like(gradient)
        moved[points] = old.reshape(right.shape)[keyframes]
        kernels.border.move_children(self.parent, self.turn, self.noise, gradient, moved)
        return np.concatenate((old.reshape(right.shape), (self.mean + moved)[self.new]))


class Border:
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
        self._cholesky, self._size, self._k = cholesky, size, k
        places = min(points, size) * cholesky.pattern.depth
        # Points: which old keyframes they are, and which the new ones are; climbs, covariance.
        self._touched: dict[int, int] = {}
        self._new: list[int] = []
        self._begin = GrowingArray((), np.int64)
        self._begin.extend(np.zeros(1, np.int64))
        self._places = GrowingArray((), np.int32, places)
        self._values = GrowingArray(room=places * k * k)
        self._covariance = GrowingArray((k, k), room=_triangle(points))
        self._mean = GrowingArray((k,))
        self._parent = GrowingArray((), np.int64)
        self._turn, self._noise = GrowingArray((k, k)), GrowingArray((k, k))
        # The other factors: their points and blocks, F, F^-1 times the right hand side.
        self._ends, self._blocks = GrowingArray((2,), np.int64), GrowingArray((2, k, k))
        self._factor, self._right = GrowingArray(room=_triangle(rows)), GrowingArray()
        # A' lambda at the first points; nothing pulls at those that came since. Empty: not known.
        self._pulled = np.zeros((0, k))

    @property
    def rows(self) -> int:
        """How many rows the dense system has."""
        return len(self._right)

    @property
    def keyframes(self) -> int:
        """How many keyframes there are, old and new."""
        return self._size + len(self._new)

    @property
    def points(self) -> int:
        """How many of them were asked for, or are new."""
        return len(self._parent)

    def begin(self, ends: tuple[int, int], blocks: Array, residual: Array, noise: Array) -> None:
        """
        Append a keyframe by the factor that sees it first; see `predict`, `add`.

        Raises
        ------
        LinAlgError : that does not say where it is; nothing is appended.

        """
        own = ends.index(self.keyframes)
        parent, inverse = self._point(ends[1 - own]), np.linalg.inv(blocks[own])
        turn, mean = -inverse @ blocks[1 - own], -inverse @ residual
        if parent != FIXED:
            mean += turn @ self._mean.view()[parent]
        spread = inverse * noise @ inverse.T
        product = np.empty((self.points + 1, self._k, self._k))
        kernels.border.follow(self._covariance.view(), parent, turn, spread, product)
        self._new.append(self._append(product, mean, parent, turn, spread))

    def predict(self, ends: tuple[int, int], blocks: Array, residual: Array) -> Prediction:
        """
        Return what is known of r + J_i x_i + J_j x_j.

        ends : the keyframes i and j, `FIXED` for none; blocks : (2, k, k); residual : r, (k,)
        """
        points = np.array([self._point(end) for end in ends])
        rows, expected = np.empty((self._k, self.rows)), residual.copy()
        covariance = np.empty((self._k, self._k))
        kernels.border.predict(
            self._covariance.view(), self._mean.view(), self._ends.view(), self._blocks.view(),
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
        lines = np.concatenate((predicted.rows, pivot), axis=1)
        # Row r ends at its diagonal.
        k, columns = lines.shape
        self._factor.extend(lines[np.tri(k, columns, columns - k, dtype=bool)])
        self._right.extend(-np.linalg.solve(pivot, predicted.residual))
        self._ends.extend(predicted.points[None])
        self._blocks.extend(predicted.blocks[None])
        self._pulled = self._pulled[:0]

    def covariance(self, keyframe: int) -> Array:
        """Return the covariance of the step of a keyframe, `FIXED` for none, (k, k)."""
        of_points = (self._begin, self._places, self._values, self._covariance, self._mean,
                     self._parent, self._turn, self._noise)
        before, sizes = self.points, [len(array) for array in of_points]
        blocks = np.stack((np.eye(self._k), np.zeros((self._k, self._k))))
        covariance = self.predict((keyframe, FIXED), blocks, np.zeros(self._k)).covariance
        if self.points > before:
            # No factor touches it: each point makes the next one cost more.
            del self._touched[keyframe]
            for array, size in zip(of_points, sizes, strict=True):
                array.replace(size, array.view()[:0])
        return covariance

    def step(self, keyframes: list[int]) -> Array:
        """Return the steps of some keyframes, (m, k); zero of those that are not here yet."""
        points = np.array([self._point(keyframe) if keyframe < self.keyframes else FIXED
                           for keyframe in keyframes])
        return kernels.border.move(
            self._covariance.view(), self._mean.view(), self._gradient(), points)

    def steps(self) -> Steps:
        """Return the steps of all keyframes as they are now."""
        old = np.array([*self._touched.items()], np.int64).reshape(-1, 2).T[::-1]
        return Steps(self._cholesky, self._size, old, self._new.copy(), self._mean.view(),
                     self._gradient(), self._parent.view(), self._turn.view(),
                     self._noise.view())

    def _point(self, keyframe: int) -> int:
        """Return the point that a keyframe is; `FIXED` is none."""
        if keyframe >= self._size:
            return self._new[keyframe - self._size]
        if keyframe == FIXED or keyframe in self._touched:
            return self._touched.get(keyframe, FIXED)
        return self._touch(keyframe)

    def _touch(self, keyframe: int) -> int:
        places, values = self._cholesky.climb(keyframe)
        self._places.extend(places)
        self._values.extend(values.ravel())
        t, k = self.points, self._k
        product, none = np.empty((t + 1, k, k)), np.zeros((k, k))
        begin = np.append(self._begin.view(), len(self._places))
        kernels.border.meet(begin, self._places.view(), self._values.view(),
                            np.append(self._parent.view(), FIXED), self._turn.view(), product)
        self._touched[keyframe] = self._append(product, np.zeros(k), FIXED, none, none)
        return t

    def _append(self, product: Array, mean: Array, parent: int, turn: Array,
                noise: Array) -> int:
        """Append a point; return it."""
        self._begin.extend(np.array([len(self._places)]))
        self._covariance.extend(product)
        self._mean.extend(mean[None])
        self._parent.extend(np.array([parent]))
        self._turn.extend(turn[None])
        self._noise.extend(noise[None])
        return self.points - 1

    def _gradient(self) -> Array:
        """Return A' lambda at all points, (t, k)."""
        known = len(self._pulled)
        if known < self.points:
            before, self._pulled = self._pulled, np.zeros((self.points, self._k))
            self._pulled[:known] = before
            if not known:
                kernels.border.pull(self._factor.view(), self._right.view(), self._ends.view(),
                                    self._blocks.view(), self._pulled)
        return self._pulled


def _triangle(rows: int) -> int:
    """Return how many entries a triangle of so many rows has."""
    return rows * (rows + 1) // 2
