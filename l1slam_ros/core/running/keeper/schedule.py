# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Deciding which work is due: making a map, or judging loops.

In: the state of the map, the size of the graph, and the time. Out: pieces of work, at most one for
each worker. These functions are pure; `workers` has the threads that carry out the work.
"""

from enum import Enum
from typing import NamedTuple

from l1slam_ros.core.bordered.front import MOST_ROWS
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.running.map_state import MapState

# A map is factored anew when so many factors have come since, those of five keyframes. A large map
# is factored anew when one factor has come for so many of its keyframes: the cost of this for each
# keyframe does not grow with the map.
_FEWEST, _KEYFRAMES_EACH = 10, 200
# And when this part of what a front takes is taken: what comes while the next map is made has the
# rest, and a loop costs as the square of what the front has taken.
_PART_TAKEN = 1 / 3
# [s] The period of judgements while loops come and none of them fits.
_JUDGE_EVERY = 2.0
# [s] A robot of which neither a keyframe nor a loop comes for so long stands.
_STANDS = 2.0


class Work(Enum):
    """A piece of work."""

    ROUND = 'lower the cost of the map, and factor it'
    EXACT = 'solve for the map to the end, and factor it'
    JUDGE = 'judge all loops, from what is believed on'
    JUDGE_ANEW = 'judge all loops, from the graph alone'
    NORM = 'compare the map with that of another norm'


_JUDGEMENTS = (Work.JUDGE, Work.JUDGE_ANEW)


class Size(NamedTuple):
    """The size of a graph: numbers of keyframes, residual rows, loops, and factors."""

    keyframes: int
    rows: int
    loops: int
    factors: int

    @staticmethod
    def of(builder: GraphBuilder) -> 'Size':
        """Return the size of the graph of a builder."""
        graph = builder.graph
        factors = len(graph.between)
        return Size(graph.n_poses, factors * graph.manifold.TANGENT_SIZE,
                    len(builder.loops.rows), factors)


class Moment(NamedTuple):
    """
    The present time [s], by any clock, and what else the decision depends on.

    idle : no message came for a while; budget : [s] of the update; judging : the judge is at work;
    quiet : [s] since a keyframe or a loop came
    """

    now: float
    idle: bool
    budget: float = 0.0
    judging: bool = False
    quiet: float = 0.0

    @property
    def stands(self) -> bool:
        """Whether the robot does not drive."""
        return self.idle and self.quiet >= _STANDS


def due(state: MapState, size: Size, moment: Moment) -> tuple[Work | None, Work | None]:
    """Return the work that is due for the mapper and for the judge; None if there is none."""
    make = is_map_due(state, size, moment.idle)
    judge = _judgement(state, size, moment, make)
    if (moment.judging or judge in _JUDGEMENTS) and is_beyond_fronts(state, size):
        make = False
    return _map(state, moment.idle) if make else None, judge


def _map(state: MapState, idle: bool) -> Work:
    of_all_there_is = state.carried is not None and not state.carried.taken
    exact = idle and of_all_there_is and not state.is_stale and not state.falls
    return Work.EXACT if exact else Work.ROUND


def _judgement(state: MapState, size: Size, moment: Moment, make: bool) -> Work | None:
    anew = is_anew_due(state, size, moment)
    if anew and moment.idle and state.pending is not None:
        return None  # first the map of the last one, which somebody waits for
    if is_judge_due(state, size, moment):
        # At rest it first starts from the accepted loops: that is faster, and mostly finds as
        # much.
        return Work.JUDGE_ANEW if anew else Work.JUDGE
    compared = state.judged.compared is state.optimised
    final = moment.idle and not make and state.all_judged_anew(size.loops)
    if state.robust and final and not compared:
        return Work.NORM
    return None


def is_map_due(state: MapState, size: Size, idle: bool) -> bool:
    """Return whether a new map is to be made; idle : no message came for a while."""
    optimised, carried = state.optimised, state.carried
    behind = (len(optimised.poses) < size.keyframes or len(optimised.dual) < size.rows
              or not optimised.at_rest)
    # The front uses the noise that was known when it was made.
    other_noise = idle and carried is not None and bool(
        (carried.variance != state.of_all.variance).any())
    return bool(size.keyframes) and (state.is_stale or state.falls or other_noise
                                     or (behind and (idle or is_late(state))))


def is_late(state: MapState) -> bool:
    """Return whether the front has taken so many factors that a new one is needed."""
    carried = state.carried
    return (carried is None or carried.closed or carried.border > _PART_TAKEN * MOST_ROWS
            or carried.taken >= max(_FEWEST, carried.keyframes // _KEYFRAMES_EACH))


def is_beyond_fronts(state: MapState, size: Size) -> bool:
    """
    Return whether more factors came than the front of a new map could take (when robots meet).

    Then a map that is begun before the loops are judged is out of date when it is made. It waits
    for one judgement at most.
    """
    return state.judged.ended <= state.made and outrun(state, size)


def outrun(state: MapState, size: Size) -> bool:
    """Return whether more factors came than the front of a map can take."""
    carried = state.carried
    return carried is not None and (
        (size.factors - carried.rows) * size.rows > MOST_ROWS * size.factors)


def is_judge_due(state: MapState, size: Size, moment: Moment) -> bool:
    """
    Return whether to judge all loops.

    At rest it is due until all loops are judged from the graph alone; if that was not taken, once
    more when the robot stands. While messages come it is
    due where the budget is longer than a judgement takes, or where the last judgement is long ago;
    a shorter wait is enough where the front has left a loop that fits, or no front gates loops.
    """
    judged = state.judged
    if moment.idle:
        waits = judged.held and judged.anew == size.loops and not moment.stands
        return not (waits or state.all_judged_anew(size.loops))
    soon = judged.wanted or state.carried is None
    pause = judged.took if soon else max(_JUDGE_EVERY, 2 * judged.took)
    has_time = moment.budget > judged.took or moment.now > judged.ended + pause
    return (is_anew_due(state, size, moment)
            or (has_time and not state.all_judged(size.loops)))


def is_anew_due(state: MapState, size: Size, moment: Moment) -> bool:
    """
    Return whether the next judgement is to be from the graph alone.

    A judgement starts from the loops believed so far, so a false loop that came first may keep
    out true ones. Hence one from the graph alone follows at rest. While messages come it is due
    where the refused loops put the map in doubt, until there are twice as many loops: they may as
    well be false loops that agree.
    """
    if moment.idle:
        return state.all_judged(size.loops)
    judged = state.judged
    return (size.loops < 2 * judged.doubted and judged.anew != judged.loops
            and moment.now > judged.anew_ended + max(_JUDGE_EVERY, 2 * judged.anew_took))
