# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
False loops: measurements between far poses that claim they were near, as place recognition makes.

In: a graph on any manifold, an estimate of its trajectory, a count, a random generator. Out: that
many loops, and the graph with them in it. A loop is false when its poses are far apart in the
estimate, so the better the estimate, the surer.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import sigmas
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.spanning_tree import odometry_poses, pair_key
from l1slam_ros.core.names import KINDS_OF_FALSE_LOOPS

# Two poses are far apart when they are so in time and in space: by this part of all keyframes
# and by this part of the diagonal of the box the trajectory fills.
_FAR = 0.1
# Standard deviations [m] and [rad] of where a false loop says its poses are to each other: near,
# the policy of Vertigo (Suenderhauf and Protzel, 2012).
_SIGMA_TRANSLATION = 0.3
_SIGMA_ROTATION = math.radians(10)
# Loops of one group, fewest and most.
_GROUP = 10, 20
# Rounds of drawing far pairs; in each about four of five find a place in an ordinary graph.
_ROUNDS = 200


@dataclass(frozen=True)
class Loops:
    """
    Loops to be put into a graph: arguments of `FactorGraph.add_between`.

    i, j : (m,) with i < j; measurement : (m, p); information : (m, d, d).
    """

    i: Indices
    j: Indices
    measurement: Array
    information: Array


def insert_loops(graph: FactorGraph, loops: Loops) -> FactorGraph:
    """
    Return a new graph with each loop behind all factors that end where it ends, or earlier.

    The factors that were there keep their order, so in a graph in order of time the loops come
    when a robot would have met them.
    """
    factors = graph.between
    ends = np.maximum.accumulate(np.maximum(factors.i, factors.j))
    place = np.searchsorted(ends, loops.j, side='right')
    longer = graph.without_factors()
    longer.add_between(
        np.insert(factors.i, place, loops.i), np.insert(factors.j, place, loops.j),
        np.insert(factors.measurement, place, loops.measurement, axis=0),
        np.insert(_information(factors.sqrt_information), place, loops.information, axis=0),
        np.insert(factors.trusted, place, False))
    return longer


def random_false_loops(
    graph: FactorGraph, poses: Array, count: int, rng: np.random.Generator
) -> Loops:
    """
    Return loops between far poses that claim to have been nearly at the same place.

    Parameters
    ----------
    graph : where the loops may go; no pair it has a factor for is used
    poses : (n, p) any estimate of the trajectory [m, rad]; judges what is far

    Raises
    ------
    GraphError : too few far pairs are free.

    """
    _require_room(graph, count)
    i, j, _ = _far_runs(graph, poses, np.ones(count, np.int64), rng)
    return _loops(graph, i, j, _small_offsets(graph.manifold, count, rng))


def identity_false_loops(
    graph: FactorGraph, poses: Array, count: int, rng: np.random.Generator
) -> Loops:
    """Return loops between far poses that measure exactly nothing; as `random_false_loops`."""
    _require_room(graph, count)
    i, j, _ = _far_runs(graph, poses, np.ones(count, np.int64), rng)
    return _loops(graph, i, j, graph.manifold.identity(count))


def grouped_false_loops(
    graph: FactorGraph, poses: Array, count: int, rng: np.random.Generator
) -> Loops:
    """
    Return runs of loops (i + k, j + k) that agree with each other; as `random_false_loops`.

    Two far stretches are taken for the same street: the first loop of a run is as random, the
    others follow from it by the odometry of both stretches, without any noise of their own. A
    run has 10 to 20 loops, the last one of all perhaps fewer.
    """
    _require_room(graph, count)
    few, many = _GROUP
    ends = np.cumsum(rng.integers(few, many + 1, size=count // few + 1)).clip(max=count)
    lengths = np.diff(ends, prepend=0)
    i, j, run = _far_runs(graph, poses, lengths[lengths > 0], rng)
    manifold = graph.manifold
    chain = odometry_poses(graph)
    first = np.searchsorted(run, run)
    wrong = _small_offsets(manifold, count, rng)[first]
    back_along_i = manifold.between(chain[i], chain[i[first]])
    along_j = manifold.between(chain[j[first]], chain[j])
    return _loops(graph, i, j, manifold.compose(back_along_i, manifold.compose(wrong, along_j)))


FALSE_LOOPS: dict[str, Callable[[FactorGraph, Array, int, np.random.Generator], Loops]] = dict(zip(
    KINDS_OF_FALSE_LOOPS, (random_false_loops, identity_false_loops, grouped_false_loops),
    strict=True))


def _require_room(graph: FactorGraph, count: int) -> None:
    """Refuse, before arrays of that size are made, more loops than there are pairs."""
    n = graph.n_poses
    pairs = n * (n - 1) // 2
    if count > pairs:
        raise GraphError(f'{count} false loops asked for, found {pairs} pairs among {n} '
                         'keyframes')


def _small_offsets(manifold: Manifold, count: int, rng: np.random.Generator) -> Array:
    """Return random poses near the identity, (count, p)."""
    sigma = sigmas(manifold, _SIGMA_TRANSLATION, _SIGMA_ROTATION)
    noise = sigma * rng.standard_normal((count, manifold.TANGENT_SIZE))
    return manifold.retract(manifold.identity(count), noise)


def _far_runs(
    graph: FactorGraph, poses: Array, lengths: Indices, rng: np.random.Generator
) -> tuple[Indices, Indices, Indices]:
    """
    Return random runs of pairs (i + k, j + k), k < length, all far, free and used once.

    lengths : (r,); the pairs i, j (m,) come run by run with the number of their run (m,).
    """
    positions = graph.manifold.positions(poses)
    factors = graph.between
    n = graph.n_poses
    taken = pair_key(factors.i, factors.j, n)
    start = np.zeros((len(lengths), 2), np.int64)
    todo = np.arange(len(lengths))
    for _ in range(_ROUNDS):
        start[todo] = np.sort(rng.integers(n, size=(len(todo), 2)), axis=1)
        i, j, run = _run_pairs(start[todo], lengths[todo])
        key = pair_key(i, j, n)
        good = _are_far(i, j, positions) & _are_new(key, taken)
        kept = np.bincount(run, ~good, minlength=len(todo)) == 0
        taken = np.concatenate((taken, key[kept[run]]))
        todo = todo[~kept]
        if not len(todo):
            return _run_pairs(start, lengths)
    raise GraphError(f'{lengths.sum()} false loops asked for, found room for '
                     f'{lengths.sum() - lengths[todo].sum()} between far pairs among {n} '
                     'keyframes')


def _run_pairs(start: Indices, lengths: Indices) -> tuple[Indices, Indices, Indices]:
    """Return i, j and the run of each pair, for runs that begin at the pairs `start` (r, 2)."""
    run = np.repeat(np.arange(len(lengths)), lengths)
    along = np.arange(len(run)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return start[run, 0] + along, start[run, 1] + along, run


def _are_far(i: Indices, j: Indices, positions: Array) -> np.ndarray:
    """Tell which pairs, i < j, are far apart by index and by position; none beyond the end is."""
    n = len(positions)
    inside = np.minimum(np.stack((i, j)), n - 1)
    distance = np.linalg.norm(positions[inside[0]] - positions[inside[1]], axis=1)
    far: np.ndarray = distance >= _FAR * np.linalg.norm(np.ptp(positions, axis=0))
    return far & (j < n) & (j - i >= max(2, _FAR * n))


def _are_new(key: Indices, taken: Indices) -> np.ndarray:
    """Tell which keys are not among those taken, nor earlier among themselves."""
    new = np.zeros(len(taken) + len(key), bool)
    new[np.unique(np.concatenate((taken, key)), return_index=True)[1]] = True
    return new[len(taken) :]


def _loops(graph: FactorGraph, i: Indices, j: Indices, measurement: Array) -> Loops:
    """Return the loops in order of time, as sure of themselves as the true ones of the graph."""
    order = np.lexsort((i, j))
    information = _typical_information(graph)
    return Loops(i[order], j[order], measurement[order],
                 np.broadcast_to(information, (len(i), *information.shape)))


def _typical_information(graph: FactorGraph) -> Array:
    """Return the (d, d) information of median determinant: of loops, of odometry if none is."""
    factors = graph.between
    if not len(factors):
        raise GraphError('the graph has no factor, expected some whose information to take')
    loops = ~factors.is_odometry & ~factors.is_absolute & factors.speaks.all(axis=1)
    roots = factors.sqrt_information[loops if loops.any() else factors.is_odometry]
    size = np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
    median = np.argsort(size, kind='stable')[(len(size) - 1) // 2]
    return _information(roots[median : median + 1])[0]


def _information(roots: Array) -> Array:
    """Return L L' of the stacked roots L', (m, d, d)."""
    return roots.transpose(0, 2, 1) @ roots
