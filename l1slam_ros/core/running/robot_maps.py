# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The map that each robot is in: the map of the first robot, or still a map of its own.

In: a graph, its accepted factors, and its poses. Out: for each robot, whether an accepted factor
joins it to the first one, and the transform of its keyframes to the map in which it is published.
The graph has one frame for all robots; the place of an unjoined robot in it is a guess. The map of
such a robot begins where its odometry begins, as does the map of a single robot.

Parts of one robot, from before and after a gap, count as joined. If absolute poses are accepted,
the map of the first robot is that of the world, and a robot that is not tied to the world, even
the first one, has a map of its own.
"""

from bisect import bisect_left
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from l1slam_ros.core.bordered.front import Front
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import WORLD, BetweenFactors, lowest_of_components
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.running.factor_table import FactorTable
from l1slam_ros.core.running.map_to_odom import Newest


class RobotMap(NamedTuple):
    """
    The map that a robot is in.

    joined : it is that of the first robot; turn : (1, p) from the frame of the graph to that of
    the map, None: they are one
    """

    joined: bool
    turn: Array | None


def robot_maps(manifold: Manifold, robot: Indices, firsts: Indices, pairs: Indices,
               odometry: Callable[[Indices], Array],
               pose: Callable[[Indices], Array]) -> dict[int, RobotMap]:
    """
    Return the map that each robot is in, by its number.

    Parameters
    ----------
    robot : (n,) of each keyframe
    firsts : (r,) the first keyframe of each robot, by the numbers of these
    pairs : (k, 2) the robots that factors join, see `pairs_of`
    odometry, pose : return of some keyframes their odometry, and where they are, (k, p) each

    """
    numbers = robot[firsts]
    if len(numbers) < 2:
        return {number: RobotMap(True, None) for number in numbers.tolist()}
    joined, root = _joined(numbers, pairs)
    # The frame of the graph is that of the world, or of its first keyframe.
    root = None if root is None or firsts[root] == 0 else root
    if root is None and joined.all():
        return {number: RobotMap(True, None) for number in numbers.tolist()}
    turns = manifold.compose(odometry(firsts), manifold.inverse(pose(firsts)))
    of_root = None if root is None else turns[root:root + 1]
    return {number: RobotMap(joins, of_root if joins else turns[row:row + 1])
            for row, (number, joins) in enumerate(zip(
                numbers.tolist(), joined.tolist(), strict=True))}


class Seen(NamedTuple):
    """
    The graph at one moment, which can be read without a lock.

    factors : of it; robot : (n,) of each keyframe; numbers : of each robot the keyframes, (k,);
    firsts : (1, p) the odometry of their first ones, by robot, where there are several
    """

    manifold: Manifold
    factors: BetweenFactors
    robot: Indices
    numbers: dict[int, Indices]
    firsts: dict[int, Array]

    @staticmethod
    def of(builder: GraphBuilder) -> 'Seen':
        """Return a copy of the graph of a builder."""
        tracks = {robot: one.track for robot, one in builder.robots.items() if len(one.track)}
        firsts = {robot: track.poses_of(slice(0, 1)) for robot, track in tracks.items()
                  } if len(tracks) > 1 else {}
        return Seen(builder.graph.manifold, builder.graph.between, builder.graph.robot,
                    {robot: track.numbers.view() for robot, track in tracks.items()}, firsts)

    def pairs(self, accepted: Mask, known: int) -> Indices:
        """Return the robots that accepted factors of the first keyframes join, see `pairs_of`."""
        if len(self.numbers) < 2:
            return np.zeros((0, 2), np.int64)
        i, j = self.factors.i[:len(accepted)], self.factors.j[:len(accepted)]
        return pairs_of(self.robot, self.factors, accepted & (i < known) & (j < known))

    def maps(self, known: int, pairs: Indices,
             pose: Callable[[Indices], Array]) -> dict[int, RobotMap]:
        """Return the maps of robots by the first keyframes, see `robot_maps`."""
        if len(self.numbers) < 2:
            return {}

        def odometry(keyframes: Indices) -> Array:
            return np.concatenate([self.firsts[robot] for robot in self.robot[keyframes].tolist()])

        firsts = np.array([numbers[0] for _, numbers in sorted(self.numbers.items())])
        return robot_maps(self.manifold, self.robot, firsts[firsts < known], pairs, odometry, pose)


class Joins:
    """
    The robots that the accepted factors of a front join.

    Every update asks, of thousands of factors: while the table of factors only grows, none is
    looked at twice.
    """

    def __init__(self) -> None:
        self._table: FactorTable | None = None
        self._rows = 0
        self._pairs: set[tuple[int, int]] = set()

    def ends(self, seen: Seen, table: FactorTable, poses: Array,
             front: Front | None) -> dict[int, Newest]:
        """Return the last keyframe of each robot in a front, or a map, see `map_ends`."""
        if front is None or len(seen.numbers) < 2:
            return map_ends(seen, poses, front, table.accepted)
        # It knows the keyframes of all factors that it has looked at.
        accepted = table.accepted[:front.rows]
        if self._table is None or not table.continues(self._table):
            self._rows, self._pairs = 0, set()
        new = pairs_of(seen.robot, seen.factors, accepted[self._rows:], self._rows)
        self._pairs.update(map(tuple, new.tolist()))
        self._table, self._rows = table, max(self._rows, len(accepted))
        return _ends(seen, front.keyframes, front.poses_of,
                     np.array(sorted(self._pairs), np.int64).reshape(-1, 2))


def map_ends(seen: Seen, poses: Array, front: Front | None, accepted: Mask) -> dict[int, Newest]:
    """
    Return the last keyframe of each robot in a map, poses (n, p), or in its front if it has one.

    accepted : which of the first factors are
    """
    known = front.keyframes if front else len(poses)
    return _ends(seen, known, front.poses_of if front else poses.__getitem__,
                 seen.pairs(accepted, known))


def _ends(seen: Seen, known: int, pose: Callable[[Indices], Array],
          pairs: Indices) -> dict[int, Newest]:
    """Return them of the first keyframes; pairs : (k, 2) the robots that their factors join."""
    maps = seen.maps(known, pairs, pose)
    lasts = {robot: last for robot, numbers in seen.numbers.items()
             if (last := bisect_left(numbers, known) - 1) >= 0}
    if not lasts:
        return {}
    newest = pose(np.array([seen.numbers[robot][last] for robot, last in lasts.items()]))
    ends = {}
    for row, (robot, last) in enumerate(lasts.items()):
        joined, turn = maps.get(robot, RobotMap(True, None))
        at = newest[row:row + 1]
        ends[robot] = Newest(
            last, at if turn is None else seen.manifold.compose(turn, at), joined)
    return ends


def pairs_of(robot: Indices, factors: BetweenFactors, accepted: Mask, begin: int = 0) -> Indices:
    """
    Return the robots that accepted factors join, (k, 2), each pair once; `WORLD` is the world.

    robot : (n,) of each keyframe; accepted : which of the factors from row `begin` on are
    """
    rows = begin + np.flatnonzero(accepted)
    i, j = factors.i[rows], factors.j[rows]
    one, other = np.where(i == WORLD, WORLD, robot[i]), robot[j]
    apart = one != other
    span = int(other.max(initial=0)) + 1
    pair = np.unique((one[apart] - WORLD) * span + other[apart])
    one, other = np.divmod(pair, span)
    return np.stack((one + WORLD, other), axis=1)


def _joined(numbers: Indices, pairs: Indices) -> tuple[Mask, int | None]:
    """Return which robots are joined to the first one, (r,), or the world: then None, else it."""
    r, of_world = len(numbers), pairs == WORLD
    # The world comes after the robots.
    one, other = np.where(of_world, r, np.searchsorted(numbers, pairs)).T
    component = lowest_of_components(one, other, r + 1)
    if of_world.any():
        return component[:-1] == component[-1], None
    return component[:-1] == component[0], 0
