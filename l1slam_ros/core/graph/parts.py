# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Graphs in several parts: which there are, what refuses them, and what ties them together.

In: a graph whose odometry has gaps, or that nothing accepted ties together. Out: its parts, poses
to begin with, or the same graph with a factor in each gap that no other factor speaks against, so
that a solver comes to the same optimum.
"""

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import NO_PREDECESSOR, FactorGraph, component_labels
from l1slam_ros.core.graph.spanning_tree import odometry_poses, tree_poses
from l1slam_ros.core.graph.world_frame import placed

# A gap: each number of the odometry is so many times vaguer, in the mean; and no number is less.
_VAGUE, _TINY = 21.5, 1e-300


def give_to(graph: FactorGraph, robot: Indices) -> None:
    """Let keyframes be of these robots, (n,), each follow the last one of its robot."""
    order = np.argsort(robot, kind='stable')
    before = np.full(len(robot), NO_PREDECESSOR)
    before[order[1:]] = np.where(np.diff(robot[order]), NO_PREDECESSOR, order[:-1])
    graph.follow(np.arange(len(robot)), before, robot)


def ends_before(graph: FactorGraph) -> Indices:
    """
    Return behind which keyframe each of `FactorGraph.firsts` is put by a guess, (g,).

    The last one before it of its own robot; of the first one of a robot, the one before it.
    """
    firsts, robot = graph.firsts, graph.robot
    order = np.argsort(robot, kind='stable')
    at = np.argsort(order)[firsts]
    own = order[np.maximum(at - 1, 0)]
    return np.where((at > 0) & (robot[own] == robot[firsts]), own, firsts - 1)


def odometry_gaps(graph: FactorGraph) -> Indices:
    """Return the keyframes k where no odometry leads from any keyframe to k + 1, (g,)."""
    return np.flatnonzero(graph.between.step_to[1:] < 0)


def vague_odometry(graph: FactorGraph) -> Mask:
    """Return which factors are odometry so vague, beside all other, that it says nothing, (m,)."""
    factors = graph.between
    diagonal = np.abs(np.diagonal(factors.sqrt_information, axis1=1, axis2=2))
    size = np.where(factors.speaks, np.log(np.maximum(diagonal, _TINY)), 0.0).sum(axis=1)
    odometry = factors.is_odometry
    vague = np.log(_VAGUE) * graph.manifold.TANGENT_SIZE
    odometry = odometry & ~graph.is_landmark[factors.j]  # a sighting says where it is
    return odometry & (size < np.median(size[odometry]) - vague if odometry.any() else False)


def part_labels(graph: FactorGraph) -> Indices:
    """Return the number of the part of each keyframe, (n,): vague odometry joins none."""
    return component_labels(graph.subset(~vague_odometry(graph)))


def connected_parts(graph: FactorGraph) -> list[Indices]:
    """Return the keyframes of each part of the graph, ascending; the first part has keyframe 0."""
    labels = component_labels(graph)
    ends = np.cumsum(np.bincount(labels))[:-1]
    return np.split(np.argsort(labels, kind='stable'), ends)


def require_connected(graph: FactorGraph, ids: Indices) -> None:
    """
    Refuse a graph of several parts; ids : (n,) what the keyframes are called.

    Raises
    ------
    GraphError : naming a vertex of the loose part.

    """
    labels = component_labels(graph)
    loose = np.flatnonzero(labels != labels[0])
    if len(loose):
        others = f' and {len(loose) - 1:,} more have' if len(loose) > 1 else ' has'
        raise GraphError(f'the graph is not connected: vertex {ids[loose[0]]}{others} no path to '
                         f'vertex {ids[0]}; `l1slam info` lists the parts')


def initial_poses(graph: FactorGraph, stored: Array | None, ids: Indices) -> Array:
    """
    Return the stored poses, (n, p); where there are none, the odometry chain.

    Where that has gaps, the poses along a breadth-first tree from the first keyframe.

    Raises
    ------
    GraphError : none is stored, and the graph is not connected.

    """
    if stored is not None:
        return stored
    require_connected(graph, ids)
    poses = tree_poses(graph, 0) if len(odometry_gaps(graph)) else odometry_poses(graph)
    return placed(graph, poses)


def bridged(graph: FactorGraph) -> FactorGraph:
    """Return the graph with a factor for each gap of its odometry, behind all others."""
    gaps = odometry_gaps(graph)
    return _with_steps(graph, gaps, graph.manifold.identity(len(gaps)))


def tied(graph: FactorGraph, poses: Array) -> FactorGraph:
    """
    Return the graph with its parts tied together where they are, poses (n, p).

    Each but the first gets one more factor, behind all others, from its first keyframe to the one
    before, which is of an earlier part. They form a tree, so the optimum leaves no residual.
    """
    first = np.unique(component_labels(graph), return_index=True)[1][1:]
    return _with_steps(graph, first - 1, graph.manifold.between(poses[first - 1], poses[first]))


def as_sure(graph: FactorGraph, rows: Mask) -> FactorGraph:
    """Return the graph, some factors of which, (m,) bool, are as sure as its odometry."""
    if not rows.any():
        return graph
    sure = graph.subset(np.arange(len(rows)))
    sure.between.sqrt_information[rows] = _usual(graph)
    return sure


def _with_steps(graph: FactorGraph, at: Indices, Z: Array) -> FactorGraph:
    """Return the graph with steps Z (k, p) from keyframes `at` (k,), as sure as its odometry."""
    if not len(at):
        return graph
    whole = graph.copy()
    usual = _usual(graph)
    whole.follow(at + 1, at)
    whole.append_between(at, at + 1, Z, np.broadcast_to(usual, (len(at), *usual.shape)))
    return whole


def _usual(graph: FactorGraph) -> Array:
    """Return the root of the information of odometry, in the median, (k, k)."""
    odometry = graph.between.is_odometry
    return (np.median(graph.between.sqrt_information[odometry], axis=0) if odometry.any()
            else np.eye(graph.manifold.TANGENT_SIZE))
