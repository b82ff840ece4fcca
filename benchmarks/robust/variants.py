# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Recordings told otherwise: what is true of them stays, so a judgement that is right stays too.

In: a place. Out: the place as it would have been recorded backwards, in a mirror, in other units,
for a while only, with fewer keyframes, or without a word on its noise; with each loop told several
times, odometry that drifts, or corridors that look alike.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from robust.places import Error, Place, error_by_time

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph, turned
from l1slam_ros.core.graph.spanning_tree import odometry_poses, pair_key


def _backwards(place: Place) -> Place:
    """Let the last keyframe be the first."""
    graph = turned(place.graph, np.ones(len(place.graph.between), bool))
    last = graph.n_poses - 1
    return _told(place, last - np.arange(last + 1), np.arange(len(graph.between)),
                 last - graph.between.i, last - graph.between.j, graph.between.measurement,
                 graph.between.sqrt_information)


def _stretched(place: Place, *times: float) -> Place:
    """Multiply the coordinates of each step; mirrored where an axis and the turn change sign."""
    factors = place.graph.between
    return replace(
        _told(place, np.arange(place.graph.n_poses), np.arange(len(factors)), factors.i,
              factors.j, factors.measurement * times, factors.sqrt_information / times,
              np.array(times[:2])), unit=1 / times[0])


def _stretch(place: Place, first: float, last: float) -> Place:
    """Keep a stretch of the way, from one part of it to another."""
    n, factors = place.graph.n_poses, place.graph.between
    begin, end = round(first * n), round(last * n)
    rows = np.flatnonzero((np.minimum(factors.i, factors.j) >= begin)
                          & (np.maximum(factors.i, factors.j) < end))
    return _told(place, np.arange(begin, end), rows, factors.i[rows] - begin,
                 factors.j[rows] - begin, factors.measurement[rows],
                 factors.sqrt_information[rows])


def _every(place: Place, k: int) -> Place:
    """Keep each k-th keyframe; loops go over to the nearest one by the odometry."""
    graph, manifold = place.graph, place.graph.manifold
    n, factors = graph.n_poses, graph.between
    chain, kept = odometry_poses(graph), np.arange(0, n, k)
    step = np.zeros((n, manifold.TANGENT_SIZE, manifold.TANGENT_SIZE))
    odometry = turned(graph, factors.i > factors.j).between
    rows = np.flatnonzero(odometry.is_odometry)
    step[odometry.j[rows]] = _covariance(odometry.sqrt_information[rows])

    def way(a: Indices, b: Indices) -> tuple[Array, Array]:
        """Return the pose of b seen from a, and its covariance, by the odometry."""
        Z, C = manifold.between(chain[a], chain[b]), np.zeros((len(a), *step.shape[1:]))
        for shift in range(int(np.abs(b - a).max(initial=0))):
            on = (np.minimum(a, b) + shift + 1) % n
            ahead = np.abs(b - a) > shift
            J = manifold.adjoint(manifold.between(chain[b], chain[on]))
            C[ahead] += (J @ step[on] @ J.transpose(0, 2, 1))[ahead]
        return Z, C

    loops = np.flatnonzero(~factors.is_odometry)
    ends = [np.minimum((end[loops] + (k - 1) // 2) // k, len(kept) - 1)
            for end in (factors.i, factors.j)]
    apart = ends[0] != ends[1]
    loops, (a, b) = loops[apart], (end[apart] for end in ends)
    before, of_before = way(kept[a], factors.i[loops])
    after, of_after = way(factors.j[loops], kept[b])
    onward = manifold.compose(factors.measurement[loops], after)
    J, K = (manifold.adjoint(manifold.inverse(T)) for T in (onward, after))
    C = (J @ of_before @ J.transpose(0, 2, 1) + of_after + K @ _covariance(
        factors.sqrt_information[loops]) @ K.transpose(0, 2, 1))
    Z, of_steps = way(kept[:-1], kept[1:])
    at = np.arange(len(kept))
    last = np.zeros(n, np.int64)
    last[odometry.j[rows]] = rows
    return _told(place, kept, np.concatenate((last[kept[1:]], loops)),
                 np.concatenate((at[:-1], a)), np.concatenate((at[1:], b)),
                 np.concatenate((Z, manifold.compose(before, onward))),
                 np.linalg.cholesky(np.linalg.inv(np.concatenate((of_steps, C)))).transpose(
                     0, 2, 1))


def _unknown(place: Place) -> Place:
    """State the identity as information of each factor; the map to find is that of its own."""
    factors, roots = place.graph.between, place.graph.between.sqrt_information
    error = place.truth_error or error_by_time(place.graph.manifold.positions(place.best))
    return _told(replace(place, truth_error=error), np.arange(place.graph.n_poses),
                 np.arange(len(factors)), factors.i, factors.j, factors.measurement,
                 np.zeros_like(roots) + np.eye(roots.shape[1]))


def _repeated(place: Place, times: int) -> Place:
    """Tell each loop so many times."""
    factors = place.graph.between
    rows = np.concatenate((np.arange(len(factors)),
                           np.repeat(np.flatnonzero(~factors.is_odometry), times - 1)))
    return _told(place, np.arange(place.graph.n_poses), rows, factors.i[rows], factors.j[rows],
                 factors.measurement[rows], factors.sqrt_information[rows])


def _drifting(place: Place, turn: float, stretch: float) -> Place:
    """Let the odometry turn so much more on each metre [rad], and stretch it."""
    graph = place.graph
    manifold = place.graph.manifold
    factors = place.graph.between
    Z, odometry = factors.measurement.copy(), factors.is_odometry
    way = Z[odometry]
    way[:, manifold.TRANSLATION] *= stretch
    more = np.zeros((len(way), manifold.TANGENT_SIZE))
    more[:, manifold.ROTATION.stop - 1] = turn * np.linalg.norm(
        manifold.positions(way), axis=1)
    Z[odometry] = manifold.retract(way, more)
    return _told(place, np.arange(graph.n_poses), np.arange(len(factors)), factors.i, factors.j,
                 Z, factors.sqrt_information)


def _corridor(place: Place, part: float, times: float) -> Place:
    """
    Tell a part of the loops once more, from other keyframes, as much as 5 m along the way off.

    times : what the noise of all is said to be, in units of what it was said to be
    """
    graph = place.graph
    manifold = place.graph.manifold
    factors = place.graph.between
    rng = np.random.default_rng(0)
    m = len(factors)
    n = graph.n_poses
    told = pair_key(factors.i, factors.j, n)
    loops = np.flatnonzero(~factors.is_odometry & (np.maximum(factors.i, factors.j) < n - 3)
                           & ~np.isin(pair_key(factors.i + 2, factors.j + 3, n), told))
    rows = rng.choice(loops, round(part * len(loops)), replace=False)
    i = factors.i[rows] + 2
    j = factors.j[rows] + 3
    count = len(rows)
    along = np.zeros((count, manifold.TANGENT_SIZE))
    along[:, 0] = rng.choice([-1, 1], count) * rng.uniform(1.0, 5.0, count)
    Z = manifold.retract(manifold.between(place.best[i], place.best[j]), along)
    place = _told(place, np.arange(n), np.concatenate((np.arange(m), rows)),
                 np.concatenate((factors.i, i)), np.concatenate((factors.j, j)),
                 np.concatenate((factors.measurement, Z)), np.concatenate(
                     (factors.sqrt_information, factors.sqrt_information[rows])) / times)
    lies = np.arange(m + count) >= m
    return replace(place, is_false=place.is_false | lies, is_true=place.is_true & ~lies)


VARIANTS: dict[str, Callable[..., Place]] = {
    'backwards': _backwards, 'stretched': _stretched, 'stretch': _stretch, 'every': _every,
    'unknown': _unknown, 'repeated': _repeated, 'drifting': _drifting, 'corridor': _corridor,
}


def _covariance(roots: Array) -> Array:
    inverse = np.linalg.inv(roots)
    product: Array = inverse @ inverse.transpose(0, 2, 1)
    return product


def _told(place: Place, keyframes: Indices, rows: Indices, i: Indices, j: Indices, Z: Array,
          roots: Array, times: Array | float = 1.0) -> Place:
    """Return a place of some keyframes of another, each factor one of its rows told otherwise."""
    graph = FactorGraph(place.graph.manifold, len(keyframes))
    graph.add_between(i, j, Z, roots.transpose(0, 2, 1) @ roots)
    error = place.truth_error
    return Place(place.name, graph, None, place.is_false[rows], place.is_true[rows],
                 error and _as_before(error, place.graph.n_poses, keyframes, times), place.timed)


def _as_before(error: Error, n: int, keyframes: Indices, times: Any) -> Error:
    """Return the error of positions of some of n keyframes, coordinates multiplied."""
    def of(positions: Array) -> float:
        before = np.full((n, positions.shape[1]), np.nan)
        before[keyframes[:len(positions)]] = positions / times
        return error(before)

    return of
