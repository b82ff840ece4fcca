# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The state of a graph builder, as it is saved."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.graph.parts import give_to

# [bytes] Of an identity, see `noise.loop_identity`.
_IDENTITY = 16


def key_of(identity: bytes, robots: tuple[int, int]) -> bytes:
    """Return what equal loops have in common; robots : whose times they name."""
    return identity + np.array(robots).tobytes() if any(robots) else identity


@dataclass(frozen=True)
class TrackEnd:
    """
    The end of the odometry of a robot.

    robot : its number; offset (1, p) : see `GraphBuilder`; end : stamp [ns] of the last sample,
    end_pose (1, p) and end_covariance (d, d) of the motion to it from the last keyframe
    """

    robot: int
    offset: Array
    end: int
    end_pose: Array
    end_covariance: Array


@dataclass(frozen=True)
class LoopsState:
    """
    The loops that have come.

    rows (k,) : which between factors are loops; stamps (k, 2) [ns], reference and end, of those;
    expired (l, 2) [ns] : of those that came to nothing; robots (k, 2), expired_robots (l, 2) :
    whose times these are; waiting : loops that wait, and how long each has waited [ns]; seen : of
    each loop that came, by its identity, its factor, -1 for none; struck_pairs (s, 2) : the
    keyframes between which loops are struck out, those to come too
    """

    rows: Indices
    stamps: Indices
    robots: Indices
    expired: Indices
    expired_robots: Indices
    waiting: tuple[tuple[LoopClosure, int], ...]
    seen: Mapping[bytes, int]
    struck_pairs: Indices

    @staticmethod
    def of_graph(graph: FactorGraph, stamps: Indices) -> 'LoopsState':
        """Return that of a graph alone, of one robot; stamps : of its keyframes [ns]."""
        pairs = graph.between.pairs
        rows = np.flatnonzero(~graph.between.is_odometry)
        none = np.zeros((0, 2), np.int64)
        return LoopsState(
            rows, np.sort(stamps[pairs[rows]], axis=1), np.zeros((len(rows), 2), np.int64), none,
            none, (), {}, np.sort(pairs[graph.between.struck], axis=1))

    def renumbered(self, number: Callable[[int], int]) -> 'LoopsState':
        """Return the same where robots have other numbers."""
        waiting = tuple((replace(loop, robot=number(loop.robot),
                                 reference_robot=number(loop.robots[0])), age)
                        for loop, age in self.waiting)
        seen = {}
        for key, row in self.seen.items():
            one, other = np.frombuffer(key[_IDENTITY:], np.int64).tolist() or (0, 0)
            seen[key_of(key[:_IDENTITY], (number(one), number(other)))] = row
        return replace(
            self, robots=_turned(self.robots, number), waiting=waiting, seen=seen,
            expired_robots=_turned(self.expired_robots, number))


@dataclass(frozen=True)
class BuilderState:
    """
    The state of a graph builder, from which another one continues.

    graph : the factors; stamps (n,) [ns] and odometry (n, p) of the keyframes; ends : of the
    odometry of each robot, by their numbers; loops : those that have come
    """

    graph: FactorGraph
    stamps: Indices
    odometry: Array
    ends: tuple[TrackEnd, ...]
    loops: LoopsState

    @staticmethod
    def of_graph(graph: FactorGraph, poses: Array, stamps: Indices) -> 'BuilderState':
        """Return that of a graph alone, whose odometry went from pose to pose (n, p)."""
        d = graph.manifold.TANGENT_SIZE
        end = TrackEnd(0, graph.manifold.identity(1), int(stamps[-1]), poses[-1:],
                       np.zeros((d, d)))
        return BuilderState(graph, stamps, poses, (end,), LoopsState.of_graph(graph, stamps))

    def renumbered(self, number: Callable[[int], int]) -> 'BuilderState':
        """Return the state where robots have other numbers."""
        graph = self.graph.copy()
        give_to(graph, _turned(graph.robot, number))
        ends = sorted((replace(end, robot=number(end.robot)) for end in self.ends),
                      key=lambda end: end.robot)
        return replace(self, graph=graph, ends=tuple(ends), loops=self.loops.renumbered(number))


def _turned(robots: Indices, number: Callable[[int], int]) -> Indices:
    return np.array([number(one) for one in robots.ravel().tolist()], np.int64).reshape(
        robots.shape)
