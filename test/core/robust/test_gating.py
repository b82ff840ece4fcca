# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""How many loops are believed in one round, by how surely each is true, and by its place."""

from types import SimpleNamespace

import numpy as np
import pytest

from l1slam_ros.core.graph.spanning_tree import pair_key
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.robust.gating import DOUBT, at_once, believable, log_odds_of_false
from l1slam_ros.core.worlds.false_loops import insert_loops, random_false_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world


def believed_of(doubt, place, well=None):
    """Return which loops are believed that are false with these chances."""
    doubt, place = np.asarray(doubt), np.asarray(place)
    well = np.ones(len(doubt), bool) if well is None else well
    return at_once(np.log(1 / doubt - 1), place, well)


def test_of_one_place_as_many_come_in_as_are_all_true_but_for_the_doubt():
    """Eighty loops that are each false with .06%: any of them would be with 5%."""
    believed = believed_of(np.full(80, 6e-4), np.zeros(80, np.int64))
    assert len(believed) == 16 and 16 * 6e-4 < DOUBT < 17 * 6e-4


def test_of_many_places_all_loops_come_in():
    """Two hundred places: .06% of those that come in are false, less than one in a thousand."""
    believed = believed_of(np.tile([5e-4, 6e-4], 200), np.repeat(np.arange(200), 2))
    assert len(believed) == 400


@pytest.mark.parametrize(('places', 'doubt', 'believed'), [
    (100, 8e-4, 100), (51, 8e-4, 51), (49, 8e-4, 12), (100, 1e-3, 9), (100, 0.02, 0)])
def test_so_many_come_in_as_one_place_in_a_thousand_is_false_of(places, doubt, believed):
    """Of few places no part is given away."""
    assert len(believed_of(np.full(places, doubt), np.arange(places))) == believed


@pytest.mark.parametrize(('lies', 'believed'), [(100, 200), (1000, 20)])
def test_no_part_is_given_away_where_most_lie(lies, believed):
    """Two hundred loops of as many places, each false with .05%, beside lies that do not fit."""
    count = 200 + lies
    fits = np.arange(count) < 200
    log_ratio = np.full(count, log_odds_of_false(np.full(200, 20.0), lies) + np.log(1 / 5e-4 - 1))
    found = SimpleNamespace(log_ratio=lambda: log_ratio, square=np.ones(count),
                            freedom=np.full(count, 3), log_det=np.zeros(count))
    good = believable(found, None, lambda freedom: np.full(len(freedom), 16.0), fits, 1,
                      np.arange(count), np.zeros(count))
    assert len(good) == believed


def test_a_place_is_as_doubtful_as_its_most_doubtful_loop():
    """Fifty places with a loop that is sure and one that is not: few of the latter come in."""
    doubt = np.repeat([1e-6, 5e-3], 50)
    believed = believed_of(doubt, np.tile(np.arange(50), 2))
    assert np.count_nonzero(doubt[believed] == 5e-3) == 7


def test_what_hardly_fits_does_not_come_in_for_the_others_of_its_round():
    well = np.arange(100) % 2 == 0
    believed = believed_of(np.full(100, 8e-4), np.arange(100), well)
    assert np.count_nonzero(well[believed]) == 50 and np.count_nonzero(~well[believed]) == 6


def test_few_rounds_find_the_loops_of_a_long_drive():
    """Fifteen rounds if those that come in at a time were all true but for the doubt."""
    world = simulate_world(1000, 2000, WorldOptions(), np.random.default_rng(1))
    rng = np.random.default_rng((0, 50))
    graph = insert_loops(world.graph, random_false_loops(world.graph, world.truth, 1001, rng))
    count = []
    judgement, _ = robust_solve(graph, lambda number, _: count.append(number))
    false = ~np.isin(*(pair_key(one.between.i, one.between.j, 1000)
                       for one in (graph, world.graph)))
    assert (judgement.accepted == ~false).all()
    assert len(count) <= 11
