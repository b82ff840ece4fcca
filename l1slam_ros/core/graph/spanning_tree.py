# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
First poses from the graph alone: compose the measurements along a spanning tree.

In: a factor graph. Out: (n, p) poses, keyframe 0 at the identity.
"""

from collections.abc import Sequence

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph, component_labels


def odometry_poses(graph: FactorGraph) -> Array:
    """
    Return the chain of the odometry factors, (n, p).

    Raises
    ------
    GraphError : a keyframe, but the first, without odometry from a predecessor.

    """
    parent = graph.parent
    if len(graph.firsts):
        raise GraphError(f'keyframe {graph.firsts[0]} has no predecessor; expected odometry that '
                         'joins all keyframes')
    odometry = np.flatnonzero(graph.between.is_odometry)
    return _compose_along(graph, parent, odometry)


def tree_poses(graph: FactorGraph, root: int) -> Array:
    """
    Return the poses along the breadth-first tree from `root`, (n, p).

    The tree has the shortest chains, so the least drift, of all spanning trees from there. What
    only the world ties to the root is a tree of its own, see `world_frame.placed`.

    Raises
    ------
    GraphError : a keyframe without a path to the root.

    """
    poses = _compose_along(graph, _breadth_first(graph, root), np.arange(len(graph.between)))
    manifold = graph.manifold
    return manifold.between(np.broadcast_to(poses[0], poses.shape), poses)


def _breadth_first(graph: FactorGraph, root: int) -> Indices:
    """
    Return the parent of each keyframe, (n,), the root its own; -1: it has no path to it.

    Where a path leads through the world, another tree begins: the first keyframe there is its own
    parent, too.
    """
    factors = graph.between
    labels = component_labels(graph)
    tied = factors.j[factors.is_absolute]
    roots = root, *tied[labels[tied] == labels[root]].tolist()
    between = ~factors.is_absolute
    return parents(factors.i[between], factors.j[between], graph.n_poses, roots)


def parents(i: Indices, j: Indices, n: int, roots: Sequence[int]) -> Indices:
    """
    Return the parent of each of n nodes in breadth-first trees, (n,); -1: no path leads to it.

    i, j : (m,) ends of the edges; roots : one tree after the other, each its own parent
    """
    return native.spanning_tree.parents(i, j, n, np.array(roots, np.int64))


def compose_tree(parent: Indices, relative: Array) -> Array:
    """
    Return each pose as the product of the relative poses from its root down, (n, p).

    parent : (n,), a root is its own parent; relative : (n, p), seen from the parent; the roots'
    rows are their poses
    """
    return native.spanning_tree.compose(parent, relative)


def _compose_along(graph: FactorGraph, parent: Indices, candidates: Indices) -> Array:
    """Compose along the tree `parent`, each step the first of the candidate factors it has."""
    factors = graph.between
    manifold = graph.manifold
    n = graph.n_poses
    child = np.flatnonzero(parent != np.arange(n))
    if (parent[child] < 0).any():
        lost = child[np.argmax(parent[child] < 0)]
        raise GraphError(f'keyframe {lost} has no path to the rest of the graph')
    candidates = candidates[~factors.is_absolute[candidates]]
    i, j = factors.i[candidates], factors.j[candidates]
    pairs, first = np.unique(pair_key(i, j, n), return_index=True)
    wanted = pair_key(parent[child], child, n)
    place = np.minimum(np.searchsorted(pairs, wanted), max(len(pairs) - 1, 0))
    missing = pairs[place] != wanted if len(pairs) else np.ones(len(wanted), bool)
    if missing.any():
        k = child[np.argmax(missing)]
        raise GraphError(f'no factor between keyframes {parent[k]} and {k}')
    chosen = candidates[first[place]]
    measurement = factors.measurement[chosen]
    downwards = (factors.i[chosen] == parent[child])[:, None]
    relative = manifold.identity(n)
    relative[child] = np.where(downwards, measurement, manifold.inverse(measurement))
    return compose_tree(parent, relative)


def pair_key(i: Indices, j: Indices, n: int) -> Indices:
    """Return one number for each pair of ends, whichever way round, (m,); n : of keyframes."""
    return np.minimum(i, j) * n + np.maximum(i, j)
