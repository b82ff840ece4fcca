# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Places: groups of loops that may share one error.

In: a graph. Out: the place of each loop. Loops are linked that join the same two stretches of the
path and measure nearly the same offset from the odometry; a place is a connected component of
links (single linkage). Distances are in metres along the path, not in keyframes. Also repeated
loops, neighbours, and a test for a common error.
"""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.quantiles import gamma_quantile
from l1slam_ros.core.graph.factor_graph import FactorGraph, ends_in_time, lowest_of_components
from l1slam_ros.core.graph.linear_system import with_world
from l1slam_ros.core.graph.spanning_tree import pair_key
from l1slam_ros.core.robust.innovation import BY_CHANCE

# Ends of linked loops are within this distance along the path, in sum, or within this many median
# steps where keyframes are far apart; so are their offsets.
NEAR = 5.0
_NEAR_STEPS = 10
# [m, rad] Loops between the same keyframes that differ by less are one, listed twice or from
# either end, rounded; separate measurements hardly ever agree so closely.
_SAME = 1e-4
# Rounding, as a part of the linking distance: a robot at rest has few distinct loops.
_GRAIN = 0.1


def first_told(graph: FactorGraph, left: Indices) -> Indices:
    """
    Return the first factor with the same measurement of the same keyframes, (m,), mostly itself.

    Front ends list a loop twice, or from either end; it cannot confirm itself.

    left : (k,) factors to compare; others map to themselves
    """
    first = np.arange(len(graph.between))
    low, high, Z = ends_in_time(graph)
    while len(left):
        _, at, pair = np.unique(pair_key(low[left], high[left], graph.n_poses),
                                return_index=True, return_inverse=True)
        one = left[at[pair]]
        same = (abs(graph.manifold.local(Z[one], Z[left])) < _SAME).all(axis=1)
        first[left[same]] = one[same]
        left = left[~same]
    return first


def err_together(place: Indices, residual: Array, drawn: Array) -> bool:
    """
    Return whether the loops of a place share an error, at the level `BY_CHANCE`.

    Then their sums over a place are larger, relative to single loops.

    place : (m,) of each loop; residual : (m, k) whitened; drawn : (m, k, q) samples of it with
    independent noise
    """
    _, number, count = np.unique(place, return_inverse=True, return_counts=True)
    sums, left = (np.zeros((len(count), *values.shape[1:])) for values in (residual, drawn))
    np.add.at(sums, number, residual)
    np.add.at(left, number, drawn)
    found, expected = (
        values[count > 1] for values in ((sums**2).sum(axis=1) / count,
                                         (left**2).mean(axis=2) / count[:, None]))
    if not expected.any():
        return False
    larger = (found.sum() / (residual**2).sum()
              * (drawn**2).mean(axis=2).sum() / expected.sum())
    # A weighted sum of squares is nearly chi2 (F. E. Satterthwaite, An approximate distribution of
    # estimates of variance components, 1946).
    freedom = expected.sum() ** 2 / (expected**2).sum()
    return bool(larger * freedom > 2 * gamma_quantile(freedom / 2, 1 - BY_CHANCE))


def places(graph: FactorGraph, chain: Array) -> tuple[Indices, Array]:
    """
    Return the place of each factor, (m,), and its coordinates along the path, (m, 2).

    These are the sum and the difference of the path lengths of its ends, in units of the linking
    distance: factors are as far apart as the larger difference of the two.

    chain : (n, p) poses along the odometry
    """
    manifold = graph.manifold
    low, high, Z = ends_in_time(graph)
    positions = manifold.positions(chain)
    # A landmark is where the keyframe is that places it.
    on_way = np.where(graph.is_landmark[:, None], positions[graph.parent], positions)
    steps = np.linalg.norm(np.diff(on_way, axis=0), axis=1)
    # The world is at the start of the path; `WORLD` indexes the last entry.
    way = np.concatenate(([0.0], np.cumsum(steps), [0.0]))
    near = max(NEAR, _NEAR_STEPS * float(np.median(steps)) if len(steps) else 0.0)
    ends = np.stack((way[high] + way[low], way[high] - way[low]), axis=1) / near
    claimed = manifold.compose(with_world(manifold, chain)[low], Z)
    claim = manifold.positions(claimed) - positions[high]
    cells, cell = _cells(np.round(np.hstack((ends, claim / near)) / _GRAIN))
    lowest = lowest_of_components(*_near(cells, 1 / _GRAIN), len(cells))
    place = np.unique(lowest, return_inverse=True)[1]
    return place[cell], ends


def mates(place: Indices, ends: Array) -> tuple[Indices, Indices]:
    """Return the pairs of neighbouring loops of a place, both orders, (pairs,) each."""
    one, other = _near(ends, 1.0)
    same = place[one] == place[other]
    one, other = one[same], other[same]
    return np.concatenate((one, other)), np.concatenate((other, one))


def _cells(corners: Array) -> tuple[Array, Indices]:
    """
    Return the distinct rows of corners (n, k), sorted, and the index of each, (n,).

    Twice as fast as `np.unique` along an axis, which holds Python's lock throughout.
    """
    order = np.lexsort(corners.T[::-1])
    ordered = corners[order]
    is_new = (np.diff(ordered, axis=0, prepend=np.nan) != 0).any(axis=1)
    cell = np.empty(len(order), np.int64)
    cell[order] = np.cumsum(is_new) - 1
    return ordered[is_new], cell


def _near(points: Array, reach: float) -> tuple[Indices, Indices]:
    """
    Return the pairs of points (n, k) within `reach` in each component, (pairs,).

    By strips of that width along the first, each sorted by the second. SciPy's trees do the same,
    but their import takes longer than most solves.
    """
    strip = np.floor(points[:, 0] / reach)
    height = np.ptp(points[:, 1]) + 4 * reach if len(points) else 0.0
    where = strip * height + points[:, 1]
    order = np.argsort(where, kind='stable')
    points = points[order]
    where = where[order]
    number = np.arange(len(order))
    found = []
    for first, last in ((number + 1, where + reach),
                        (np.searchsorted(where, where + height - reach), where + height + reach)):
        count = np.maximum(np.searchsorted(where, last, side='right') - first, 0)
        one = np.repeat(number, count)
        other = np.arange(len(one)) + np.repeat(first - (np.cumsum(count) - count), count)
        near = (np.abs(points[one] - points[other]) <= reach).all(axis=1)
        found.append((order[one[near]], order[other[near]]))
    (one, other), (more, others) = found
    return np.concatenate((one, more)), np.concatenate((other, others))
