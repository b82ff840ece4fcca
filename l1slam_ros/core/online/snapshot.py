# SPDX-License-Identifier: Apache-2.0
"""
The back end at one moment: taken in a moment, and read at leisure while the back end goes on.

In: references to arrays that are never written to again. Out: what is worked out of them, the
problem of the next update first of all.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from l1slam_ros.core.bordered.front import View
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.solvers.block_cholesky import Pattern
from l1slam_ros.core.solvers.optimality import Status
from l1slam_ros.core.solvers.solve import AUTO, PRIMAL_DUAL, Method, choose

# A large map gets but one linearisation into an update, and never meets a test that takes two of
# them. It is at rest when so many updates in a row lowered the cost by less than is looked for.
_QUIET_UPDATES = 5
# What can become of a loop; `LoopStates.state` counts in this order.
LOOP_STATES = ('waiting', 'suspect', 'accepted', 'rejected', 'expired')
WAITING, SUSPECT, ACCEPTED, REJECTED, EXPIRED = range(len(LOOP_STATES))


@dataclass(frozen=True)
class LoopStates:
    """
    What has become of the loops.

    rows : (k,) the between factors of the first k of them; stamps : (l, 2) [ns] reference and end;
    state : (l,) of `LOOP_STATES`; sigmas : (l,), NaN where a loop was not looked at.
    """

    rows: Indices
    stamps: Indices
    state: Indices
    sigmas: Array


@dataclass(frozen=True)
class Problem:
    """
    A snapshot to improve: graph, poses (n, p), dual (rows,).

    map : number of the map that it is of, other after `Backend.reset` and `Backend.restore`;
    last_cost : the cost that the last update left, for as many factors as there are now; gaps :
    (g,) keyframes that no odometry joins to the ones before; starts : poses to start from, `poses`
    the first; judgement : of all factors; robust : loops may be doubted; settled : nothing has
    come since an update that converged; pattern : of the last factor, None: there was none.
    """

    map: int
    graph: FactorGraph
    gaps: Indices
    starts: list[Array]
    dual: Array
    judgement: Judgement
    robust: bool
    last_cost: float
    settled: bool
    pattern: Pattern | None = None

    @property
    def poses(self) -> Array:
        """Where the keyframes are, (n, p)."""
        return self.starts[0]

    @cached_property
    def part(self) -> FactorGraph:
        """The factors that are believed."""
        return self.judgement.believed(self.graph)

    @cached_property
    def method(self) -> Method:
        """What to solve them by."""
        return choose(AUTO, self.part, before=self.pattern)

    @property
    def is_sparse(self) -> bool:
        """Whether they are solved by factorisations."""
        return self.method.solver != PRIMAL_DUAL


@dataclass(frozen=True)
class BuilderState:
    """
    What a graph builder has made of messages, for another to go on from.

    graph : the factors; stamps (n,) [ns] and odometry (n, p) of the keyframes; offset : see
    `GraphBuilder`; end : stamp [ns] of the last sample, end_pose (1, p) and end_covariance (d, d)
    of the motion to it from the last keyframe; loop_rows (k,), loop_stamps (k, 2) and expired
    (l, 2) [ns] : see `GraphBuilder`; waiting : loops, and how long each has waited [ns]; seen : of
    each loop that came, by its identity, its factor, -1 for none; struck_pairs (s, 2) : the
    keyframes between which loops are struck out, those to come too.
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

    @staticmethod
    def of_graph(graph: FactorGraph, poses: Array, stamps: Indices) -> 'BuilderState':
        """Return that of a graph alone, whose odometry went from pose to pose (n, p)."""
        d, none = graph.manifold.TANGENT_SIZE, np.zeros((0, 2), np.int64)
        loops = np.flatnonzero(~graph.between.is_odometry)
        ends = np.sort(stamps[graph.between.pairs[loops]], axis=1)
        struck = np.sort(graph.between.pairs[graph.between.struck], axis=1)
        return BuilderState(graph, stamps, poses, graph.manifold.identity(1), int(stamps[-1]),
                      poses[-1:], np.zeros((d, d)), loops, ends, none, (), {}, struck)


@dataclass(frozen=True)
class Optimised:
    """
    What has been made so far, of the first keyframes and factors.

    poses : (k, p); dual : (rows,); cost, status : as the last map left them; judgement : of the
    first factors, made beside the map; quiet_updates : how many in a row hardly lowered the cost.
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


@dataclass(frozen=True)
class SavedMap:
    """
    All that another back end goes on from.

    robust : loops were doubted; number : of the graph in its back end, another whenever the map
    began anew there
    """

    builder: BuilderState
    optimised: Optimised
    robust: bool
    number: int = 0


@dataclass(frozen=True)
class Robot:
    """Where the robot is: stamp [ns] and pose (1, p) of its odometry, and map -> odom (1, p)."""

    stamp: int
    odometry: Array
    map_to_odom: Array


@dataclass(frozen=True)
class Behind:
    """
    What goes on behind updates.

    age : [s] of the map that was factored, NaN: there is none; rows : of loops that came since;
    loops : not judged yet; bound : what no map of the accepted factors that is near this one has
    less L1 cost than, and its age [s], NaN: nothing was proved of them.
    """

    age: float
    rows: int
    loops: int
    bound: float
    bound_age: float


@dataclass(frozen=True)
class Snapshot:
    """
    What a back end knows.

    map : its number; version : see `Backend.version`; graph : the factors so far; gaps : as in
    `Problem`; stamps (n,) [ns] and odometry (n, p) of the keyframes; map_to_odom : (1, p);
    loop_rows, loop_stamps : see `LoopFactors`; robust : loops may be doubted; looks : (k, 3) what
    the front says of the factors after those that are judged: accepted, suspect, sigmas;
    all_judged : no loop is among them; judged : (k, p) the L2 map of the last judgement, None:
    there is none; pending : that judgement, where it waits for a map; stale : the map is not of
    the factors that are accepted, or are to be; views : the L1 and L2 map of the front, where
    there is one; pattern : see `Problem`.
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
    looks: Array
    all_judged: bool
    judged: Array | None
    pending: Judgement | None
    stale: bool
    views: tuple[View, ...]
    pattern: Pattern | None

    @cached_property
    def poses(self) -> Array:
        """All keyframes in the map frame, (n, p): the optimised ones, then odometry from there."""
        return self._followed(self.views[0].poses if self.views else self.optimised.poses,
                              self.odometry)

    def _followed(self, poses: Array, others: Array) -> Array:
        """
        Return poses (k, p), and behind them the other keyframes as they follow in others (n, p).

        Each follows the last of its predecessors that is known, the first of a part the last
        keyframe that is.
        """
        manifold, known = self.graph.manifold, len(poses)
        if not known or known == len(others):
            return np.concatenate((poses, others[known:]))
        before = np.where(self.graph.parent < np.arange(len(others)), self.graph.parent, known - 1)
        while (before[known:] >= known).any():
            before = np.where(before >= known, before[before], before)
        before = before[known:]
        way = manifold.between(others[before], others[known:])
        return np.concatenate((poses, manifold.compose(poses[before], way)))

    @cached_property
    def judgement(self) -> Judgement:
        """What is believed of all factors, as the map has it."""
        return self._of_all(self.optimised.judgement)

    def _of_all(self, judged: Judgement) -> Judgement:
        """Return a judgement of the first factors, with what the front says of the others."""
        new = len(judged.accepted) - len(self.optimised.judgement.accepted)
        accepted, suspect, sigmas = self.looks[new:].T
        looked = replace(
            judged, accepted=np.concatenate((judged.accepted, accepted > 0)),
            suspect=np.concatenate((judged.suspect, suspect > 0)),
            sigmas=np.concatenate((judged.sigmas, sigmas)),
            settled=not self.robust or (judged.settled and self.all_judged))
        return looked.extended(self.graph, self.robust)

    @property
    def looked(self) -> int:
        """How many factors the next front does not look at; without one all are for the judge."""
        if self.pending:
            return len(self.pending.accepted)
        known = len(self.optimised.judgement.accepted) + len(self.looks)
        return known if self.views else len(self.graph.between)

    def problem(self) -> Problem:
        """Return what an update begins with: the graph, and the warm start for all of it."""
        last, rows = self.optimised, len(self.graph.between) * self.graph.manifold.TANGENT_SIZE
        # Rows are only ever appended, so the dual of the old ones stays; new ones start at zero.
        dual = np.concatenate((last.dual, np.zeros(rows - len(last.dual))))
        starts = [self.poses]
        starts += [self._followed(view.poses, self.poses) for view in self.views[1:]]
        if self.judged is not None and self.stale:
            # After a loop has closed, the L2 map of the judgement is nearer.
            starts.append(self._followed(self.judged, self.poses))
        grown = len(last.poses) < self.graph.n_poses or len(last.dual) < rows
        judgement = self._of_all(self.pending) if self.pending else self.judgement
        settled = not (grown or self.stale) and judgement.settled and last.at_rest
        return Problem(self.map, self.graph, self.gaps, starts, dual, judgement, self.robust,
                       last.cost * rows / max(len(last.dual), 1), settled, self.pattern)

    def known(self) -> Optimised:
        """Return what was made, of all keyframes and factors that there are."""
        problem, last = self.problem(), self.optimised
        same = len(last.poses) == len(problem.poses) and len(last.dual) == len(problem.dual)
        return replace(last, poses=problem.poses, dual=problem.dual, judgement=self.judgement,
                       status=last.status if same else Status.OUT_OF_TIME,
                       quiet_updates=last.quiet_updates if same else 0)

    def loop_states(self) -> LoopStates:
        """Return what has become of each loop, those of the graph first, in its order."""
        in_graph, waiting, expired = self.loop_stamps
        judgement, rows = self.judgement, self.loop_rows
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
