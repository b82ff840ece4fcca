# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What is due, as a table: a state, the size of the graph, a moment -> what each worker does."""

from dataclasses import replace

import numpy as np
import pytest

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.robust.judgement import WEAK, Doubt, Judgement
from l1slam_ros.core.running.keeper.schedule import Moment, Size, Work, due, outrun
from l1slam_ros.core.running.map_state import Carried, MapState
from l1slam_ros.core.running.optimised import Optimised
from l1slam_ros.core.solvers.optimality import Status

# A graph of four keyframes and five factors, two of them loops, and more of it.
SIZE, ONE_MORE = Size(4, 15, 2, 5), Size(5, 18, 2, 6)
ONE_MORE_LOOP = Size(4, 18, 3, 6)
MEETING = Size(4, 15 + 3 * 601, 603, 606)
NOW = 100.0
BUSY, IDLE = Moment(NOW, False), Moment(NOW, True)
JUDGING = Moment(NOW, False, judging=True)
TIME_FOR_IT = Moment(NOW, False, budget=2.0)

JUDGEMENT = Judgement(np.ones(5, bool), np.zeros(5, bool), np.zeros(5), np.ones(2), np.ones(5),
                      np.zeros(0, np.int64))
MAP = Optimised(se2.identity(4), np.zeros(15), 3.0, Status.CONVERGED, 0)
EMPTY = MapState.beginning(0, True, Optimised.nothing(se2.identity(0)), Judgement.nothing(), 0)
# All is done, and the front carries nothing.
RESTED = MapState.beginning(7, True, MAP, JUDGEMENT, 2)._replace(
    carried=Carried(rows=5, taken=0, closed=False, keyframes=4, border=0, variance=np.ones(2)))
RESTED = RESTED._replace(judged=replace(RESTED.judged, compared=MAP, took=1.0, ended=NOW - 1.5))


def with_front(**changes):
    return RESTED._replace(carried=RESTED.carried._replace(**changes))


def with_judge(state=RESTED, **changes):
    return state._replace(judged=replace(state.judged, **changes))


MET = with_front(closed=True)._replace(made=NOW - 1.0)
PENDING = RESTED._replace(pending=JUDGEMENT)
UNFINISHED = RESTED._replace(optimised=replace(MAP, status=Status.OUT_OF_TIME))
DOUBTED = with_judge(loops=2, anew=1, doubted=2, anew_ended=NOW - 5.0, anew_took=1.0)

TABLE = {
    'nothing of nothing': (EMPTY, Size(0, 0, 0, 0), BUSY, None, None),
    'the first keyframe, and nobody has judged yet': (
        EMPTY, Size(1, 0, 0, 0), BUSY, Work.ROUND, None),
    'all is done': (RESTED, SIZE, BUSY, None, None),
    'all is done, at rest': (RESTED, SIZE, IDLE, None, None),
    'the front carries a keyframe': (with_front(taken=1), ONE_MORE, BUSY, None, None),
    'the front carries a keyframe, at rest': (
        with_front(taken=1), ONE_MORE, IDLE, Work.ROUND, None),
    'the front carries as many as ten factors': (
        with_front(taken=10), ONE_MORE, BUSY, Work.ROUND, None),
    'of a large map it may carry more': (
        with_front(taken=10, keyframes=4000), ONE_MORE, BUSY, None, None),
    'but not so many loops that the next one is dear': (
        with_front(taken=10, keyframes=4000, border=601), ONE_MORE, BUSY, Work.ROUND, None),
    'the front is closed': (with_front(closed=True), ONE_MORE, BUSY, Work.ROUND, None),
    'there is no front': (RESTED._replace(carried=None), ONE_MORE, BUSY, Work.ROUND, None),
    'a judgement waits for its map': (PENDING, SIZE, BUSY, Work.ROUND, None),
    'a judgement waits for its map, at rest': (PENDING, SIZE, IDLE, Work.ROUND, None),
    'the map is of all, but not at its optimum': (UNFINISHED, SIZE, BUSY, None, None),
    'the same at rest': (UNFINISHED, SIZE, IDLE, Work.EXACT, None),
    'the front goes by another noise': (
        with_front(variance=np.array([1.0, 2.0])), SIZE, IDLE, Work.EXACT, None),
    'a loop came, the last judgement was just now': (RESTED, ONE_MORE_LOOP, BUSY, None, None),
    'a loop came, the last judgement is long over': (
        with_judge(ended=NOW - 2.5), ONE_MORE_LOOP, BUSY, None, Work.JUDGE),
    'a loop came, and there is time': (RESTED, ONE_MORE_LOOP, TIME_FOR_IT, None, Work.JUDGE),
    'a loop came that fits': (with_judge(wanted=True), ONE_MORE_LOOP, BUSY, None, Work.JUDGE),
    'a loop came, at rest': (
        with_front(taken=1), ONE_MORE_LOOP, IDLE, Work.ROUND, Work.JUDGE),
    'all are judged, at rest not from the graph alone': (
        with_judge(anew=1), SIZE, IDLE, None, Work.JUDGE_ANEW),
    'the same while driving': (with_judge(anew=1), SIZE, BUSY, None, None),
    'what was refused lays a doubt': (DOUBTED, SIZE, BUSY, None, Work.JUDGE_ANEW),
    'it was asked just now': (
        with_judge(DOUBTED, anew_ended=NOW - 1.0), SIZE, BUSY, None, None),
    'there are twice as many loops by now': (DOUBTED, Size(4, 21, 4, 7), BUSY, None, None),
    'no other norm was asked yet': (with_judge(compared=None), SIZE, IDLE, None, Work.NORM),
    'the same while it drives': (with_judge(compared=None), SIZE, BUSY, None, None),
    'no norm is asked of a map that is to be made anew': (
        with_judge(PENDING, compared=None), SIZE, IDLE, Work.ROUND, None),
    'two robots met: a map without their loops is not begun': (
        with_judge(MET, wanted=True), MEETING, BUSY, None, Work.JUDGE),
    'the same while they are judged': (MET, MEETING, JUDGING, None, None),
    'the same once they are': (MET, MEETING, BUSY, Work.ROUND, None),
    'the same while it judges on': (
        with_judge(MET, ended=NOW - 0.5), MEETING, JUDGING, Work.ROUND, None),
    'the front takes what came': (MET, ONE_MORE_LOOP, JUDGING, Work.ROUND, None),
    'the map that was judged first comes before a judgement anew': (
        with_judge(PENDING, anew=1), SIZE, IDLE, Work.ROUND, None),
    'where nothing is doubted, nothing is judged': (
        with_judge(compared=None)._replace(robust=False), ONE_MORE_LOOP, BUSY, None, None),
}


@pytest.mark.parametrize(('state', 'size', 'moment', 'make', 'judge'), TABLE.values(), ids=TABLE)
def test_what_is_due(state, size, moment, make, judge):
    assert due(state, size, moment) == (make, judge)


def test_a_front_is_outrun_by_more_than_it_takes():
    assert outrun(RESTED, MEETING) and outrun(MET, MEETING)
    assert not outrun(RESTED, ONE_MORE_LOOP)
    assert not outrun(EMPTY, MEETING)


def test_a_judgement_that_doubts_what_it_refused_is_asked_until_there_are_twice_as_many_loops():
    doubt = Doubt(WEAK, 2, 0, 3)
    doubtful = replace(JUDGEMENT, doubts=(doubt,), is_refusal_doubted=True)
    judged = RESTED.judged.after(doubtful, se2.identity(4), 2, False, NOW)
    assert (judged.doubted, judged.loops, judged.anew) == (2, 2, 2)
    # A judgement that has no doubt leaves it.
    assert judged.after(JUDGEMENT, se2.identity(4), 3, False, NOW).doubted == 2
