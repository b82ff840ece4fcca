# SPDX-License-Identifier: Apache-2.0
"""
What has come since a map was factored, as a small dense system on top of it.

In: a factored normal matrix H = L L' of the keyframes there were, then factors and keyframes one
by one. Out: steps of all keyframes, and the exact covariance of any linear function of them. With
one multiplier for each row of a new factor, A its block of the old keyframes, B of the new ones,
W^-1 its noise and r its residual, the least squares solution is that of

    [-(W^-1 + A H^-1 A')   B ] [lambda]   [-r]
    [         B'           0 ] [  x   ] = [ 0],      old keyframes: -H^-1 A' lambda,

whose matrix is kept as F S F', F lower triangular and S signs. A row that is appended costs one
substitution, and its pivot before the noise is added is minus the covariance of the factor's
residual as all others predict it: who asks before appending has the test of a factor for free.

H^-1 is needed between the keyframes that new factors touch only. Each takes one climb of the
elimination tree, L^-1 e_p, which is zero but between p and the root.
"""

from dataclasses import dataclass

import numpy as np

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
    at_no_step: Array
    rows: Array
    ends: tuple[int, int]
    names: Indices
    blocks: Array


@dataclass(frozen=True)
class Steps:
    """
    The steps of all keyframes at one moment.

    cholesky, size : see `Border`; touched (t,), gradient (t, k) : what pulls at which of the old
    keyframes; new : the steps of the border's, (b, k).
    """

    cholesky: BlockCholesky
    size: int
    touched: Indices
    gradient: Array
    new: Array

    def all(self) -> Array:
        """Return the steps of all keyframes, (n + b, k)."""
        right = np.zeros((self.size, self.new.shape[1]))
        right[self.touched] = -self.gradient
        old = self.cholesky.solve(right.ravel()) if len(self.touched) else right
        return np.concatenate((old.reshape(right.shape), self.new))


class Border:
    """
    The system of one weighting; keyframes are those of the factored system, new ones follow.

    Parameters
    ----------
    cholesky : holds the factor of H, which must stay
    size, k : keyframes that H has, numbers of the step of each

    """

    def __init__(self, cholesky: BlockCholesky, size: int, k: int):
        self._cholesky, self._size, self._k = cholesky, size, k
        # Climbs, and the blocks of H^-1 between the keyframes they began at.
        self._touched: dict[int, int] = {}
        self._begin = GrowingArray((), np.int64)
        self._begin.extend(np.zeros(1, np.int64))
        self._places, self._values = GrowingArray((), np.int32), GrowingArray()
        self._covariance = GrowingArray((k, k))
        # The border: its rows of blocks, its factor, F^-1 times the right hand side.
        self._ends, self._blocks = GrowingArray((2,), np.int64), GrowingArray((2, k, k))
        self._factor, self._signs, self._right = GrowingArray(), GrowingArray(), GrowingArray()
        self._home: list[int] = []
        # Multipliers and steps from some row on, and A' lambda; None: not known.
        self._solution: tuple[int, Array] | None = None
        self._pulled: Array | None = None

    @property
    def rows(self) -> int:
        """How many rows the dense system has."""
        return len(self._right)

    @property
    def keyframes(self) -> int:
        """How many keyframes there are, old and new."""
        return self._size + len(self._home)

    @property
    def touched(self) -> int:
        """How many of the old ones were asked for."""
        return len(self._touched)

    def predict(self, ends: tuple[int, int], blocks: Array, residual: Array) -> Prediction:
        """
        Return what is known of r + J_i x_i + J_j x_j.

        ends : the keyframes i and j, `FIXED` for none, one past the last: not in the border yet,
        left out; blocks : (2, k, k); residual : r, (k,)
        """
        from l1slam_ros.core.kernels import border

        names, rows = np.array([self._name(end) for end in ends]), np.empty((self._k, self.rows))
        covariance, expected = np.zeros((self._k, self._k)), residual.copy()
        border.predict(
            self._covariance.view(), self._ends.view(), self._blocks.view(), self._factor.view(),
            self._signs.view(), self._right.view(), names, blocks, rows, covariance, expected)
        return Prediction(expected, covariance, residual, rows, ends, names, blocks)

    def add(self, predicted: Prediction, noise: Array) -> None:
        """
        Append a factor just predicted, and the keyframe that it is the first to see, if it is.

        noise : (k,) variances

        Raises
        ------
        LinAlgError : beyond double precision; nothing is appended.

        """
        from l1slam_ros.core.kernels import border

        n, k, unseen = self.rows, self._k, self.keyframes
        seen = predicted.blocks[predicted.ends.index(unseen)] if unseen in predicted.ends else (
            np.empty((0, 0)))
        added = k + len(seen)
        lines, right = np.empty(added * n + added * (added + 1) // 2), np.empty(added)
        if not border.append(self._signs.view(), self._right.view(), predicted.rows,
                             predicted.covariance + np.diag(noise), predicted.at_no_step, seen,
                             lines, right):
            raise np.linalg.LinAlgError
        self._factor.extend(lines)
        self._right.extend(right)
        self._append(-1.0, np.maximum(predicted.names, FIXED), predicted.blocks)
        if len(seen):
            self._home.append(len(self._ends))
            self._append(1.0, np.full(2, FIXED), np.zeros((2, k, k)))
        self._solution = self._pulled = None

    def step(self, keyframe: int) -> Array:
        """Return the step of a keyframe, (k,)."""
        from l1slam_ros.core.kernels import border

        name, k = self._name(keyframe), self._k
        if name < -1:
            begin = (-2 - name) * k
            own: Array = self._solved(begin)[:k]
            return own
        if name == FIXED or not self.rows:
            return np.zeros(k)
        step: Array = border.move(self._covariance.view(), self._gradient(), name)
        return step

    def steps(self) -> Steps:
        """Return the steps of all keyframes as they are now."""
        solved = self._solved(0).reshape(-1, self._k)
        return Steps(self._cholesky, self._size, np.fromiter(self._touched, np.int64),
                     self._gradient(), solved[self._home])

    def _name(self, keyframe: int) -> int:
        """Return what a keyframe is called by `kernels.border.predict`."""
        if keyframe == FIXED:
            return FIXED
        new = keyframe - self._size
        if new >= 0:
            return -2 - self._home[new] if new < len(self._home) else FIXED
        return self._touched[keyframe] if keyframe in self._touched else self._touch(keyframe)

    def _touch(self, keyframe: int) -> int:
        from l1slam_ros.core.kernels import border

        places, values = self._cholesky.climb(keyframe)
        self._places.extend(places)
        self._values.extend(values.ravel())
        self._begin.extend(np.array([len(self._places)]))
        t = self._touched[keyframe] = len(self._touched)
        product = np.empty((t + 1, self._k, self._k))
        border.meet(self._begin.view(), self._places.view(), self._values.view(), product)
        self._covariance.extend(product)
        return t

    def _append(self, sign: float, names: Indices, blocks: Array) -> None:
        self._signs.extend(np.full(self._k, sign))
        self._ends.extend(names[None])
        self._blocks.extend(blocks[None])

    def _solved(self, begin: int) -> Array:
        """Return multipliers and steps from some row on."""
        from l1slam_ros.core.kernels import border

        if self._solution is None or self._solution[0] > begin:
            x = self._signs.view() * self._right.view()
            border.back_substitute(self._factor.view(), x, begin)
            self._solution = begin, x
        return self._solution[1][begin:]

    def _gradient(self) -> Array:
        """Return A' lambda at the keyframes that are touched, (t, k)."""
        from l1slam_ros.core.kernels import border

        if self._pulled is None or len(self._pulled) < len(self._touched):
            self._pulled = np.zeros((len(self._touched), self._k))
            border.pull(self._ends.view(), self._blocks.view(),
                        self._solved(0).reshape(-1, self._k), self._pulled)
        return self._pulled
