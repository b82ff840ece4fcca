# SPDX-License-Identifier: Apache-2.0
"""
The state of the map of a back end: what was made of its graph, and what is due.

In: the graph as it grows, and what workers have made of snapshots of it. Out: where the newest
keyframe is, what is accepted, and whether map or judgement are due. Its owner holds the locks.
"""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from l1slam_ros.core.bordered.front import GATE, Front, Look
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import BetweenFactors, FactorGraph
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.online.snapshot import Behind, Optimised
from l1slam_ros.core.online.update import Improvement
from l1slam_ros.core.robust.judgement import Doubt, Judgement
from l1slam_ros.core.solvers.optimality import Status

# A map is factored anew from so many factors on that came since, those of five keyframes; on a
# large one, from one for so many keyframes on: what goes on behind costs each keyframe the same,
# however large the map is.
_FEWEST, _KEYFRAMES_EACH = 10, 200
# Factors that a front takes while its lock is held, and between two looks at the clock: on a large
# map a loop takes milliseconds.
_AT_ONCE = 4
# [s] While loops come none of which fits, they are judged so often.
_JUDGE_EVERY = 2.0


class LiveMap:
    """
    The map of a graph.

    Parameters
    ----------
    number : of the map, another for each graph
    builder : of the graph
    optimised : what there is of it
    robust : loops may be doubted

    Attributes
    ----------
    front : takes what has come, None: there is none
    looks : (k, 3) what fronts said of the factors after those that are judged: accepted, suspect,
        sigmas
    judged : (n, p) the L2 map of the judgement, None: there is none
    pending : the last judgement, where the map is not of what it accepts: until it is, map and
        judgement are those before; None: there is none
    stale : the map is not of the factors that are accepted, or are to be
    last : the last improvement, None: there was none
    newest : the last keyframe of the map, and its pose (1, p)
    judge_took : [s] time of the last judgement
    asked : the last map of which it was asked whether it hangs on its norm

    """

    def __init__(self, number: int, builder: GraphBuilder, optimised: Optimised, robust: bool):
        self.number, self.robust, self._builder = number, robust, builder
        self.optimised, self.looks = optimised, GrowingArray((3,))
        self.front: Front | None = None
        self.judged: Array | None = None
        self.asked: Array | None = None
        self.pending: Judgement | None = None
        self.stale = False
        self.last: Improvement | None = None
        self.newest: tuple[int, Array]
        self.judge_took = self._judge_began = self._judge_at = 0.0
        self._heard = builder.graph.said
        self._bound_at = self._factored_at = self._anew_at = self._anew_took = 0.0
        # What the last proof says, and of which factors.
        self._bound, self._proved = np.nan, np.zeros(0, bool)
        # The factors that the map is of and their noise, the loops that were judged, and whether
        # one that the front left may be true.
        self._used, self._noise, self._fits = np.zeros(0, bool), np.zeros(0), False
        known = len(optimised.judgement.accepted)
        self._judged_loops = int(np.count_nonzero(builder.loops.rows < known))
        self._judged_anew = self._judged_loops
        self._doubted_loops = self._judged_loops * optimised.judgement.is_refusal_doubted
        self.note_newest()

    @property
    def all_judged(self) -> bool:
        """Whether no loop waits to be judged."""
        return not self.robust or (self.optimised.judgement.settled
                                   and self._judged_loops == len(self._builder.loops.rows))

    @property
    def all_judged_anew(self) -> bool:
        """
        Whether all loops were judged from the graph alone.

        What was believed when little was known stays as long as it fits: at rest there is time to
        ask whether it would be believed now.
        """
        return self.all_judged and (not self.robust or self._judged_anew == self._judged_loops)

    @property
    def accepted(self) -> Mask:
        """Which of the factors that were looked at are accepted, (m,) bool."""
        return np.concatenate((self.optimised.judgement.accepted, self.looks.view()[:, 0] > 0))

    def hear(self) -> None:
        """Take over what a person said of factors that were looked at before."""
        graph = self._builder.graph
        if graph.said == self._heard:
            return
        factors, before, self._heard = graph.between, self.accepted, graph.said
        count, judgement = len(before), self.optimised.judgement
        after = (before | factors.trusted[:count]) & ~factors.struck[:count]
        if (after == before).all():
            return
        known = len(judgement.accepted)
        self.optimised = replace(self.optimised, judgement=self._told(judgement))
        self._say(np.column_stack((after[known:], self.looks.view()[:, 1:])))
        self._judged_loops, self.stale = -1, True

    def to_accept(self, part: Mask, pending: Judgement | None) -> tuple[BetweenFactors, Indices]:
        """
        Return the factors, and which of them a new front is to accept, as far as one looked.

        part : which of the first ones it begins with, at the others nobody may have looked yet;
        pending : the judgement that it was made for: beside what that accepts a loop may fit that
        did not before, and the front finds out
        """
        factors, known = self._builder.graph.between, self.accepted
        accept = np.append(known, np.full(max(len(part) - len(known), 0), GATE))
        if pending:
            accept[:len(known)][~known] = GATE
        accept[factors.struck[:len(accept)]] = 0
        accept[:len(part)][part] = 0
        return factors, accept

    def take_some(self, factors: BetweenFactors) -> bool:
        """Let the front take a few of the graph's factors; return whether it did."""
        front = self.front
        if front is None or front.closed or front.rows >= len(factors):
            return False
        first, judged = front.rows, self.optimised.judgement.accepted
        rows = np.arange(first, min(first + _AT_ONCE, len(factors)))
        known = len(judged) + len(self.looks)
        accept = np.where(factors.trusted[rows] | (not self.robust), 1, GATE)
        before = rows[rows < known]
        accept[:len(before)] = np.concatenate(
            (judged[first:], self.looks.view()[max(first - len(judged), 0):, 0]))[:len(before)]
        accept[factors.struck[rows]] = 0
        looks = front.take(factors, accept)
        new = np.array([(look.accepted, look.suspect, look.sigmas) for look in looks]).reshape(
            -1, 3)[max(known - first, 0):]
        self.looks.extend(new)
        self._fits |= bool(new[:, 1].any())
        return bool(looks)

    def is_map_due(self, idle: bool) -> bool:
        """Return whether to make the map anew; idle : nothing has come for a while."""
        graph, optimised, front = self._builder.graph, self.optimised, self.front
        rows = len(graph.between) * graph.manifold.TANGENT_SIZE
        behind = (len(optimised.poses) < graph.n_poses or len(optimised.dual) < rows
                  or not optimised.at_rest)
        # The front goes by the noise that was known when it was made.
        other_noise = idle and front is not None and bool(
            (self._noise != optimised.judgement.variance).any())
        return bool(graph.n_poses) and (self.stale or self.falls or other_noise
                                        or (behind and (idle or self.is_late)))

    @property
    def falls(self) -> bool:
        """Whether the last round ended on the way down."""
        return self.last is not None and self.last.falls

    @property
    def is_late(self) -> bool:
        """Whether the front has more to carry than it should."""
        front = self.front
        return front is None or front.closed or front.taken >= max(
            _FEWEST, front.keyframes // _KEYFRAMES_EACH)

    def is_exact_due(self, idle: bool) -> bool:
        """Return whether the next map is to be solved to the end: this one is of all there is."""
        return (idle and self.front is not None and not self.front.taken
                and not self.stale and not self.falls)

    def is_judge_due(self, idle: bool, budget: float) -> bool:
        """Return whether to judge all loops; budget : there is so much time for it now [s]."""
        soon = self._fits or self.front is None
        wait = self.judge_took if soon else max(_JUDGE_EVERY, 2 * self.judge_took)
        if idle:
            return not self.all_judged_anew
        waited = budget > self.judge_took or time.monotonic() > self._judge_at + wait
        return self.is_anew_due(idle) or (waited and not self.all_judged)

    def is_anew_due(self, idle: bool) -> bool:
        """
        Return whether the next judgement is to be from the graph alone.

        At rest what the last one went on from is asked, too; and before, where loops that it
        refused make it doubtful: a lie that came first may keep out true ones. What lays the doubt
        may be lies that agree: it is asked until there are twice as many loops.
        """
        if idle:
            return self.all_judged
        return (len(self._builder.loops.rows) < 2 * self._doubted_loops
                and self._judged_anew != self._judged_loops
                and time.monotonic() > self._anew_at + max(_JUDGE_EVERY, 2 * self._anew_took))

    def is_norm_due(self, idle: bool) -> bool:
        """Return whether to ask if the map hangs on its norm: for now it is the last one."""
        return (self.robust and idle and not self.is_map_due(idle) and self.all_judged_anew
                and self.asked is not self.optimised.poses)

    def take_doubts(self, of: Optimised, doubts: tuple[Doubt, ...]) -> None:
        """Take over the doubts that the norm of a map leaves, if it is still the last one."""
        if self.optimised is of:
            self.asked, doubts = of.poses, tuple(dict.fromkeys(of.judgement.doubts + doubts))
            self.optimised = replace(of, judgement=replace(of.judgement, doubts=doubts))

    def begin_judgement(self) -> int:
        """Expect a judgement of all loops there are; return how many."""
        self._fits, self._judge_began = False, time.monotonic()
        return len(self._builder.loops.rows)

    def take_judgement(self, judgement: Judgement, poses: Array, loops: int,
                       anew: bool) -> None:
        """
        Take over what was found of the first factors, so many loops, and its L2 map.

        What is accepted now that was not, or the other way round, waits for a map of it.

        anew : from the graph alone
        """
        self._judged_loops, self.judged, self.asked = loops, poses, None
        self._doubted_loops = loops if judgement.is_refusal_doubted else self._doubted_loops
        self._judge_at = time.monotonic()
        if anew:
            self._judged_anew, self._anew_at = loops, self._judge_at
            self._anew_took = self._judge_at - self._judge_began
        else:
            self.judge_took = self._judge_at - self._judge_began
        known = self.accepted[:len(judgement.accepted)]
        if self.pending or not np.array_equal(judgement.accepted, known):
            self.pending, self.stale = judgement, True
        else:
            self._commit(judgement)

    def _commit(self, judgement: Judgement) -> None:
        """Take over what was found of the first factors."""
        before = len(self.optimised.judgement.accepted)
        self._say(self.looks.view()[len(judgement.accepted) - before:])
        self.optimised = replace(self.optimised, judgement=self._told(judgement))

    def _told(self, judgement: Judgement) -> Judgement:
        """Return a judgement in which the last word is a person's."""
        factors, known = self._builder.graph.between, len(judgement.accepted)
        accepted = (judgement.accepted | factors.trusted[:known]) & ~factors.struck[:known]
        return replace(judgement, accepted=accepted, suspect=judgement.suspect & ~accepted)

    def adopt(self, improvement: Improvement, front: Front | None, tolerance: float,
              pending: Judgement | None, looks: Sequence[Look]) -> None:
        """
        Take over a map; see `Improvement.taken_over`.

        pending : the judgement that it was made for; looks : of the front at factors after its own

        Raises
        ------
        ArithmeticError : it is not finite; nothing is taken over.

        """
        self.optimised = improvement.taken_over(self.optimised, tolerance)
        if pending:
            self._commit(pending)
            self.pending = None if self.pending is pending else self.pending
        judgement = improvement.judgement
        self._factored_at = time.monotonic()
        if improvement.gap < np.inf:
            self._bound_at, self._proved = self._factored_at, judgement.accepted
            self._bound = improvement.cost - improvement.gap
        self.front, self.last = front, improvement
        self._noise = judgement.variance
        self._hear_front(judgement, looks, pending is not None)
        self._compare()
        self.note_newest()

    def _hear_front(self, made_of: Judgement, looks: Sequence[Look], again: bool) -> None:
        """
        Take over what a new front says of the factors that are not judged.

        looks : at the last it knows, but for what it was made of; again : at what was left, too
        """
        said = np.column_stack((made_of.accepted, made_of.suspect, made_of.sigmas))
        self._used = made_of.accepted.copy()
        if self.front:
            begun, end = self.front.rows - len(looks), self.front.rows
            seen = np.array([(look.accepted, look.suspect, look.sigmas) for look in looks])
            seen, part = seen.reshape(-1, 3), self._used[begun:end]
            seen[:len(part)][part] = said[begun:end][part]
            said = np.concatenate((said[:begun], seen))
            self._used[:end] |= said[:len(self._used), 0].astype(bool)
            self._fits |= any(look.suspect for look in looks)
        before, said = self.looks.view(), said[len(self.optimised.judgement.accepted):]
        kept, now = before[:len(said)], said[:len(before)]
        now[:] = np.where((kept[:, :1] > 0) | (not again), kept, now)
        self._say(np.concatenate((said, before[len(said):])))

    def _say(self, looks: Array) -> None:
        """Take over looks at the factors that are not judged; those before are not written to."""
        self.looks = GrowingArray((3,))
        self.looks.extend(looks)

    def note_newest(self) -> None:
        """Remember the last keyframe of the map, which keyframes to come follow."""
        poses = self.optimised.poses
        self.newest = ((self.front.keyframes - 1, self.front.newest) if self.front
                       else (len(poses) - 1, poses[-1:]))

    def account(self, seconds: float) -> Improvement:
        """Return what the last map says of itself, after an update that took so long."""
        now, last = self.optimised, self.last
        judgement = replace(now.judgement, settled=self.all_judged)
        if last is None:
            return Improvement(self.number, now.poses, now.dual, judgement, 0.0, 0.0,
                               Status.OUT_OF_TIME, 0, 0, 0, np.inf, seconds)
        return replace(last, judgement=judgement, seconds=seconds)

    def behind(self) -> Behind:
        """Return what goes on behind updates. A factor more takes nothing from a bound."""
        now, accepted, front = time.monotonic(), self.accepted, self.front
        proved = self._proved[:len(accepted)]  # at the others nobody has looked since
        holds = not (proved & ~accepted[:len(proved)]).any()
        return Behind(
            now - self._factored_at if front else np.nan, front.border if front else 0,
            0 if self.all_judged else len(self._builder.loops.rows) - max(self._judged_loops, 0),
            self._bound if holds else np.nan, now - self._bound_at if holds else np.nan)

    def size(self) -> tuple[FactorGraph, int, int]:
        """Return what changes when something comes."""
        graph = self._builder.graph
        return graph, graph.n_poses, len(graph.between)

    def _compare(self) -> None:
        """Find out whether the map is of the factors that are accepted."""
        used, accepted = self._used, self.accepted
        both = min(len(used), len(accepted))
        self.stale = self.pending is not None or bool((used[:both] != accepted[:both]).any())
