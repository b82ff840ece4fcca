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
a block of H^-1. A new keyframe hangs on the point from which its first factor leads to it, its
parent: x = turn x_parent + mean + noise; so its covariances follow from the parent's.
"""

from dataclasses import dataclass
from itertools import takewhile

import numpy as np

from l1slam_ros.core import kernels
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky

# Stands for a keyframe, or a point, that is held fixed.
FIXED = -1
# The longest columns that are kept of a point, in keyframes: a map of a million has some 3,000.
_LONGEST = 1024


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
        gradient = gradient.copy()
        points, keyframes = self.old
        kernels.growth.pull_parents(self.parent, self.turn, gradient)
        right = np.zeros((self.size, gradient.shape[1]))
        right[keyframes] = gradient[points]
        old = self.cholesky.solve(right.ravel()) if len(points) else right
        moved = np.zeros_like(gradient)
        moved[points] = old.reshape(right.shape)[keyframes]
        kernels.growth.move_children(
            self.parent, self.turn, self.noise, gradient, moved)
        return np.concatenate((old.reshape(right.shape), (self.mean + moved)[self.new]))


class Points:
    """
    The points of a bordered system; they are numbered as they come.

    Parameters
    ----------
    cholesky : holds the factor of H, which must stay
    size, k : old keyframes, and numbers of the step of each
    most : so many points may come without moving those before: that takes longer than to append

    Attributes
    ----------
    used : those that factors name, or that new keyframes hang on: these stay, see `forget`

    """

    def __init__(self, cholesky: BlockCholesky, size: int, k: int, most: int = 0):
        self._cholesky = cholesky
        self._size = size
        self._k = k
        self.used: set[int] = set()
        self._of_old: dict[int, int] = {}
        self._of_new: list[int] = []
        # Where each is in the order of elimination, -1 for a new one.
        self._at = GrowingArray((), np.int64)
        self._covariance = GrowingArray((k, k), room=triangle(most))
        # What covariances with later ones are made of, see `kernels.border`; where it begins.
        self._columns = GrowingArray(room=most * _LONGEST * k * k)
        self._begins = GrowingArray((), np.int64)
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
        point = self._reach(keyframe)
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
        self.used.add(parent)
        self._at.append(FIXED)
        self._begins.append(FIXED)
        self._of_new.append(self._append(product, mean, parent, turn, noise))

    def forget(self, since: int) -> None:
        """
        Take back points of old keyframes that came since there were so many, but for those used.

        Each makes the next one cost more. The last ones leave nothing behind.
        """
        came = takewhile(lambda one: one[1] >= since, reversed(self._of_old.items()))
        for keyframe, point in [one for one in came if one[1] not in self.used]:
            del self._of_old[keyframe]
            self._at.view()[point] = FIXED
            if point == len(self) - 1:
                begin = int(self._begins.view()[point])
                if begin >= 0:
                    self._columns.shorten(begin)
                self._covariance.shorten(triangle(point))
                for array in (self._at, self._begins, self._mean, self._parent, self._turn,
                              self._noise):
                    array.shorten(point)

    def _reach(self, keyframe: int) -> int:
        """Append an old keyframe; return its point."""
        none = np.zeros((1, self._k, self._k))
        position = int(self._cholesky.pattern.position[keyframe])
        self._at.append(position)
        self._begins.append(FIXED)
        product, columns = self._cholesky.covariances(
            self._at.view(), np.append(self._parent.view(), FIXED),
            np.concatenate((self._turn.view(), none)), self._columns.view(), self._begins.view())
        if columns.size <= _LONGEST * self._k * self._k:
            self._begins.view()[-1] = len(self._columns)
            self._columns.extend(columns.ravel())
        return self._append(product, np.zeros(self._k), FIXED, *none, *none)

    def _append(self, product: Array, mean: Array, parent: int, turn: Array,
                noise: Array) -> int:
        """Append a point with its covariances with all, (t + 1, k, k); return it."""
        self._covariance.extend(product)
        self._mean.append(mean)
        self._parent.append(parent)
        self._turn.append(turn)
        self._noise.append(noise)
        return len(self) - 1
