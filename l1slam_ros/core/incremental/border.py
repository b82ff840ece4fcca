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
_FIRST_ROWS = 128
_FIRST_TOUCHED = 32


@dataclass(frozen=True)
class Prediction:
    """
    What the map says of J x before a factor tells.

    covariance : (k, k) of it; the rest is for the border to append the factor.
    """

    covariance: Array
    rows: Array
    ends: Indices
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
        self._covariance = np.empty((_FIRST_TOUCHED, _FIRST_TOUCHED, k, k))
        # The border: its rows of blocks, its factor, F^-1 times the right hand side.
        self._ends, self._blocks = GrowingArray((2,), np.int64), GrowingArray((2, k, k))
        self._factor = np.zeros((_FIRST_ROWS, _FIRST_ROWS))
        self._signs, self._right = GrowingArray(), GrowingArray()
        self._home: list[int] = []
        self._solution: Array | None = None

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

    def predict(self, ends: tuple[int, int], blocks: Array) -> Prediction:
        """
        Return what is known of J_i x_i + J_j x_j.

        ends : the keyframes i and j, `FIXED` for none, one past the last: not in the border yet,
        left out; blocks : (2, k, k)
        """
        from l1slam_ros.core.kernels import border

        own = np.array([self._name(end) for end in ends])
        rows = np.empty((self._k, self.rows))
        border.couple(self._covariance, self._ends.view(), self._blocks.view(), own, blocks, rows)
        border.reduce(self._factor, rows, 0)
        covariance = (rows * self._signs.view()) @ rows.T
        for side, other in ((0, 0), (0, 1), (1, 0), (1, 1)):
            if min(own[side], own[other]) >= 0:
                between = self._covariance[own[side], own[other]]
                covariance += blocks[side] @ between @ blocks[other].T
        return Prediction((covariance + covariance.T) / 2, rows, own, blocks)

    def add_factor(self, predicted: Prediction, noise: Array, residual: Array) -> None:
        """Append a factor just predicted: noise (k,) variances, residual (k,) at no step."""
        pivot = predicted.covariance + np.diag(noise)
        kept = np.where(predicted.ends >= 0, predicted.ends, FIXED)
        self._append(predicted.rows, pivot, -1.0, -residual, kept, predicted.blocks)

    def add_keyframe(self, block: Array) -> None:
        """Append a keyframe that the last factor was the first to see, by its block (k, k)."""
        from l1slam_ros.core.kernels import border

        rows = np.zeros((self._k, self.rows))
        rows[:, -self._k:] = block.T
        border.reduce(self._factor, rows, self.rows - self._k)
        self._home.append(len(self._ends))
        self._append(rows, rows @ rows.T, 1.0, np.zeros(self._k), np.full(2, FIXED),
                     np.zeros((2, self._k, self._k)))

    def step(self, keyframe: int) -> Array:
        """Return the step of a keyframe, (k,)."""
        name, z = self._name(keyframe), self._solved()
        if name < -1:
            own: Array = z[-2 - name]
            return own
        if name == FIXED or not len(z):
            return np.zeros(self._k)
        pulled = self._covariance[name, :len(self._touched)] @ self._gradient()[:, :, None]
        step: Array = -pulled.sum(axis=0)[:, 0]
        return step

    def steps(self) -> Steps:
        """Return the steps of all keyframes as they are now."""
        return Steps(self._cholesky, self._size, np.fromiter(self._touched, np.int64),
                     self._gradient(), self._solved()[self._home])

    def _name(self, keyframe: int) -> int:
        """Return what a keyframe is called in `ends`, see `kernels.border.couple`."""
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
        if t == len(self._covariance):
            grown = np.empty((2 * t, 2 * t, self._k, self._k))
            grown[:t, :t] = self._covariance
            self._covariance = grown
        product = np.empty((t + 1, self._k, self._k))
        border.meet(self._begin.view(), self._places.view(), self._values.view(), self._k, product)
        self._covariance[:t + 1, t] = product
        self._covariance[t, :t] = product[:t].transpose(0, 2, 1)
        return t

    def _append(self, rows: Array, pivot: Array, sign: float, right: Array, ends: Indices,
                blocks: Array) -> None:
        """Append a row of blocks: reduced rows (k, n), its pivot (k, k) without its sign."""
        n, k = self.rows, self._k
        if n + k > len(self._factor):
            grown = np.zeros((2 * len(self._factor),) * 2)
            grown[:n, :n] = self._factor[:n, :n]
            self._factor = grown
        root = np.linalg.cholesky(pivot)
        left = rows * self._signs.view()
        self._factor[n:n + k, :n] = left
        self._factor[n:n + k, n:n + k] = root
        self._right.extend(np.linalg.solve(root, right - left @ self._right.view()))
        self._signs.extend(np.full(k, sign))
        self._ends.extend(ends[None])
        self._blocks.extend(blocks[None])
        self._solution = None

    def _solved(self) -> Array:
        """Return multipliers and steps, in the order of the rows of blocks, (b, k)."""
        from l1slam_ros.core.kernels import border

        if self._solution is None:
            x = self._signs.view() * self._right.view()
            border.back_substitute(self._factor, x)
            self._solution = x.reshape(-1, self._k)
        return self._solution

    def _gradient(self) -> Array:
        """Return A' lambda at the keyframes that are touched, (t, k)."""
        ends, blocks, z = self._ends.view(), self._blocks.view(), self._solved()
        gradient = np.zeros((len(self._touched), self._k))
        for side in (0, 1):
            at = np.flatnonzero(ends[:, side] >= 0)
            np.add.at(gradient, ends[at, side], np.einsum('brc,br->bc', blocks[at, side], z[at]))
        return gradient
