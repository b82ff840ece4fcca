# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The pose factor graph: which keyframes exist and what was measured, never where they are.

Factors are stored as arrays per kind and are only ever appended, so the row of a factor in the
linear system never moves, a warm start is a pad with zeros, and what an earlier call returned
stays valid while the graph grows. Poses live outside, in (n, p) arrays.
"""

from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import Mask, square_root_information
from l1slam_ros.core.graph.growable_array import GrowingArray

# The first end of an absolute factor: the map frame, a keyframe that never moves. As an index into
# poses with the identity behind them it picks that; see `linear_system.with_world`.
WORLD = -1
# In the place of a predecessor: the keyframe is the first of a part.
NO_PREDECESSOR = -1
# In the place of a robot's number: the pose is of a landmark.
LANDMARK = int(np.iinfo(np.int64).min)


@dataclass(frozen=True)
class BetweenFactors:
    """
    Measurements of the pose of keyframe j seen from keyframe i, or from the world.

    i, j : (m,) keyframe indices, i may be `WORLD`: an absolute factor; measurement : (m, p)
    relative poses; sqrt_information : (m, d, d) upper triangular roots, see `noise`, a zero row
    says nothing; trusted, struck : (m,) bool, a person or a marker vouches for it, or a person has
    struck it out; predecessor : (n,) of the keyframes, see `FactorGraph`; has_marks : some may be
    trusted or struck.
    """

    i: Indices
    j: Indices
    measurement: Array
    sqrt_information: Array
    trusted: Mask
    struck: Mask
    predecessor: Indices
    has_marks: bool = True

    def __len__(self) -> int:
        return len(self.i)

    @property
    def pairs(self) -> Indices:
        """The keyframes i and j of each, (m, 2); of an absolute one its only keyframe twice."""
        return np.stack((np.where(self.is_absolute, self.j, self.i), self.j), axis=1)

    @property
    def is_absolute(self) -> Mask:
        """(m,) bool: those that the world is an end of."""
        return np.asarray(self.i == WORLD)

    @cached_property
    def step_to(self) -> Indices:
        """(n,) the first factor between each keyframe and its predecessor, -1: there is none."""
        before = np.append(self.predecessor, NO_PREDECESSOR)  # the last one is the world's
        forward, backward = before[self.j] == self.i, before[self.i] == self.j
        steps = np.flatnonzero((forward | backward) & ~self.is_absolute)
        keyframe, first = np.unique(np.where(forward, self.j, self.i)[steps], return_index=True)
        row = np.full(len(self.predecessor), -1)
        row[keyframe] = steps[first]
        return row

    @cached_property
    def is_odometry(self) -> Mask:
        """(m,) bool: the first factor between each keyframe and its predecessor, see `step_to`."""
        mask = np.zeros(len(self), bool)
        mask[self.step_to[self.step_to >= 0]] = True
        return mask

    @cached_property
    def speaks(self) -> Mask:
        """(m, d) bool: which rows of the residual say something."""
        return np.asarray(np.diagonal(self.sqrt_information, axis1=1, axis2=2) != 0)

    @cached_property
    def freedom(self) -> Indices:
        """How many rows of each say something, (m,): its degrees of freedom."""
        return np.asarray(np.count_nonzero(self.speaks, axis=1))


class FactorGraph:
    """
    An append-only pose graph on one manifold.

    A keyframe has a robot, and a predecessor: the keyframe from which the odometry of that robot
    leads to it, which was there before it; or none. Nothing else is said by its index: keyframes
    of several robots come in any order. A landmark is a pose where no robot was, see `landmarks`.

    Parameters
    ----------
    manifold : the module the poses live on, e.g. `se2`
    n_poses : how many keyframes exist already, each the predecessor of the next

    """

    def __init__(self, manifold: Manifold, n_poses: int = 0):
        self.manifold = manifold
        p, d = manifold.POSE_SIZE, manifold.TANGENT_SIZE
        self._predecessor, self._robot = GrowingArray((), np.int64), GrowingArray((), np.int64)
        self._last: dict[int, int] = {}  # by robot
        self._between = [GrowingArray((), np.int64), GrowingArray((), np.int64),
                         GrowingArray((p,)), GrowingArray((d, d)), GrowingArray((), np.bool_),
                         GrowingArray((), np.bool_)]
        self._factors: BetweenFactors | None = None
        self._has_marks = False  # of some factor: trusted, or struck
        if n_poses:
            self.add_poses(n_poses)

    def __getstate__(self) -> dict[str, Any]:
        """Return all, the manifold by its name: modules are not pickled, nor deeply copied."""
        return {**vars(self), 'manifold': vars(self.manifold)['__name__']}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, manifold=import_module(state['manifold']))

    @property
    def n_poses(self) -> int:
        """How many keyframes exist."""
        return len(self._predecessor)

    @property
    def predecessor(self) -> Indices:
        """The keyframe before each one, (n,), `NO_PREDECESSOR`: there is none."""
        return self._predecessor.view()

    @property
    def firsts(self) -> Indices:
        """The keyframes that have no predecessor, but for the first one of all, (g,)."""
        return np.flatnonzero(self.predecessor[1:] == NO_PREDECESSOR) + 1

    @property
    def parent(self) -> Indices:
        """The predecessor of each keyframe, (n,); where there is none, the keyframe itself."""
        before = self.predecessor
        return np.where(before == NO_PREDECESSOR, np.arange(len(before)), before)

    @property
    def robot(self) -> Indices:
        """The number of the robot of each keyframe, (n,)."""
        return self._robot.view()

    @property
    def is_landmark(self) -> Mask:
        """(n,) bool: the poses of landmarks."""
        return np.asarray(self.robot == LANDMARK)

    def copy(self) -> 'FactorGraph':
        """Return a graph that shares all factors so far; either may grow without the other."""
        clone = self.without_factors()
        clone._between = [column.copy() for column in self._between]
        clone._factors = self._factors
        clone._has_marks = self._has_marks
        return clone

    def without_factors(self) -> 'FactorGraph':
        """Return a graph of the same keyframes, of which nothing is measured."""
        clone = FactorGraph(self.manifold)
        clone._predecessor, clone._robot = self._predecessor.copy(), self._robot.copy()
        clone._last = self._last.copy()
        return clone

    @property
    def not_struck(self) -> Indices:
        """The between factors that no person struck out, rows."""
        return np.flatnonzero(~self._between[-1].view())

    def without_struck(self) -> 'FactorGraph':
        """Return the graph without what a person struck out, itself where there is nothing."""
        return self.subset(self.not_struck) if self.between.struck.any() else self

    def subset(self, chosen: Indices | Mask, variance: Array | None = None) -> 'FactorGraph':
        """
        Return a graph of all keyframes and some of the factors.

        Parameters
        ----------
        chosen : rows (k,), or (m,) bool
        variance : (k,), or (k, d) of whitened numbers, to multiply covariances by; none: ones

        """
        part = self.without_factors()
        i, j, measurement, root, trusted, struck = (
            column.view()[chosen] for column in self._between)
        if variance is not None:
            root = root / np.sqrt(np.atleast_2d(variance.T).T)[:, :, None]
        part.append_between(i, j, measurement, root, trusted, struck)
        return part

    @property
    def between(self) -> BetweenFactors:
        """All factors so far: a snapshot that later appends do not change."""
        if self._factors is None:
            i, j, measurement, root, trusted, struck = (
                column.view() for column in self._between)
            self._factors = BetweenFactors(
                i, j, measurement, root, trusted, struck, self.predecessor, self._has_marks)
        return self._factors

    def add_poses(self, count: int = 1, robot: int = 0, begins_part: bool = False) -> None:
        """
        Let `count` more keyframes of a robot exist; the next index is `n_poses` before the call.

        Each follows the one before it; the first of them the robot's last one, unless it begins a
        part: then it has no predecessor.
        """
        first = self.n_poses
        before = np.arange(first - 1, first + count - 1)
        before[:1] = NO_PREDECESSOR if begins_part else self._last.get(robot, NO_PREDECESSOR)
        self._predecessor.extend(before)
        self._robot.extend(np.full(count, robot))
        self._last[robot] = self.n_poses - 1
        self._factors = None

    def append_step(self, measurement: Array, sqrt_information: Array, robot: int = 0) -> None:
        """Append a keyframe and the factor to it from the robot's last: (1, p), (1, d, d)."""
        before, keyframe = self._last.get(robot, NO_PREDECESSOR), self.n_poses
        self._predecessor.append(before)
        self._robot.append(robot)
        self._last[robot] = keyframe
        values = before, keyframe, measurement[0], sqrt_information[0], False, False
        for column, value in zip(self._between, values, strict=True):
            column.append(value)
        self._factors = None

    def follow(self, keyframes: Indices, predecessors: Indices | int,
               robot: Indices | None = None) -> None:
        """Let some keyframes (k,) have other predecessors, all be of these robots, (n,)."""
        before = self.predecessor.copy()  # what was seen before stays
        before[keyframes] = predecessors
        self._predecessor = GrowingArray((), np.int64)
        self._predecessor.extend(before)
        if robot is not None:
            self._robot = GrowingArray((), np.int64)
            self._robot.extend(robot)
            self._last = {one: k for k, one in enumerate(robot.tolist())}
        self._factors = None

    def add_between(self, i: Indices, j: Indices, measurement: Array, information: Array,
                    trusted: Mask | bool = False) -> None:
        """
        Append between factors: i, j (m,), measurement (m, p), information (m, d, d), trusted (m,).

        Where i is `WORLD` the measurement is the pose of keyframe j in the map frame. Components
        without any information, whole rows and columns of zeros, say nothing. Nothing is appended
        when anything is wrong.

        Raises
        ------
        GraphError : an index without a keyframe, a self loop, a measurement that is not finite.
        NoiseError : an information matrix that is not positive definite where it says something,
            or that says nothing at all.

        """
        i, j = np.atleast_1d(i), np.atleast_1d(j)
        m, p, d = len(i), self.manifold.POSE_SIZE, self.manifold.TANGENT_SIZE
        found = [np.shape(a) for a in (i, j, measurement, information)]
        expected = [(m,), (m,), (m, p), (m, d, d)]
        if found != expected:
            raise GraphError(f'indices, measurements and information have the shapes {found}, '
                             f'expected {expected}')
        if (i == j).any():
            raise GraphError(f'keyframe {i[np.argmax(i == j)]} has a factor to itself')
        ends = np.concatenate((i[i != WORLD], j))
        unknown = (ends < 0) | (ends >= self.n_poses)
        if unknown.any():
            raise GraphError(f'a factor names keyframe {ends[np.argmax(unknown)]}, '
                             f'the graph has 0 to {self.n_poses - 1}')
        if not np.isfinite(measurement).all():
            row = int(np.argmin(np.isfinite(measurement).all(axis=1)))
            raise GraphError(f'measurement {row} is not finite: {measurement[row]}')
        self.append_between(i, j, measurement, square_root_information(information), trusted)

    def append_between(self, i: Indices, j: Indices, measurement: Array, sqrt_information: Array,
                       trusted: Mask | bool = False, struck: Mask | bool = False) -> None:
        """Append between factors that are known to be sound, with the roots (m, d, d) at hand."""
        none = np.zeros(len(i), bool)
        trusted, struck = none | trusted, none | struck
        self._has_marks = self._has_marks or bool(trusted.any() or struck.any())
        values = i, j, measurement, sqrt_information, trusted, struck
        for column, value in zip(self._between, values, strict=True):
            column.extend(value)
        self._factors = None

    def say(self, rows: Indices, trusted: bool) -> None:
        """Let some between factors be vouched for, or else struck out; the last word counts."""
        self._has_marks = True
        for column, value in ((-2, trusted), (-1, not trusted)):
            said = self._between[column].view().copy()
            said[rows] = value
            # What was seen of the column before stays as it was.
            self._between[column] = GrowingArray((), np.bool_)
            self._between[column].extend(said)
        self._factors = None


def component_labels(graph: FactorGraph) -> Indices:
    """
    Return a component number for each keyframe, (n,), in the order of their first keyframes.

    The world is a vertex: keyframes that only absolute factors tie together are of one component.
    """
    return np.unique(lowest_joined(graph)[:-1], return_inverse=True)[1]


def lowest_joined(graph: FactorGraph) -> Indices:
    """Return the first keyframe of the component of each keyframe, and of the world, (n + 1,)."""
    return lowest_of_components(graph.between.i, graph.between.j, graph.n_poses + 1)


def lowest_of_components(i: Indices, j: Indices, n: int) -> Indices:
    """
    Return the lowest vertex of the component of each of n vertices, joined by edges (i, j), (n,).

    Every vertex points to a lower one of its component, or to itself; edges pull what both ends
    point to down to the lower one, and pointers are doubled, until nothing moves.
    """
    lowest = np.arange(n)
    while True:
        a, b = lowest[i], lowest[j]
        apart = a != b
        if not apart.any():
            return lowest
        i, j, a, b = i[apart], j[apart], a[apart], b[apart]
        np.minimum.at(lowest, np.maximum(a, b), np.minimum(a, b))
        while (lowest[lowest] != lowest).any():
            lowest = lowest[lowest]


def ends_in_time(graph: FactorGraph) -> tuple[Indices, Indices, Array]:
    """
    Return of all between factors the earlier and later keyframe (m,), and that from this.

    The world is earlier than any keyframe, and `WORLD` here, too.
    """
    i, j, Z = graph.between.i, graph.between.j, graph.between.measurement
    forward = np.where((i > j)[:, None], graph.manifold.inverse(Z), Z)
    return np.minimum(i, j), np.maximum(i, j), forward


def turned(graph: FactorGraph, rows: Indices | Mask) -> FactorGraph:
    """
    Return the graph with some factors, rows (k,) or (m,) bool, seen from the other end.

    Z becomes Z^-1, its covariance Ad_Z C Ad_Z': to first order in the residual the same is said.
    Turned twice it is the same to rounding.
    """
    factors, manifold = graph.between, graph.manifold
    i, j, Z = factors.i.copy(), factors.j.copy(), factors.measurement.copy()
    i[rows], j[rows], Z[rows] = factors.j[rows], factors.i[rows], manifold.inverse(Z[rows])
    roots = factors.sqrt_information.copy()
    # Of the root, without squaring it: far ends make covariances that no Cholesky bears.
    upper = np.linalg.qr(roots[rows] @ manifold.adjoint(Z[rows]), mode='r')
    signs = np.where(np.diagonal(upper, axis1=1, axis2=2) < 0, -1.0, 1.0)
    roots[rows] = signs[:, :, None] * upper
    other = graph.without_factors()
    other.append_between(i, j, Z, roots, factors.trusted, factors.struck)
    return other
