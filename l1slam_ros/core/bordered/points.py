# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The keyframes that a bordered system touches: their means and their covariances with each other.

In: a factored normal matrix H = L L', and the keyframes that factors name. Out: C, the covariance
between all of these *points*, and m, their means.

An old keyframe, one of H, becomes a point when a factor first names it. C between two of them is
a block of H^-1, the product of their *climbs* of the elimination tree, L^-1 e_p, which are zero
but between p and the root. A new keyframe hangs on the point from which its first factor leads to
it, its parent: x = turn x_parent + mean + noise; so its covariances follow from the parent's.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core import kernels
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky

# Stands for a keyframe, or a point, that is held fixed.
FIXED = -1


def triangle(rows: int) -> int:
    """Return how many entries a triangle of so many rows has."""
    return rows * (rows + 1) // 2


@dataclass(frozen=True)
class PointsNow:
    """
    The points at one moment, (t,) of them.

    cholesky, size : see `Points`; old : (2, o) points that are old keyframes, and which; new :
    points that are the new keyframes, in their order; mean (t, k), parent (t,), turn, noise
    (t, k, k) : see above
    """

    cholesky: BlockCholesky
    size: int
    old: Indices
    new: list[int]
    mean: Array
    parent: Indices
    turn: Array
    noise: Array

    def steps(self, gradient: Array) -> Array:
        """Return m + C g of all keyframes, old and new, (n + b, k); gradient : g, (t, k)."""
        gradient, (points, keyframes) = gradient.copy(), self.old
        kernels.border.pull_parents(self.parent, self.turn, gradient)
        right = np.zeros((self.size, gradient.shape[1]))
        right[keyframes] = gradient[points]
        old = self.cholesky.solve(right.ravel()) if len(points) else right
        moved = np.zeros_like(gradient)
        moved[points] = old.reshape(right.shape)[keyframes]
        kernels.border.move_children(self.parent, self.turn, self.noise, gradient, moved)
        return np.concatenate((old.reshape(right.shape), (self.mean + moved)[self.new]))


class Points:
    """
    The points of a bordered system; they are numbered as they come.

    Parameters
    ----------
    cholesky : holds the factor of H, which must stay
    size, k : old keyframes, and numbers of the step of each
    most : so many points may come without moving those before: that takes longer than to append

    """

    def __init__(self, cholesky: BlockCholesky, size: int, k: int, most: int = 0):
        self._cholesky, self._size, self._k = cholesky, size, k
        self._of_old: dict[int, int] = {}
        self._of_new: list[int] = []
        # All climbs one after the other, and where each begins; see `kernels.border`.
        places = min(most, size) * cholesky.pattern.depth
        self._begin = GrowingArray((), np.int64)
        self._begin.extend(np.zeros(1, np.int64))
        self._places = GrowingArray((), np.int32, places)
        self._values = GrowingArray(room=places * k * k)
        self._covariance = GrowingArray((k, k), room=triangle(most))
        self._mean = GrowingArray((k,))
        self._parent = GrowingArray((), np.int64)
        self._turn, self._noise = GrowingArray((k, k)), GrowingArray((k, k))

    def __len__(self) -> int:
        return len(self._parent)

    @property
    def keyframes(self) -> int:
        """How many keyframes there are, old and new."""
        return self._size + len(self._of_new)

    @property
    def covariance(self) -> Array:
        """C, the triangle of its blocks row after row, (t (t + 1) / 2, k, k)."""
        return self._covariance.view()

    @property
    def mean(self) -> Array:
        """m, (t, k)."""
        return self._mean.view()

    def now(self) -> PointsNow:
        """Return the points as they are; those to come change nothing of it."""
        old = np.array([*self._of_old.items()], np.int64).reshape(-1, 2).T[::-1]
        return PointsNow(self._cholesky, self._size, old, self._of_new.copy(), self.mean,
                         self._parent.view(), self._turn.view(), self._noise.view())

    def of(self, keyframe: int) -> int:
        """Return the point that a keyframe is, or becomes; `FIXED` is none."""
        if keyframe >= self._size:
            return self._of_new[keyframe - self._size]
        if keyframe == FIXED or keyframe in self._of_old:
            return self._of_old.get(keyframe, FIXED)
        point = self._climb(keyframe)
        self._of_old[keyframe] = point
        return point

    def hang(self, parent: int, turn: Array, mean: Array, noise: Array) -> None:
        """
        Append a new keyframe, x = turn x_parent + mean + noise.

        parent : a point, `FIXED` for none; turn (k, k); mean (k,); noise : its covariance, (k, k)
        """
        if parent != FIXED:
            mean = mean + turn @ self.mean[parent]
        product = np.empty((len(self) + 1, self._k, self._k))
        kernels.border.follow(self.covariance, parent, turn, noise, product)
        self._of_new.append(self._append(product, mean, parent, turn, noise))

    def forget_last(self) -> None:
        """Take back the last point, an old keyframe: each makes the next one cost more."""
        last, climb = len(self) - 1, int(self._begin.view()[-2])
        self._of_old.popitem()
        ends = ((self._begin, last + 1), (self._places, climb),
                (self._values, climb * self._k**2), (self._covariance, triangle(last)),
                (self._mean, last), (self._parent, last), (self._turn, last), (self._noise, last))
        for array, length in ends:
            array.replace(length, array.view()[:0])

    def _climb(self, keyframe: int) -> int:
        """Append an old keyframe; return its point."""
        places, values = self._cholesky.climb(keyframe)
        self._places.extend(places)
        self._values.extend(values.ravel())
        k = self._k
        product, none = np.empty((len(self) + 1, k, k)), np.zeros((k, k))
        begin = np.append(self._begin.view(), len(self._places))
        kernels.border.meet(begin, self._places.view(), self._values.view(),
                            np.append(self._parent.view(), FIXED), self._turn.view(), product)
        return self._append(product, np.zeros(k), FIXED, none, none)

    def _append(self, product: Array, mean: Array, parent: int, turn: Array,
                noise: Array) -> int:
        """Append a point with its covariances with all, (t + 1, k, k); return it."""
        self._begin.extend(np.array([len(self._places)]))
        self._covariance.extend(product)
        self._mean.extend(mean[None])
        self._parent.extend(np.array([parent]))
        self._turn.extend(turn[None])
        self._noise.extend(noise[None])
        return len(self) - 1
