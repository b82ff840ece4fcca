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

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from l1slam_ros.core.bordered.front import Front
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import BetweenFactors, lowest_of_components
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.running.map_to_odom import Newest


class RobotMap(NamedTuple):
    """
    The map that a robot is in.

    joined : it is that of the first robot; turn : (1, p) from the frame of the graph to that of
    the map, None: they are one
    """

    joined: bool
    turn: Array | None


def robot_maps(manifold: Manifold, robot: Indices, firsts: Indices, factors: BetweenFactors,
               accepted: Mask, odometry: Callable[[Indices], Array],
               pose: Callable[[Indices], Array]) -> dict[int, RobotMap]:
    """
    Return the map that each robot is in, by its number.

    Parameters
    ----------
    robot : (n,) of each keyframe
    firsts : (r,) the first keyframe of each robot, by the numbers of these
    factors, accepted : and which of the first ones are, (m,) bool
    odometry, pose : return of some keyframes their odometry, and where they are, (k, p) each

    """
    numbers = robot[firsts]
    if len(numbers) < 2:
        return {number: RobotMap(True, None) for number in numbers.tolist()}
    joined, root = _joined(robot, numbers, factors, accepted)
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
    firsts : (r, p) the odometry of their first ones, by robot
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
        firsts = {robot: track.poses_of(slice(0, 1)) for robot, track in tracks.items()}
        return Seen(builder.graph.manifold, builder.graph.between, builder.graph.robot,
                    {robot: track.numbers.view() for robot, track in tracks.items()}, firsts)

    def maps(self, known: int, accepted: Mask,
             pose: Callable[[Indices], Array]) -> dict[int, RobotMap]:
        """Return the maps of robots by the first keyframes, see `robot_maps`."""
        if len(self.numbers) < 2:
            return {}
        factors, m = self.factors, len(accepted)
        inside = (factors.i[:m] < known) & (factors.j[:m] < known)

        def odometry(keyframes: Indices) -> Array:
            return np.concatenate([self.firsts[robot] for robot in self.robot[keyframes].tolist()])

        firsts = np.array([numbers[0] for _, numbers in sorted(self.numbers.items())])
        return robot_maps(self.manifold, self.robot, firsts[firsts < known], factors,
                          accepted[:len(inside)] & inside, odometry, pose)


def map_ends(seen: Seen, poses: Array, front: Front | None, accepted: Mask) -> dict[int, Newest]:
    """
    Return the last keyframe of each robot in a map, poses (n, p), or in its front if it has one.

    accepted : which of the first factors are
    """
    known = front.keyframes if front else len(poses)
    pose = front.poses_of if front else poses.__getitem__
    maps = seen.maps(known, accepted, pose)
    lasts = {robot: last for robot, numbers in seen.numbers.items()
             if (last := int(np.searchsorted(numbers, known)) - 1) >= 0}
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


def _joined(robot: Indices, numbers: Indices, factors: BetweenFactors,
            accepted: Mask) -> tuple[Mask, int | None]:
    """Return which robots are joined to the first one, (r,), or the world: then None, else it."""
    r, count = len(numbers), len(accepted)
    # The world comes after the robots, and after their keyframes: -1 picks it.
    place = np.append(np.searchsorted(numbers, robot), r)
    # Every update asks, of thousands of factors: small numbers take less time. What is not
    # accepted is counted as a loop of the first robot with itself, which joins nothing.
    place = place.astype(np.min_scalar_type((r + 1) ** 2))
    pair = (place[factors.i[:count]] * (r + 1) + place[factors.j[:count]]) * accepted
    one, other = np.divmod(np.flatnonzero(np.bincount(pair, minlength=1)), r + 1)
    component = lowest_of_components(one, other, r + 1)
    if (one == r).any():
        return component[:-1] == component[-1], None
    return component[:-1] == component[0], 0
