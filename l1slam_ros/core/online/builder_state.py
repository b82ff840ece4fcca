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
class BuilderState:
    """
    The state of a graph builder, from which another one continues.

    graph : the factors; stamps (n,) [ns] and odometry (n, p) of the keyframes; offset, end,
    end_pose, end_covariance : of the first robot, see `TrackEnd`; loop_rows (k,),
    loop_stamps (k, 2) and expired (l, 2) [ns] : see `GraphBuilder`; waiting : loops, and how long
    each has waited [ns]; seen : of each loop that came, by its identity, its factor, -1 for none;
    struck_pairs (s, 2) : the keyframes between which loops are struck out, those to come too;
    robot : the number of the first robot; others : the ends of the other ones; loop_robots (k, 2),
    expired_robots (l, 2) : whose times the stamps of loops are, none: those of the first robot.
    """

    graph: FactorGraph
    stamps: Indices
    odometry: Array
    offset: Array
    end: int
    end_pose: Array
    end_covariance: Array
    loop_rows: Indices
    loop_stamps: Indices
    expired: Indices
    waiting: tuple[tuple[LoopClosure, int], ...]
    seen: Mapping[bytes, int]
    struck_pairs: Indices
    robot: int = 0
    others: tuple[TrackEnd, ...] = ()
    loop_robots: Indices | None = None
    expired_robots: Indices | None = None

    @property
    def ends(self) -> tuple[TrackEnd, ...]:
        """Where the odometry of each robot has come to."""
        return TrackEnd(self.robot, self.offset, self.end, self.end_pose,
                        self.end_covariance), *self.others

    def renumbered(self, number: Callable[[int], int]) -> 'BuilderState':
        """Return the state where robots have other numbers."""
        def turned(robots: Indices) -> Indices:
            return np.array([number(one) for one in robots.ravel().tolist()], np.int64).reshape(
                robots.shape)

        graph = self.graph.copy()
        give_to(graph, turned(graph.robot))
        first, *others = sorted((replace(end, robot=number(end.robot)) for end in self.ends),
                                key=lambda end: end.robot)
        loops, expired = (
            turned(np.full((k, 2), self.robot) if robots is None else robots) for robots, k in (
                (self.loop_robots, len(self.loop_rows)),
                (self.expired_robots, len(self.expired))))
        waiting = tuple((replace(loop, robot=number(loop.robot),
                                 reference_robot=number(loop.robots[0])), age)
                        for loop, age in self.waiting)
        seen = {}
        for key, row in self.seen.items():
            one, other = np.frombuffer(key[_IDENTITY:], np.int64).tolist() or (0, 0)
            seen[key_of(key[:_IDENTITY], (number(one), number(other)))] = row
        return replace(
            self, graph=graph, robot=first.robot, offset=first.offset, end=first.end,
            end_pose=first.end_pose, end_covariance=first.end_covariance, others=tuple(others),
            loop_robots=loops, expired_robots=expired, waiting=waiting, seen=seen)

    @staticmethod
    def of_graph(graph: FactorGraph, poses: Array, stamps: Indices) -> 'BuilderState':
        """Return that of a graph alone, whose odometry went from pose to pose (n, p)."""
        d = graph.manifold.TANGENT_SIZE
        none = np.zeros((0, 2), np.int64)
        loops = np.flatnonzero(~graph.between.is_odometry)
        ends = np.sort(stamps[graph.between.pairs[loops]], axis=1)
        struck = np.sort(graph.between.pairs[graph.between.struck], axis=1)
        return BuilderState(graph, stamps, poses, graph.manifold.identity(1), int(stamps[-1]),
                      poses[-1:], np.zeros((d, d)), loops, ends, none, (), {}, struck)
