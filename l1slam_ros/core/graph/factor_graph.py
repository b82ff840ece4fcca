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


@dataclass(frozen=True)
class BetweenFactors:
    """
    Measurements of the pose of keyframe j seen from keyframe i, or from the world.

    i, j : (m,) keyframe indices, i may be `WORLD`: an absolute factor; measurement : (m, p)
    relative poses; sqrt_information : (m, d, d) upper triangular roots, see `noise`, a zero row
    says nothing; trusted, struck : (m,) bool, a person or a marker vouches for it, or a person has
    struck it out.
    """

    i: Indices
    j: Indices
    measurement: Array
    sqrt_information: Array
    trusted: Mask
    struck: Mask

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
    def is_odometry(self) -> Mask:
        """(m,) bool: the first factor between each two consecutive keyframes, either way round."""
        consecutive = np.flatnonzero((np.abs(self.i - self.j) == 1) & ~self.is_absolute)
        _, first = np.unique(np.minimum(self.i, self.j)[consecutive], return_index=True)
        mask = np.zeros(len(self), bool)
        mask[consecutive[first]] = True
        return mask

    @cached_property
    def speaks(self) -> Mask:
        """(m, d) bool: which rows of the residual say something."""
        return np.asarray(np.diagonal(self.sqrt_information, axis1=1, axis2=2) != 0)

    @property
    def freedom(self) -> Indices:
        """How many rows of each say something, (m,): its degrees of freedom."""
        return np.asarray(np.count_nonzero(self.speaks, axis=1))


class FactorGraph:
    """
    An append-only pose graph on one manifold.

    Parameters
    ----------
    manifold : the module the poses live on, e.g. `se2`
    n_poses : how many keyframes exist already

    Attributes
    ----------
    n_poses : how many keyframes exist
    said : how often a person changed what counts, see `say`

    """

    def __init__(self, manifold: Manifold, n_poses: int = 0):
        self.manifold, self.n_poses, self.said = manifold, n_poses, 0
        p, d = manifold.POSE_SIZE, manifold.TANGENT_SIZE
        self._between = [GrowingArray((), np.int64), GrowingArray((), np.int64),
                         GrowingArray((p,)), GrowingArray((d, d)), GrowingArray((), np.bool_),
                         GrowingArray((), np.bool_)]
        self._factors: BetweenFactors | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return all, the manifold by its name: modules are not pickled, nor deeply copied."""
        return {**vars(self), 'manifold': vars(self.manifold)['__name__']}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, manifold=import_module(state['manifold']))

    def copy(self) -> 'FactorGraph':
        """Return a graph that shares all factors so far; either may grow without the other."""
        clone = FactorGraph(self.manifold, self.n_poses)
        clone._between = [column.copy() for column in self._between]
        clone._factors = self._factors
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
        variance : (k,) by which to multiply the covariance of each, none: as they are

        """
        part = FactorGraph(self.manifold, self.n_poses)
        i, j, measurement, root, trusted, struck = (
            column.view()[chosen] for column in self._between)
        if variance is not None:
            root = root / np.sqrt(variance)[:, None, None]
        part.append_between(i, j, measurement, root, trusted, struck)
        return part

    @property
    def between(self) -> BetweenFactors:
        """All factors so far: a snapshot that later appends do not change."""
        if self._factors is None:
            self._factors = BetweenFactors(*(column.view() for column in self._between))
        return self._factors

    def add_poses(self, count: int = 1) -> None:
        """Let `count` more keyframes exist; the next index is `n_poses` before the call."""
        self.n_poses += count

    def append_step(self, measurement: Array, sqrt_information: Array) -> None:
        """Append a keyframe and the factor to it from the one before: (1, p), (1, d, d)."""
        self.add_poses(1)
        k = np.array([self.n_poses - 1])
        self.append_between(k - 1, k, measurement, sqrt_information)

    def add_between(self, i: Indices, j: Indices, measurement: Array, information: Array,
                    trusted: Mask | bool = False) -> None:
        """
        Append between factors: i, j (m,), measurement (m, p), information (m, d, d), trusted (m,).

        Where i is `WORLD` the measurement is the pose of keyframe j in the map frame. Components
        without any information, whole rows and columns of zeros, say nothing.

        Raises
        ------
        GraphError : an index without a keyframe, a self loop, a measurement that is not finite.
        NoiseError : an information matrix that is not positive definite where it says something,
            or that says nothing at all.

        Nothing is appended when anything is wrong.

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
        values = (i, j, measurement, sqrt_information, np.broadcast_to(trusted, len(i)),
                  np.broadcast_to(struck, len(i)))
        for column, value in zip(self._between, values, strict=True):
            column.extend(value)
        self._factors = None

    def say(self, rows: Indices, trusted: bool) -> None:
        """Let some between factors be vouched for, or else struck out; the last word counts."""
        for column, value in ((-2, trusted), (-1, not trusted)):
            said = self._between[column].view().copy()
            said[rows] = value
            # What was seen of the column before stays as it was.
            self._between[column] = GrowingArray((), np.bool_)
            self._between[column].extend(said)
        self._factors, self.said = None, self.said + 1


def as_poses(graph: FactorGraph, values: object, what: str) -> Array:
    """
    Return what a caller calls poses as an array (n, p) of numbers, finite or not.

    what : begins the sentence on what is wrong with them, e.g. `poses have`

    Raises
    ------
    GraphError : of another shape, or none of numbers.

    """
    expected = (graph.n_poses, graph.manifold.POSE_SIZE)
    try:
        poses = np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise GraphError(f'{what} entries that are no numbers ({error}), expected the shape '
                         f'{expected}') from error
    if poses.shape != expected:
        raise GraphError(f'{what} the shape {poses.shape}, expected {expected}')
    return poses


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
    other = FactorGraph(manifold, graph.n_poses)
    other.append_between(i, j, Z, roots, factors.trusted, factors.struck)
    return other
