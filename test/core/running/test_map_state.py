# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""One row per factor, and states that follow from each other: none changes the one before."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from l1slam_ros.core.bordered.front import BELIEVE, GATE, SKIP, Look
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.judgement import NORM, Doubt, Judgement
from l1slam_ros.core.running.factor_table import FRONT, JUDGE, NOBODY, PERSON, FactorTable
from l1slam_ros.core.running.improve import Improvement
from l1slam_ros.core.running.keeper.schedule import Moment, Size, is_judge_due
from l1slam_ros.core.running.map_state import Carried, MapState
from l1slam_ros.core.running.optimised import Optimised
from l1slam_ros.core.solvers.optimality import Status

FITS = Look(True, False, 0.5)
CHANCE = Look(False, True, 1.0)
LIE = Look(False, False, 9.0)
POSES = se2.identity(5)


@pytest.fixture
def graph():
    """Four steps, and five loops behind them."""
    graph, k = FactorGraph(se2, 5), np.arange(4)
    i, j = np.append(k, [0, 0, 0, 1, 1]), np.append(k + 1, [2, 3, 4, 3, 4])
    graph.append_between(i, j, se2.identity(9), np.tile(np.eye(3), (9, 1, 1)))
    return graph


def judgement(accepted, suspect=()):
    m = len(accepted)
    marks = np.isin(np.arange(m), suspect)
    return Judgement(np.array(accepted, bool), marks, np.arange(m) / 10, np.array([1.0, 2.0]),
                     np.ones(m), np.zeros(0, np.int64))


def carried(rows):
    return Carried(rows, 0, False, 5, 0, np.ones(2))


def improvement(made, gap=0.1):
    return Improvement(3, POSES, np.zeros(3 * len(made.accepted)), made, 8.0, 7.0,
                       Status.CONVERGED, 0, 1, 1, gap, 0.0)


def beginning(accepted):
    return MapState.beginning(3, True, Optimised.nothing(POSES), judgement(accepted), 1)


def column(state, name):
    return state.table.rows[name].tolist()


def test_what_the_front_took_stands_behind_what_was_judged():
    before = beginning([1, 1, 1, 1, 0])
    after = before.taken([FITS, CHANCE, LIE], carried(8))
    assert column(before, 'said_by') == 5 * [JUDGE] and before.carried is None
    assert column(after, 'said_by') == 5 * [JUDGE] + 3 * [FRONT]
    assert column(after, 'accepted') == [1, 1, 1, 1, 0, 1, 0, 0]
    assert column(after, 'suspect') == [0, 0, 0, 0, 0, 0, 1, 0]
    # The map is of what its own front accepted.
    assert after.judged.wanted and not after.is_stale
    # What it took again says nothing new.
    again = after.taken([LIE, FITS], carried(9))
    assert column(again, 'accepted') == [1, 1, 1, 1, 0, 1, 0, 0, 1]
    # Two that follow from one state do not write to each other's rows.
    other = before.taken([LIE], carried(6))
    assert column(other, 'accepted') == [1, 1, 1, 1, 0, 0] and after.table.looked == 8


def test_a_judgement_of_other_factors_waits_for_its_map(graph):
    state = beginning([1, 1, 1, 1, 0]).taken([FITS, CHANCE], carried(7))
    same = state.judged_by(judgement([1, 1, 1, 1, 0, 1], suspect=[4]), POSES, 2, False,
                           False, graph.between, 10.0)
    assert same.pending is None and not same.is_stale
    assert column(same, 'said_by') == 6 * [JUDGE] + [FRONT]
    assert column(same, 'suspect') == [0, 0, 0, 0, 1, 0, 1] and same.judged.loops == 2
    other = judgement([1, 1, 1, 1, 1, 1])
    waiting = same.judged_by(other, POSES, 2, True, False, graph.between, 11.0)
    assert waiting.pending is other and waiting.is_stale
    assert waiting.table is same.table
    weighed = replace(judgement([1, 1, 1, 1, 0, 1]), meant=np.array([[1.0, 1, 30], [1, 1, 30]]))
    assert same.judged_by(weighed, POSES, 2, True, False, graph.between, 11.0).is_stale
    # Made of what it accepts, and the front has looked once more at the last one.
    made = judgement([1, 1, 1, 1, 1, 1, 0])
    adopted = waiting.adopted(improvement(made), carried(7), [FITS], other, graph.between, 1e-3,
                              12.0)
    assert adopted.pending is None and not adopted.is_stale
    assert column(adopted, 'accepted') == 7 * [1]
    assert column(adopted, 'said_by') == 6 * [JUDGE] + [FRONT]
    assert adopted.bound == pytest.approx(6.9) and adopted.made == 12.0
    # One that came meanwhile goes on to wait.
    later = judgement([1, 1, 1, 1, 1, 1, 0])
    both = waiting.judged_by(later, POSES, 3, True, False, graph.between, 12.0)
    kept = both.adopted(improvement(made), carried(7), [FITS], other, graph.between, 1e-3, 13.0)
    assert kept.pending is later and kept.is_stale


def test_what_is_held_is_asked_once_more_when_the_robot_stands(graph):
    state, other = beginning([1, 1, 1, 1, 0, 0]), judgement([1, 1, 1, 1, 1, 1])
    driving = state.judged_by(other, POSES, 2, True, True, graph.between, 10.0)
    assert driving.pending is None and driving.table is state.table and driving.all_judged(2)
    assert not driving.all_judged_anew(2)
    size = Size(len(POSES), 3 * 6, 2, 6)
    assert not is_judge_due(driving, size, Moment(11.0, True, quiet=1.0))
    assert is_judge_due(driving, size, Moment(12.0, True, quiet=2.0))
    assert not is_judge_due(driving, size, Moment(14.0, False))
    stands = driving.judged_by(other, POSES, 2, True, False, graph.between, 12.0)
    assert stands.pending is other and stands.all_judged_anew(2)
    # What says nothing new is not held.
    same = state.judged_by(
        judgement([1, 1, 1, 1, 0, 0]), POSES, 2, True, True, graph.between, 10.0)
    assert not same.judged.held and same.all_judged_anew(2)


def test_without_a_new_look_what_stands_there_stays(graph):
    state = beginning([1, 1, 1, 1, 0]).taken([CHANCE, FITS, LIE], carried(8))
    made = judgement([1, 1, 1, 1, 0, 0])
    adopted = state.adopted(improvement(made), carried(8), [LIE, LIE], None, graph.between, 1e-3,
                            1.0)
    assert_array_equal(adopted.table.rows[['accepted', 'suspect', 'sigmas']][:5],
                       state.table.rows[['accepted', 'suspect', 'sigmas']][:5])
    assert column(adopted, 'accepted') == [1, 1, 1, 1, 0, 0, 1, 0]
    # A map that was made of less than is accepted is stale, of as much as was known then not.
    assert column(adopted, 'in_map') == [1, 1, 1, 1, 0, 0, 1, 0] and not adopted.is_stale
    without = state.adopted(improvement(judgement([1, 1, 1, 1, 1, 0])), None, [], None,
                            graph.between, 1e-3, 1.0)
    assert without.is_stale and without.carried is None


def test_what_a_closed_front_left_was_looked_at_by_nobody(graph):
    state = beginning([1, 1, 1, 1]).taken([FITS], carried(5))
    made = judgement([1, 1, 1, 1, 1, 0, 0])
    adopted = state.adopted(improvement(made), carried(5), [], None, graph.between, 1e-3, 1.0)
    assert column(adopted, 'said_by') == 4 * [JUDGE] + [FRONT] + 2 * [NOBODY]
    assert adopted.table.looked == 5 and len(adopted.table.accepted) == 5
    what = adopted.table.for_new_front(graph.between, np.array([1, 1, 1, 1, 1, 0, 0], bool), False)
    assert what.tolist() == 5 * [SKIP] + 2 * [GATE]


def test_a_person_has_the_last_word(graph):
    state = beginning([1, 1, 1, 1, 0]).taken([FITS, CHANCE], carried(7))
    assert state.told(graph.between) is state
    graph.say(np.array([4, 6]), trusted=True)
    graph.say(np.array([5]), trusted=False)
    told = state.told(graph.between)
    assert column(told, 'accepted') == [1, 1, 1, 1, 1, 0, 1]
    assert column(told, 'said_by') == 4 * [JUDGE] + 3 * [PERSON]
    assert told.is_stale and not told.all_judged(3) and told.told(graph.between) is told
    # Nor do a judge or a front overrule it.
    against = told.judged_by(
        judgement([1, 1, 1, 1, 0, 1, 0]), POSES, 3, True, False, graph.between, 1.0)
    adopted = against.adopted(improvement(judgement([1, 1, 1, 1, 1, 0, 1])), carried(7), [],
                              against.pending, graph.between, 1e-3, 2.0)
    assert column(adopted, 'accepted') == [1, 1, 1, 1, 1, 0, 1] and not adopted.is_stale
    assert not adopted.table.rows['suspect'].any()
    table = FactorTable.of(told.table.rows[:4])
    assert table.for_front(graph.between, 3, 9, True).tolist() == [
        BELIEVE, BELIEVE, SKIP, BELIEVE, GATE, GATE]


def test_a_bound_holds_as_long_as_all_of_its_factors_are_accepted(graph):
    state = beginning([1, 1, 1, 1, 1])
    proved = state.adopted(improvement(judgement([1, 1, 1, 1, 1])), carried(5), [], None,
                           graph.between, 1e-3, 1.0)
    more = proved.taken([FITS, LIE], carried(7))
    assert proved.table.is_proof_of_accepted and more.table.is_proof_of_accepted
    graph.say(np.array([4]), trusted=False)
    assert not more.told(graph.between).table.is_proof_of_accepted
    # A map of which nothing was proved leaves the bound that there is.
    unproved = more.adopted(improvement(judgement([1] * 6), np.inf), carried(7), [LIE], None,
                            graph.between, 1e-3, 2.0)
    assert (unproved.bound, unproved.bound_at) == (proved.bound, 1.0)
    assert unproved.table.is_proof_of_accepted


def test_the_doubts_of_a_norm_are_of_its_own_map(graph):
    state, doubts = beginning([1, 1, 1, 1]), (Doubt(NORM, 1, 0, 4),)
    assert state.doubted(state, doubts).of_all.doubts == doubts
    made = judgement([1, 1, 1, 1])
    moved = state.adopted(improvement(made), carried(4), [], None, graph.between, 1e-3, 1.0)
    assert moved.doubted(state, doubts) is moved


def test_what_is_not_finite_is_not_adopted(graph):
    state = beginning([1, 1, 1, 1])
    spoilt = replace(improvement(judgement([1, 1, 1, 1])), cost=np.nan)
    with pytest.raises(ArithmeticError, match='the cost of a new map is not finite'):
        state.adopted(spoilt, None, [], None, graph.between, 1e-3, 1.0)
