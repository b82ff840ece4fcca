# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The gates of a robust solve, by how often they are wrong."""

import numpy as np
import pytest
from lies import careful_world
from problems import chain_of, graph_of, measure, straight

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.draws import keys
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.robust import gating, innovation
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.robust.rounds.growth import Growth
from l1slam_ros.core.solvers import gauss_newton
from l1slam_ros.core.solvers.block_cholesky import cholesky_of


def test_few_true_loops_are_beyond_the_gate(monkeypatch):
    """Of 59,760 true loops to worlds with few others: the map's own uncertainty decides."""
    refused = asked = 0
    for seed in range(60):
        # The same keyframes draw alike: each world is given draws of its own.
        monkeypatch.setattr(innovation, 'keys', lambda *ends, seed=seed: keys(*ends) + seed)
        growth = Growth(careful_world(200, 1200, seed).graph)
        loops = np.flatnonzero(growth.given.is_loop)
        growth.accepted[np.random.default_rng(seed).choice(loops, 5, replace=False)] = True
        growth.solve()
        rows = growth.undecided()
        found = growth.innovations(rows)
        refused += np.count_nonzero(found.square >= growth.given.gate(found.freedom))
        asked += len(rows)
    # One in a thousand would be if noise had the tail that is granted; normal noise has less.
    assert asked > 50_000
    assert asked / 10_000 < refused < asked / 1000


SURE = np.diag([1e4, 1e4, 1e6])
ROUND = 4000  # keyframes of a round so wide that one loop back to its start could be chance


def two_loops(apart, count=2):
    """Return a noise-free round and two loops behind it, or one; two end `apart` m apart [x]."""
    n = ROUND + 100
    angle, radius = 2 * np.pi * np.arange(n) / ROUND, ROUND / (2 * np.pi)
    truth = np.column_stack((radius * np.sin(angle), radius * (1 - np.cos(angle)), angle))
    graph = graph_of(truth, chain_of(n), 0.0, np.diag(np.array([0.085, 0.085, 0.0085]) ** -2))
    start = np.array([10, 31])[:count]
    measure(graph, truth, start, start + ROUND, [[0.0, 0, 0], [apart, 0, 0]][:count], SURE)
    return graph


@pytest.mark.parametrize(('apart', 'believed'), [(2.5, 2), (3.6, 0)])
def test_two_loops_vouch_for_each_other_only_within_the_gate_of_both(apart, believed):
    """
    Each fits alone, and both together are likelier true than chance in either case.

    But 3.6 m are more, over the 42 steps between them, than one true pair in a thousand shows.
    """
    growth = Growth(two_loops(apart))
    growth.solve()
    rows = growth.undecided()
    assert (growth.innovations(rows).square < 1).all()
    assert len(growth.believable(rows)) == believed


def beside_a_sure_one(graph):
    """Return the state of a round with two sure loops besides, and the undecided; one is in."""
    for first in 2000, 2100:
        measure(graph, np.zeros((ROUND + 100, 3)), [first], [first + 12],
                se2.between(*odometry_poses(graph)[[first, first + 12], None])[0], SURE)
    growth = Growth(graph)
    growth.accepted[-1] = True
    growth.solve()
    return growth, growth.undecided()


@pytest.mark.parametrize(('few', 'believed'), [(0.3, 1), (0.4, 3)])
def test_where_few_are_believed_by_themselves_others_come_in_together(monkeypatch, few, believed):
    """One of three is sure; the other two vouch for each other, in this round or the next."""
    growth, rows = beside_a_sure_one(two_loops(2.5))
    assert len(rows) == 3
    monkeypatch.setattr(gating, '_FEW', few)
    assert len(growth.believable(rows)) == believed


def test_a_loop_that_is_true_by_itself_vouches_for_none_that_it_says_nothing_of(monkeypatch):
    """A sure loop of twelve steps, and far from it one that alone is not to be believed."""
    growth, rows = beside_a_sure_one(two_loops(2.5, count=1))
    monkeypatch.setattr(gating, '_FEW', 1.0)
    assert growth.given.is_loop[rows].all() and len(rows) == 2
    assert len(growth.believable(rows)) == 1


def test_lies_of_one_place_do_not_teach_their_noise():
    """Ten loops, all off by the same 8 m, where the odometry is sure of a decimetre."""
    truth, start = straight(60), np.arange(10)
    graph = graph_of(truth, chain_of(60), 0.0, SURE)
    measure(graph, truth, start, start + 50, [-8.0, 0.0, 0.0], SURE)
    growth = Growth(graph)
    growth.begin()
    assert growth.noise.variance[1] <= 1
    assert not len(growth.believable(growth.undecided()))


def rivals(apart, count):
    """Return a noise-free lap and loops back to its start, `apart` m apart [x] from each other."""
    n, lap = 500, 400
    angle, radius = 2 * np.pi * np.arange(n) / lap, lap / (2 * np.pi)
    truth = np.column_stack((radius * np.sin(angle), radius * (1 - np.cos(angle)), angle))
    graph = graph_of(truth, chain_of(n), 0.0, np.diag(np.array([0.1, 0.1, 0.01]) ** -2))
    start = np.array([10, 30])[:count]
    measure(graph, truth, start, start + lap, [[0.0, 0, 0], [apart, 0, 0]][:count], SURE)
    return graph


@pytest.mark.parametrize(('apart', 'count', 'believed'), [(6.0, 1, 1), (0.5, 2, 2), (6.0, 2, 0)])
def test_of_two_that_contradict_each_other_neither_is_believed(apart, count, believed):
    """Each fits, and is believed if it is alone."""
    growth = Growth(rivals(apart, count))
    growth.solve()
    rows = growth.undecided()
    found = growth.innovations(rows)
    assert (found.square < growth.given.gate(found.freedom)).all()
    assert len(growth.believable(rows)) == believed


def test_a_long_part_behind_a_step_that_says_nothing_is_judged():
    """Solved for, the part would turn about the vague step by its rounding."""
    n, graph = 1500, FactorGraph(se2)
    graph.add_poses(n)
    for d in (1, 10, 25, 50):
        i = np.arange(0 if d == 1 else 5, n - d)
        root = np.tile(np.diag([80.0, 80.0, 140.0 if d == 1 else 80.0]), (len(i), 1, 1))
        if d == 1:
            root[4] = np.diag([2 / n, 2 / n, 1.0])
        graph.append_between(i, i + d, np.tile([0.5 * d, 0.0, 0.0], (len(i), 1)), root)
    judgement, _ = robust_solve(graph)
    assert judgement.accepted.all()


def test_an_order_is_found_once_for_the_same_factors(monkeypatch):
    growth, found = Growth(careful_world(200, 600, 0).graph), []
    monkeypatch.setattr(gauss_newton, 'cholesky_of', lambda graph, *how, find=cholesky_of: (
        found.append(len(graph.between)) or find(graph, *how)))
    growth.accepted[:] = True
    growth.solve()
    assert growth.accepted.all() and found == [600]
    poses = growth.poses
    growth.solve()
    assert found == [600]
    assert np.abs(growth.poses - poses).max() < 0.05  # the noise was learnt meanwhile
    growth.accepted[np.flatnonzero(growth.given.is_loop)[0]] = False
    growth.solve()
    assert found == [600, 599]
