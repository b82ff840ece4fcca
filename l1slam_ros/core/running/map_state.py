# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The state of the map of a running back end, and its transitions.

In: a state, and a result computed from a snapshot of it. Out: the next state. States are frozen
and the transitions are pure, so that they can be read without a lock.

    adopted     a new map, and a front that takes the next factors
    taken       that front has taken new factors
    judged      the judge has judged all factors
    told        a person has vouched for factors or struck them out
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from l1slam_ros.core.bordered.front import Front, Look
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import BetweenFactors
from l1slam_ros.core.robust.judgement import Doubt, Judgement
from l1slam_ros.core.running.factor_table import FactorTable
from l1slam_ros.core.running.improve import Improvement
from l1slam_ros.core.running.optimised import Optimised
from l1slam_ros.core.solvers.optimality import Status

# Used as the number of judged loops after a person's decision: all are to be judged again.
_TOLD_SINCE = -1


class Carried(NamedTuple):
    """
    The size of a front: what it has taken since the map that it was made of.

    rows, taken, closed, keyframes, border, variance : see `Front`
    """

    rows: int
    taken: int
    closed: bool
    keyframes: int
    border: int
    variance: Array

    @staticmethod
    def by(front: Front) -> 'Carried':
        """Return the size of a front as it is now."""
        return Carried(front.rows, front.taken, front.closed, front.keyframes, front.border,
                       front.variance)


@dataclass(frozen=True)
class Judged:
    """
    What the judge has done so far, and when [s].

    loops : how many were judged; anew : how many were judged from the graph alone;
    doubted : how many there were when a judgement last doubted its own refusals; poses : (n, p)
    the L2 map of the last one, None: there is none; wanted : the front has left a loop that fits;
    held : the last one was not taken, see `MapState.judged_by`;
    compared : the map that was last compared with that of another norm; began, ended, took : of
    the last one that went on from the one before; anew_ended, anew_took : of the last one anew
    """

    loops: int
    anew: int
    doubted: int
    poses: Array | None = None
    wanted: bool = False
    held: bool = False
    compared: Optimised | None = None
    began: float = 0.0
    ended: float = 0.0
    took: float = 0.0
    anew_ended: float = 0.0
    anew_took: float = 0.0

    def after(self, judgement: Judgement, poses: Array | None, loops: int, anew: bool,
              now: float) -> 'Judged':
        """Return the record after a judgement of `loops` loops; anew : from the graph alone."""
        doubted = loops if judgement.is_refusal_doubted else self.doubted
        after = replace(self, loops=loops, poses=poses, held=False, compared=None,
                        doubted=doubted, ended=now)
        if anew:
            return replace(after, anew=loops, anew_ended=now, anew_took=now - self.began)
        return replace(after, took=now - self.began)


class MapState(NamedTuple):
    """
    The state of the map of one graph.

    Parameters
    ----------
    began : the revision at which this map began: it names it, see `Improvement`
    robust : loops may be doubted
    optimised : the last map that was solved for
    table : what is said of each factor
    of_all : what the last judgement says of all factors together; it has no columns
    judged : what the judge has done
    pending : the last judgement, where no map is made of it yet: until there is one, map and table
        are those before; None: there is none
    carried : by the front since the last map, None: there is no front
    last : the account of the last map, None: there was none
    made : [s] when it was adopted
    bound, bound_at : no map of the factors that are `proved`, and near this one, has less cost;
        [s] when that was found

    """

    began: int
    robust: bool
    optimised: Optimised
    table: FactorTable
    of_all: Judgement
    judged: Judged
    pending: Judgement | None = None
    carried: Carried | None = None
    last: Improvement | None = None
    made: float = 0.0
    bound: float = np.nan
    bound_at: float = 0.0

    @staticmethod
    def beginning(began: int, robust: bool, optimised: Optimised, judgement: Judgement,
                  judged_loops: int) -> 'MapState':
        """Return the first state of a map, new or saved; judged_loops : of a saved map."""
        none = Judgement.nothing()
        of_all = replace(judgement, accepted=none.accepted, suspect=none.suspect,
                         sigmas=none.sigmas, noise=none.noise)
        return MapState(
            began, robust, optimised, FactorTable.of_judgement(judgement), of_all,
            Judged(judged_loops, judged_loops, judged_loops * judgement.is_refusal_doubted))

    @property
    def is_stale(self) -> bool:
        """Whether the map uses other factors than those that are accepted, or are to be."""
        return self.pending is not None or not self.table.is_map_of_accepted

    @property
    def falls(self) -> bool:
        """Whether the last round of the map ended on the way down."""
        return self.last is not None and self.last.falls

    def all_judged(self, loops: int) -> bool:
        """Return whether none of `loops` loops waits to be judged."""
        return not self.robust or (self.of_all.settled and self.judged.loops == loops)

    def all_judged_anew(self, loops: int) -> bool:
        """
        Return whether all of so many loops were judged from the graph alone.

        A loop that was accepted early stays accepted as long as it fits. At rest there is time to
        judge whether it would be accepted now.
        """
        return self.all_judged(loops) and (
            not self.robust or (self.judged.anew == loops and not self.judged.held))

    def told(self, factors: BetweenFactors) -> 'MapState':
        """Return the state with a person's decisions on some factors applied."""
        table = self.table.told(factors)
        if table is self.table:
            return self
        return self._replace(table=table, judged=replace(self.judged, loops=_TOLD_SINCE))

    def taken(self, looks: Sequence[Look], carried: Carried) -> 'MapState':
        """Return the state after the front has taken and gated some factors."""
        # At what it takes again nobody else looks.
        new = looks[max(self.table.looked - (carried.rows - len(looks)), 0):]
        judged = self.judged
        wanted = any(look.suspect for look in new)
        if wanted and not judged.wanted:
            judged = replace(judged, wanted=True)
        return self._replace(table=self.table.with_looks(new), carried=carried, judged=judged)

    def being_judged(self, now: float) -> 'MapState':
        """Return the state while the judge works on all present loops."""
        return self._replace(judged=replace(self.judged, wanted=False, began=now))

    def given_up(self, now: float) -> 'MapState':
        """Return the state after a judgement from the graph alone that did not end."""
        judged = self.judged
        return self._replace(
            judged=replace(judged, anew_ended=now, anew_took=now - judged.began))

    def judged_by(self, judgement: Judgement, poses: Array, loops: int, anew: bool, held: bool,
                  factors: BetweenFactors, now: float) -> 'MapState':
        """
        Return the state after a judgement of so many loops, of which poses (n, p) is the L2 map.

        A judgement that accepts other factors than the map uses, or corrects or weighs them
        otherwise, is pending until a map is made of it; anew : it is from the graph alone; held :
        such a one is not taken, but made once more when the robot stands
        """
        accepted = self.table.accepted[:len(judgement.accepted)]
        same = (judgement.drift == self.of_all.drift
                and np.array_equal(judgement.meant, self.of_all.meant)
                and np.array_equal(judgement.accepted, accepted))
        if held and not same:
            judged = self.judged.after(judgement, self.judged.poses, loops, anew, now)
            return self._replace(judged=replace(judged, held=True))
        after = self._replace(judged=self.judged.after(judgement, poses, loops, anew, now))
        if self.pending is not None or not same:
            return after._replace(pending=judgement)
        return after._committed(judgement, factors)

    def _committed(self, judgement: Judgement, factors: BetweenFactors) -> 'MapState':
        """Return the state with a judgement in its table."""
        none = self.of_all
        return self._replace(
            table=self.table.judged(judgement, factors),
            of_all=replace(judgement, accepted=none.accepted, suspect=none.suspect,
                           sigmas=none.sigmas, noise=none.noise))

    def adopted(self, improvement: Improvement, carried: Carried | None, looks: Sequence[Look],
                pending: Judgement | None, factors: BetweenFactors, tolerance: float,
                now: float) -> 'MapState':
        """
        Return the state after a map was published.

        Parameters
        ----------
        improvement : the map
        carried, looks : by its front, None: there is none; at the last factors it has looked
        pending : the judgement that it was made for
        tolerance : see `OptimiserOptions.outer_tolerance`

        """
        after = self
        made = improvement.judgement
        if pending is not None:
            after = self._committed(pending, factors)
            after = after._replace(pending=None if self.pending is pending else self.pending)
        proved = improvement.gap < np.inf
        bound = (improvement.cost - improvement.gap, now) if proved else (
            self.bound, self.bound_at)
        end = carried.rows if carried else len(made.accepted)
        wanted = self.judged.wanted or any(look.suspect for look in looks)
        return after._replace(
            optimised=improvement.taken_over(self.optimised, tolerance),
            table=after.table.adopted(made, looks, end, pending is not None, proved),
            judged=replace(self.judged, wanted=wanted), carried=carried, last=improvement,
            made=now, bound=bound[0], bound_at=bound[1])

    def doubted(self, earlier: 'MapState', doubts: tuple[Doubt, ...]) -> 'MapState':
        """Return the state with doubts found for an earlier state, if its map is the same."""
        if self.optimised is not earlier.optimised or self.of_all is not earlier.of_all:
            return self
        of_all = replace(self.of_all, doubts=tuple(dict.fromkeys(self.of_all.doubts + doubts)))
        return self._replace(
            of_all=of_all, judged=replace(self.judged, compared=self.optimised))

    def account(self, seconds: float) -> Improvement:
        """Return the last `Improvement`, as the result of an update that took `seconds`."""
        if self.last is not None:
            return replace(self.last, seconds=seconds)
        return Improvement(self.began, self.optimised.poses, self.optimised.dual,
                           self.table.judgement(self.of_all), 0.0, 0.0, Status.OUT_OF_TIME, 0, 0,
                           0, np.inf, seconds)


# The next state, by the present one and the factors that there are.
Transition = Callable[[MapState, BetweenFactors], MapState]
