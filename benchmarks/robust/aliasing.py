# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Far streets that are taken for each other, as place recognition does it.

In: a graph and its map. Out: runs of consecutive loops, each run moved by one wrong transform W:
the loops of a run measure Xi^-1 W Xj, so they agree with each other and with nothing else. Each
keyframe j of a street is joined to the keyframe i nearest to where W moves it.
"""

import numpy as np
from scipy.spatial import cKDTree

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.spanning_tree import pair_key
from l1slam_ros.core.worlds.false_loops import Loops

LENGTH = 50
# Ends are far apart when they are so in the map, by this part of its diagonal, and in time, by
# this part of all keyframes.
_FAR = 0.1
# Standard deviations [m, rad] of where one street seems to lie beside the other.
_OFFSET = np.array([1.0, 1.0, 0.1])
# Of so many places for a street, the one whose keyframes are nearest to what they are taken for.
_CANDIDATES, _TRIES = 200, 50
# Loops whose ends lie within so many keyframes are of one place.
_PLACE = 10


def aliased_loops(graph: FactorGraph, poses: Array, streets: int, same: bool,
                  rng: np.random.Generator, length: int = LENGTH) -> Loops:
    """
    Return `length` loops for each of some streets.

    same : one transform for all of them, else each has its own
    """
    for _ in range(_TRIES):
        runs: list[tuple[Indices, Indices, Array]] = []
        taken = np.zeros(graph.n_poses, bool)
        wrong = _wrong_transform(graph, poses, rng)
        for _ in range(_TRIES):
            run = _street(graph, poses, wrong, taken, length, rng)
            if run is not None:
                runs.append((*run, wrong))
                taken[run[1]] = True
            elif same:
                # This map has not enough streets that one transform makes alike.
                break
            if len(runs) == streets:
                return _loops(graph, poses, runs)
            wrong = wrong if same else _wrong_transform(graph, poses, rng)
    raise GraphError(f'{streets} streets of {length} keyframes asked for, found no room')


def _wrong_transform(graph: FactorGraph, poses: Array, rng: np.random.Generator) -> Array:
    """Return W (p,) that moves some keyframe beside another one that is far."""
    manifold, n = graph.manifold, graph.n_poses
    positions = manifold.positions(poses)
    while True:
        i, j = np.sort(rng.integers(n, size=2))
        if _are_far(np.array([i]), np.array([j]), positions)[0]:
            beside = manifold.retract(poses[[i]], _OFFSET * rng.standard_normal((1, 3)))
            return manifold.compose(beside, manifold.inverse(poses[[j]]))[0]


def _street(graph: FactorGraph, poses: Array, wrong: Array, taken: np.ndarray, length: int,
            rng: np.random.Generator) -> tuple[Indices, Indices] | None:
    """Return the keyframes i, j (length,) of the best of some random streets, None: none does."""
    manifold, n = graph.manifold, graph.n_poses
    positions = manifold.positions(poses)
    moved = manifold.positions(manifold.compose(np.broadcast_to(wrong, poses.shape), poses))
    away, nearest = cKDTree(positions).query(moved)
    good = ~taken & _are_far(nearest, np.arange(n), positions)
    good &= ~np.isin(pair_key(nearest, np.arange(n), n),
                     pair_key(graph.between.i, graph.between.j, n))
    starts = rng.integers(n - length, size=_CANDIDATES)
    windows = starts[:, None] + np.arange(length)
    starts = starts[good[windows].all(axis=1)]
    if not len(starts):
        return None
    best = min(starts.tolist(), key=lambda start: away[start : start + length].max())
    j = np.arange(best, best + length)
    return nearest[j], j


def _are_far(i: Indices, j: Indices, positions: Array) -> np.ndarray:
    distance = np.linalg.norm(positions[i] - positions[j], axis=1)
    far: np.ndarray = (distance >= _FAR * np.linalg.norm(np.ptp(positions, axis=0))) & (
        np.abs(j - i) >= _FAR * len(positions))
    return far


def _loops(graph: FactorGraph, poses: Array,
           runs: list[tuple[Indices, Indices, Array]]) -> Loops:
    """Return the loops in order of time, as sure as the median true one."""
    manifold, factors = graph.manifold, graph.between
    i, j = (np.concatenate([run[k] for run in runs]) for k in (0, 1))
    wrong = np.concatenate([np.broadcast_to(w, (len(run_i), len(w))) for run_i, _, w in runs])
    measured = manifold.between(poses[i], manifold.compose(wrong, poses[j]))
    measured = np.where((i > j)[:, None], manifold.inverse(measured), measured)
    i, j = np.minimum(i, j), np.maximum(i, j)
    order = np.lexsort((i, j))
    roots = factors.sqrt_information[~factors.is_odometry]
    size = np.linalg.det(roots)
    root = roots[np.argsort(size)[len(size) // 2]]
    return Loops(i[order], j[order], measured[order],
                 np.broadcast_to(root.T @ root, (len(i), *root.shape)))


def outnumbers(graph: FactorGraph, lies: Loops, streets: int, whose: str) -> bool:
    """
    Tell whether more streets agree on a wrong transform than true places speak against it.

    Where they are to be a slip of the odometry, true places stand across that step; what stands
    across the step with the fewest, between the ends of the lies, is what there is against them.
    """
    factors, n = graph.between, graph.n_poses
    is_loop = ~factors.is_odometry
    ends = np.stack((np.minimum(factors.i, factors.j), np.maximum(factors.i, factors.j)))
    places = np.unique(ends[:, is_loop] // _PLACE, axis=1) * _PLACE
    across = np.cumsum(np.bincount(places[0], minlength=n) - np.bincount(places[1], minlength=n))
    against = min(int(across[i:j].min()) for i, j in zip(lies.i, lies.j, strict=True))
    return (streets if whose == 'same' else 1) > against
