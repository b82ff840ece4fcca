# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The judgement while a graph grows: what is new, what is known, and what evidence makes of it."""

import numpy as np
import problems
import pytest
from lies import (
    careful_world,
    drive_roundabout,
    is_false,
    position_error,
    roundabout,
    spoilt,
)
from numpy.testing import assert_array_equal
from problems import EVERY, chain_of, retold, straight

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.batch import judge
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.running.backend import Backend

LOOPS = [(0, 2), (1, 4), (0, 1)]


def graph_of(*loops, trusted=()):
    """Return a chain of six on a line with loops; trusted : those that are vouched for."""
    pairs = [*chain_of(6).tolist(), *map(list, loops)]
    return retold(problems.graph_of(straight(6), pairs, 0.0, np.eye(3)),
                  trusted=np.array([tuple(pair) in trusted for pair in pairs]))


@pytest.fixture(scope='module')
def bad():
    """160 keyframes, 161 true loops and 70 false ones."""
    return spoilt(careful_world(160, 320), 'random', 70)


# What is believed before anything was looked at


def test_of_nothing_there_is_nothing_to_be_found_out():
    judgement = Judgement.nothing().extended(FactorGraph(se2), True)
    assert [len(a) for a in (judgement.accepted, judgement.suspect, judgement.sigmas)] == [0, 0, 0]
    assert judgement.settled and judgement.variance.tolist() == [1.0, 1.0]


def test_odometry_and_what_is_trusted_is_believed_and_a_loop_is_suspect():
    judgement = Judgement.nothing().extended(graph_of(*LOOPS, trusted=[(1, 4)]), True)
    assert judgement.accepted.tolist() == [True] * 5 + [False, True, False]
    assert_array_equal(judgement.suspect, ~judgement.accepted)
    assert np.isnan(judgement.sigmas).all() and not judgement.settled


def test_without_a_loop_to_doubt_it_is_settled():
    for graph in (graph_of(), graph_of((0, 2), trusted=[(0, 2)])):
        judgement = Judgement.nothing().extended(graph, True)
        assert judgement.accepted.all() and judgement.settled


def earlier(settled=True):
    """Return a judgement of the chain and the first two loops: one rejected, one suspect."""
    return Judgement(np.array([True] * 5 + [False, False]), np.array([False] * 6 + [True]),
                     np.arange(7.0), np.array([2.0, 3.0]), np.ones(7), np.zeros(0, np.int64), (),
                     settled)


def test_what_is_known_stays_when_the_graph_grows():
    judgement = earlier().extended(graph_of(*LOOPS), True)
    assert judgement.accepted.tolist() == [True] * 5 + [False] * 3
    assert judgement.suspect.tolist() == [False] * 6 + [True, True]
    assert_array_equal(judgement.sigmas, [*range(7), np.nan])
    assert judgement.variance.tolist() == [2.0, 3.0] and not judgement.settled


@pytest.mark.parametrize('settled', [True, False])
def test_nothing_new_changes_nothing(settled):
    before = earlier(settled)
    after = before.extended(graph_of(*LOOPS[:2]), True)
    for name in ('accepted', 'suspect', 'sigmas', 'variance'):
        assert_array_equal(getattr(after, name), getattr(before, name))
    assert after.settled is settled


def test_new_odometry_alone_is_no_reason_to_look_again():
    graph = graph_of(*LOOPS[:2])
    graph.add_poses()
    graph.add_between(5, 6, np.array([[1.0, 0.0, 0.0]]), np.eye(3)[None])
    judgement = earlier().extended(graph, True)
    assert judgement.accepted[-1] and judgement.settled


def test_who_stops_doubting_believes_what_was_rejected():
    judgement = earlier(settled=False).extended(graph_of(*LOOPS), False)
    assert judgement.accepted.all() and not judgement.suspect.any() and judgement.settled


# Judging


def test_judging_again_changes_nothing(bad):
    once, poses = judge(bad.graph, bad.odometry, Judgement.nothing().extended(bad.graph, True))
    twice, _ = judge(bad.graph, poses, once)
    assert_array_equal(twice.accepted, once.accepted)
    assert twice.settled


@pytest.mark.parametrize('trusted', [True, False])
def test_others_may_lean_on_what_is_trusted(trusted):
    """Two loops that agree, eight sigmas off the odometry: believed if one is vouched for."""
    backend, truth = Backend(EVERY), roundabout(160)
    drive_roundabout(backend, truth)
    graph, poses = backend.snapshot().graph, backend.poses
    off = se2.between(truth[10:11], truth[100:101]) + np.array([[20.0, 0.0, 0.0]])
    for vouched in (trusted, False):
        graph.add_between(np.array([10]), np.array([100]), off,
                          np.diag([100.0, 100.0, 1e3])[None], vouched)
    judgement, _ = judge(graph, poses, Judgement.nothing().extended(graph, True))
    assert judgement.accepted[-2:].tolist() == [trusted, trusted]


def test_a_lie_that_was_believed_is_dropped_when_the_truth_comes(bad):
    """As after a run in which nobody doubted one of them."""
    believed = Judgement.nothing().extended(bad.graph, True)
    lie = int(np.flatnonzero(is_false(bad, bad.graph.between))[30])
    believed.accepted[lie], believed.suspect[lie] = True, False
    judgement, poses = judge(bad.graph, bad.odometry, believed)
    assert not judgement.accepted[is_false(bad, bad.graph.between)].any()
    assert not judgement.suspect[lie] and judgement.sigmas[lie] > 4
    assert position_error(poses, bad.truth) < 0.2
