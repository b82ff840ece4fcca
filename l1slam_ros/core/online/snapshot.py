# SPDX-License-Identifier: Apache-2.0
"""
The back end at one moment: taken in a moment, and read at leisure while the back end goes on.

In: references to arrays that are never written to again. Out: what is worked out of them, the
problem of the next update first of all.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.online.loop_states import (
    ACCEPTED,
    EXPIRED,
    LOOP_STATES,
    REJECTED,
    SUSPECT,
    WAITING,
    LoopStates,
)
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.solvers.optimality import Status

# A large map gets but one linearisation into an update, and never meets a test that takes two of
# them. It is at rest when so many updates in a row lowered the cost by less than is looked for.
_QUIET_UPDATES = 5


@dataclass(frozen=True)
class Problem:
    """
    A snapshot to improve: graph, poses (n, p), dual (rows,) and the cost the last update left.

    map : number of the map that it is of, other after `Backend.reset` and `Backend.restore`;
    gaps : (g,) keyframes that no odometry joins to the ones before; judgement : of all factors;
    robust : loops may be doubted; settled : nothing has come since an update that converged.
    """

    map: int
    graph: FactorGraph
    gaps: Indices
    poses: Array
    dual: Array
    judgement: Judgement
    robust: bool
    last_cost: float
    settled: bool


@dataclass(frozen=True)
class Growth:
    """
    What a graph builder has made of messages, for another to go on from.

    graph : the factors; stamps (n,) [ns] and odometry (n, p) of the keyframes; offset : see
    `GraphBuilder`; end : stamp [ns] of the last sample, end_pose (1, p) and end_covariance (d, d)
    of the motion to it from the last keyframe; loop_rows (k,), loop_stamps (k, 2) and expired
    (l, 2) [ns] : see `GraphBuilder`; waiting : loops, and how long each has waited [ns]; seen : of
    each loop that came, by its identity, its factor, -1 for none.
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

    @staticmethod
    def of_graph(graph: FactorGraph, poses: Array, stamps: Indices) -> 'Growth':
        """Return that of a graph alone, whose odometry went from pose to pose (n, p)."""
        d, none = graph.manifold.TANGENT_SIZE, np.zeros((0, 2), np.int64)
        loops = np.flatnonzero(~graph.between.is_odometry)
        ends = np.sort(stamps[graph.between.pairs[loops]], axis=1)
        return Growth(graph, stamps, poses, graph.manifold.identity(1), int(stamps[-1]),
                      poses[-1:], np.zeros((d, d)), loops, ends, none, (), {})


@dataclass(frozen=True)
class Optimised:
    """
    What updates have made so far, of the first keyframes and factors.

    poses : (k, p); dual : (rows,); judgement, cost and status : as the last update left them;
    quiet_updates : how many in a row hardly lowered the cost.
    """

    poses: Array
    dual: Array
    judgement: Judgement
    cost: float
    status: Status
    quiet_updates: int

    @staticmethod
    def nothing(poses: Array) -> 'Optimised':
        """Return what stands before the first update: poses at most."""
        return Optimised(poses, np.zeros(0), Judgement.nothing(), 0.0, Status.OUT_OF_TIME, 0)

    @property
    def at_rest(self) -> bool:
        """Whether more updates of the same factors would hardly change the map."""
        return (self.status in (Status.CONVERGED, Status.STALLED)
                or self.quiet_updates >= _QUIET_UPDATES)

    def unjudged(self) -> 'Optimised':
        """Return the same where nothing is known of any loop."""
        return replace(self, judgement=Judgement.nothing(), status=Status.OUT_OF_TIME)

    def of_all(self, problem: Problem) -> 'Optimised':
        """Return the same of all keyframes and factors that a problem has."""
        if len(self.poses) == len(problem.poses) and len(self.dual) == len(problem.dual):
            return self
        return replace(self, poses=problem.poses, dual=problem.dual, judgement=problem.judgement,
                       status=Status.OUT_OF_TIME, quiet_updates=0)


@dataclass(frozen=True)
class SavedMap:
    """All that another back end goes on from; robust : loops were doubted."""

    growth: Growth
    optimised: Optimised
    robust: bool

    def as_judged(self, robust: bool) -> Optimised:
        """Return what updates have made, unjudged where loops were judged otherwise."""
        return self.optimised if self.robust == robust else self.optimised.unjudged()


@dataclass(frozen=True)
class Robot:
    """Where the robot is: stamp [ns] and pose (1, p) of its odometry, and map -> odom (1, p)."""

    stamp: int
    odometry: Array
    map_to_odom: Array


@dataclass(frozen=True)
class Snapshot:
    """
    What a back end knows.

    map : its number; version : see `Backend.version`; graph : the factors so far; gaps : as in
    `Problem`; stamps (n,) [ns] and odometry (n, p) of the keyframes; map_to_odom : (1, p);
    loop_rows, loop_stamps : see `GraphBuilder`; robust : loops may be doubted.
    """

    map: int
    version: tuple[int, int, int]
    graph: FactorGraph
    gaps: Indices
    stamps: Indices
    odometry: Array
    map_to_odom: Array
    loop_rows: Indices
    loop_stamps: tuple[Indices, Indices, Indices]
    optimised: Optimised
    robust: bool

    @property
    def poses(self) -> Array:
        """All keyframes in the map frame, (n, p): the optimised ones, then odometry from there."""
        optimised, manifold = self.optimised.poses, self.graph.manifold
        known = len(optimised)
        new = self.odometry[known:]
        if known and len(new):
            start = np.broadcast_to(self.odometry[known - 1], new.shape)
            last = np.broadcast_to(optimised[-1], new.shape)
            new = manifold.compose(last, manifold.between(start, new))
        return np.concatenate((optimised, new))

    def problem(self) -> Problem:
        """Return what an update begins with: the graph, and the warm start for all of it."""
        last, rows = self.optimised, len(self.graph.between) * self.graph.manifold.TANGENT_SIZE
        # Rows are only ever appended, so the dual of the old ones stays; new ones start at zero.
        dual = np.concatenate((last.dual, np.zeros(rows - len(last.dual))))
        judgement = last.judgement.extended(self.graph, self.robust)
        grown = len(last.poses) < self.graph.n_poses or len(last.dual) < rows
        told = grown or not np.array_equal(judgement.accepted, last.judgement.accepted)
        settled = not told and judgement.settled and last.at_rest
        return Problem(self.map, self.graph, self.gaps, self.poses, dual, judgement, self.robust,
                       last.cost, settled)

    def loop_states(self) -> LoopStates:
        """Return what has become of each loop, those of the graph first, in its order."""
        in_graph, waiting, expired = self.loop_stamps
        judgement = self.optimised.judgement.extended(self.graph, self.robust)
        rows = self.loop_rows
        state = np.where(judgement.accepted[rows], ACCEPTED,
                         np.where(judgement.suspect[rows], SUSPECT, REJECTED))
        others = np.repeat([WAITING, EXPIRED], [len(waiting), len(expired)])
        sigmas = np.concatenate((judgement.sigmas[rows], np.full(len(others), np.nan)))
        return LoopStates(rows, np.concatenate((in_graph, waiting, expired)),
                          np.concatenate((state, others)), sigmas)

    def sizes(self) -> dict[str, int]:
        """Return how many keyframes, factors and loops of each state there are, by name."""
        loops = np.bincount(self.loop_states().state, minlength=len(LOOP_STATES))
        return {'keyframes': self.graph.n_poses, 'factors': len(self.graph.between)} | {
            f'{name}_loops': int(count) for name, count in zip(LOOP_STATES, loops, strict=True)}
