# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The back end at one moment: a cheap copy that is read while the back end goes on.

In: references to arrays that are not written to again. Out: values computed from them, above all
the problem of the next update.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from l1slam_ros.core.bordered.front import View
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.parts import ends_before
from l1slam_ros.core.online.builder_state import BuilderState
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.running.map_state import MapState
from l1slam_ros.core.running.optimised import Optimised
from l1slam_ros.core.running.problem import Problem
from l1slam_ros.core.running.robot_maps import RobotMap, pairs_of, robot_maps
from l1slam_ros.core.solvers.block_cholesky import Pattern

# The states of a loop; `LoopStates.state` holds indices of this tuple.
LOOP_STATES = ('waiting', 'suspect', 'accepted', 'rejected', 'expired')
WAITING, SUSPECT, ACCEPTED, REJECTED, EXPIRED = range(len(LOOP_STATES))


@dataclass(frozen=True)
class LoopStates:
    """
    The states of all loops.

    rows : (k,) the between factors of the first k of them; stamps : (l, 2) [ns] reference and end;
    state : (l,) of `LOOP_STATES`; sigmas : (l,), NaN where a loop was not looked at; robots :
    (l, 2) whose times the stamps are.
    """

    rows: Indices
    stamps: Indices
    state: Indices
    sigmas: Array
    robots: Indices


@dataclass(frozen=True)
class SavedMap:
    """
    The map of a back end and its graph, from which another back end continues.

    judgement : of all factors; robust : loops were doubted; graph_began : names the graph in its
    back end, see `Revisions`; robots : their names by their numbers, as far as they have any
    """

    builder: BuilderState
    optimised: Optimised
    judgement: Judgement
    robust: bool
    graph_began: int = 0
    robots: tuple[str, ...] = ()


@dataclass(frozen=True)
class Robot:
    """
    Where a robot is: stamp [ns] and pose (1, p) of its odometry, and map -> odom (1, p).

    joined : the map is that of the first robot, else one of its own
    """

    stamp: int
    odometry: Array
    map_to_odom: Array
    joined: bool = True


class Counts(NamedTuple):
    """
    How large a graph is, what was noted of messages, and what the last judgement says of the map.

    sizes : keyframes, factors and loops of each state, by name; refused : cause -> how many loops
    were; told : how often the odometry did not go on as robots move, see `Notes.told`; verdict :
    a judgement without its columns; stamps : (n,) [ns] of the keyframes that its doubts name
    """

    sizes: dict[str, int]
    refused: dict[str, int]
    told: dict[str, int]
    verdict: Judgement
    stamps: Indices


@dataclass(frozen=True)
class Behind:
    """
    The state of the background work.

    age : [s] of the map that was factored, NaN: there is none; rows : of loops that came since;
    loops : not judged yet; bound : a lower bound on the L1 cost of all maps of the accepted
    factors near this one, and its age [s], NaN: nothing was proved of them; failing : the last
    work failed, told or not; at_rest : nothing is left to do, and loops are judged as by a batch.
    """

    age: float
    rows: int
    loops: int
    bound: float
    bound_age: float
    failing: bool
    at_rest: bool

    @staticmethod
    def of(state: MapState, loops: int, now: float, failing: bool, at_rest: bool) -> 'Behind':
        """Return how far the work is behind a state, with `loops` loops in the graph."""
        carried = state.carried
        holds = state.table.is_proof_of_accepted
        waiting = 0 if state.all_judged(loops) else loops - max(state.judged.loops, 0)
        return Behind(
            now - state.made if carried else np.nan, carried.border if carried else 0, waiting,
            state.bound if holds else np.nan, now - state.bound_at if holds else np.nan, failing,
            at_rest)


@dataclass(frozen=True)
class Snapshot:
    """
    A back end at one moment.

    state : of its map; graph : the factors so far; stamps (n,) [ns] and odometry (n, p) of the
    keyframes; map_to_odom : (1, p) of the first robot; loop_rows, loop_stamps, loop_robots : see
    `LoopFactors`; views : the L1 and L2 map of the front, where there is one; pattern : see
    `Problem`.
    """

    state: MapState
    graph: FactorGraph
    stamps: Indices
    odometry: Array
    map_to_odom: Array
    loop_rows: Indices
    loop_stamps: tuple[Indices, Indices, Indices]
    loop_robots: tuple[Indices, Indices, Indices]
    views: tuple[View, ...]
    pattern: Pattern | None

    @property
    def map(self) -> int:
        """The number of the map, see `Improvement`."""
        return self.state.began

    @cached_property
    def poses(self) -> Array:
        """
        Return all keyframes in the frame of the graph, (n, p).

        The optimised ones, then odometry from there.
        """
        return self._followed(
            self.views[0].poses if self.views else self.state.optimised.poses, self.odometry)

    @cached_property
    def robot_maps(self) -> dict[int, RobotMap]:
        """The map that each robot is in, by its number."""
        graph = self.graph
        _, firsts = np.unique(self.graph.robot, return_index=True)
        pairs = pairs_of(graph.robot, graph.between, self.judgement.accepted)
        return robot_maps(graph.manifold, graph.robot, firsts, pairs,
                          lambda keyframes: self.odometry[keyframes],
                          lambda keyframes: self.poses[keyframes])

    def poses_in_map(self, robot: int) -> tuple[Indices, Array]:
        """Return the keyframes of a robot, (k,), and where they are in its map, (k, p)."""
        keyframes = np.flatnonzero(self.graph.robot == robot)
        poses = self.poses[keyframes]
        turn = self.robot_maps.get(robot, RobotMap(True, None)).turn
        return keyframes, poses if turn is None else self.graph.manifold.compose(turn, poses)

    @property
    def drawn(self) -> Array:
        """All keyframes as seen from the map of the first robot, (n, p), joined to it or not."""
        first = self.robot_maps.get(0)
        if first is None or first.turn is None or not first.joined:
            return self.poses
        return self.graph.manifold.compose(first.turn, self.poses)

    def _followed(self, poses: Array, others: Array) -> Array:
        """
        Return poses (k, p), and behind them the other keyframes as they follow in others (n, p).

        Each follows the last of its predecessors that is known; the first of a part the end of
        the one of its robot before, or of none of its robot the last keyframe that is known.
        """
        manifold = self.graph.manifold
        known = len(poses)
        if not known or known == len(others):
            return np.concatenate((poses, others[known:]))
        before, firsts = self.graph.parent, self.graph.firsts
        ends = ends_before(self.graph)
        before[firsts] = np.where(
            self.graph.robot[ends] == self.graph.robot[firsts], ends, known - 1)
        while (before[known:] >= known).any():
            before = np.where(before >= known, before[before], before)
        before = before[known:]
        way = manifold.between(others[before], others[known:])
        return np.concatenate((poses, manifold.compose(poses[before], way)))

    @cached_property
    def judgement(self) -> Judgement:
        """The judgement of all factors that the map uses."""
        return self._of_all(self.state.table.judgement(self.state.of_all))

    def _of_all(self, judged: Judgement) -> Judgement:
        """Return a judgement of the first factors, extended by the front's gate for the others."""
        state = self.state
        known = state.table.behind(judged)
        all_judged = state.all_judged(len(self.loop_rows)) and state.pending is None
        settled = not state.robust or (judged.settled and all_judged)
        return replace(known, settled=settled).extended(self.graph, state.robust)

    @property
    def looked(self) -> int:
        """From which factor on the next front gates them; with no front the judge does."""
        state = self.state
        if state.pending is not None:
            return len(state.pending.accepted)
        return state.table.looked if self.views else len(self.graph.between)

    def problem(self) -> Problem:
        """Return the problem of an update: the graph, with a warm start for all of it."""
        state = self.state
        last = self.state.optimised
        rows = len(self.graph.between) * self.graph.manifold.TANGENT_SIZE
        # Rows are only ever appended, so the dual of the old ones stays; new ones start at zero.
        dual = np.concatenate((last.dual, np.zeros(rows - len(last.dual))))
        starts = [self.poses]
        starts += [self._followed(view.poses, self.poses) for view in self.views[1:]]
        if state.judged.poses is not None and state.is_stale:
            # After a loop has closed, the L2 map of the judgement is nearer.
            starts.append(self._followed(state.judged.poses, self.poses))
        judgement = self.judgement if state.pending is None else self._of_all(state.pending)
        return Problem(state.began, self.graph, starts, dual, judgement, state.robust,
                       last.cost * rows / max(len(last.dual), 1),
                       self._followed(last.poses, self.odometry), pattern=self.pattern)

    def optimised(self) -> Optimised:
        """Return the last solution, extended to all present keyframes and factors."""
        problem = self.problem()
        last = self.state.optimised
        same = len(last.poses) == len(problem.poses) and len(last.dual) == len(problem.dual)
        grown = replace(last, poses=problem.poses, dual=problem.dual)
        return grown if same else replace(grown.unfinished(), quiet_updates=0)

    def loop_states(self) -> LoopStates:
        """Return what has become of each loop, those of the graph first, in its order."""
        in_graph, waiting, expired = self.loop_stamps
        judgement, rows = self.judgement, self.loop_rows
        state = np.where(judgement.accepted[rows], ACCEPTED,
                         np.where(judgement.suspect[rows], SUSPECT, REJECTED))
        others = np.repeat([WAITING, EXPIRED], [len(waiting), len(expired)])
        sigmas = np.concatenate((judgement.sigmas[rows], np.full(len(others), np.nan)))
        return LoopStates(rows, np.concatenate((in_graph, waiting, expired)),
                          np.concatenate((state, others)), sigmas,
                          np.concatenate(self.loop_robots))

    def sizes(self) -> dict[str, int]:
        """Return the numbers of keyframes, factors and loops of each state, by name."""
        loops = np.bincount(self.loop_states().state, minlength=len(LOOP_STATES))
        return {'keyframes': self.graph.n_poses, 'factors': len(self.graph.between)} | {
            f'{name}_loops': int(count) for name, count in zip(LOOP_STATES, loops, strict=True)}
