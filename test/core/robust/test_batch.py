# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Lies are refused, truth is kept, and what cannot be told is left open."""

import numpy as np
import pytest
from lies import careful_world, is_false, position_error, slipped, spoilt
from problems import add_absolute, retold

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph, turned
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.robust import batch
from l1slam_ros.core.robust.batch import judge, robust_solve
from l1slam_ros.core.robust.judgement import OTHER_MAP, SLIP, UNFINISHED, Judgement
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world


@pytest.fixture(scope='module')
def world():
    return careful_world(400, 800)


def judged(graph):
    """Return what `robust_solve` does, as a back end finds it out that has heard all at once."""
    nothing = Judgement.nothing().extended(graph, True)
    return judge(graph, odometry_poses(graph), nothing)


@pytest.mark.parametrize('kind', FALSE_LOOPS)
@pytest.mark.parametrize('count', [20, 401, 1600])
@pytest.mark.parametrize('way', [robust_solve, judged])
def test_false_loops_are_refused_and_true_ones_kept(world, way, count, kind):
    bad = spoilt(world, kind, count)
    found, poses = way(bad.graph)
    false = is_false(bad, bad.graph.between)
    assert not (found.accepted & (false | found.suspect)).any()
    assert np.count_nonzero(~found.accepted[~false]) <= 4
    assert position_error(poses, world.truth) < 0.2
    assert not len(found.slips)
    assert found.sigmas[false & ~found.suspect].min() > 4
    assert np.median(found.sigmas[~false]) < 3 and np.isfinite(found.sigmas).all()
    np.testing.assert_allclose(found.variance, 1, rtol=0.3)
    assert found.settled


def test_a_clean_graph_keeps_all_its_loops(world):
    found, _ = robust_solve(world.graph)
    # One true loop in a thousand is beyond the gate.
    assert np.count_nonzero(~found.accepted) <= 2
    assert not found.doubts


def test_noise_overstated_alike_is_no_reason_to_doubt_what_does_not_fit():
    """As where each information is the identity: what misses by centimetres still fits it."""
    world = careful_world(300, 420)
    graph = spoilt(world, 'grouped', 100).graph
    every = np.arange(len(graph.between))
    once, poses = robust_solve(graph)
    found, again = robust_solve(graph.subset(every, np.full(len(every), 1e4)))
    assert (found.accepted == once.accepted).all() and not found.suspect.any()
    np.testing.assert_allclose(found.variance * 1e4, once.variance, rtol=0.01)
    # Its noise is taken for ten times the variance that was found.
    np.testing.assert_allclose(found.sigmas[found.accepted] * 10**0.5,
                               once.sigmas[found.accepted], rtol=0.1, atol=1e-9)
    assert not found.doubts and position_error(again, poses) < 1e-3


@pytest.mark.parametrize('backwards', [False, True])
def test_a_loop_told_twice_is_no_witness_of_itself(world, backwards):
    bad = slipped(spoilt(world, 'grouped', 170).graph, 200, (1.0, 0.0, 0.0))
    loops = ~bad.between.is_odometry
    twice, told = bad.subset(np.arange(len(loops))), turned(bad, loops) if backwards else bad
    factors = told.between
    # As files tell it: rounded.
    twice.append_between(factors.i[loops], factors.j[loops], factors.measurement[loops].round(5),
                         factors.sqrt_information[loops], factors.trusted[loops],
                         factors.struck[loops])
    once, poses = robust_solve(bad)
    found, again = robust_solve(twice)
    assert (found.accepted == np.r_[once.accepted, once.accepted[loops]]).all()
    assert (found.suspect == np.r_[once.suspect, once.suspect[loops]]).all()
    assert found.doubts == once.doubts and found.confidence == once.confidence
    assert found.slips.tolist() == once.slips.tolist() != []
    np.testing.assert_array_equal(again, poses)


def test_a_graph_of_odometry_alone_is_its_chain(world):
    found, poses = robust_solve(world.graph.subset(world.graph.between.is_odometry))
    assert position_error(poses, world.odometry) < 1e-6
    assert found.accepted.all() and not found.suspect.any()


@pytest.mark.parametrize('offset', [(5.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2)])
def test_a_slip_of_the_odometry_is_found_and_named(world, offset):
    bad = spoilt(world, 'random', 170)
    found, poses = robust_solve(slipped(bad.graph, 200, offset))
    assert len(found.slips) == 1
    # Between loops nobody can tell which of the steps it was.
    assert abs(bad.graph.between.i[found.slips[0]] - 200) <= 3
    assert not found.accepted[is_false(bad, bad.graph.between)].any()
    assert position_error(poses, world.truth) < 0.3


def test_a_map_that_loops_agree_is_wrong_is_doubtful(world):
    """Two slips, and no single step explains what the loops across both agree upon."""
    rng = np.random.default_rng(5)
    steps = np.sort(rng.choice(399, 2, replace=False))
    off = rng.normal(size=(2, 3)) * [4, 4, 1.5]
    found, poses = robust_solve(slipped(spoilt(world, 'random', 170).graph, steps, off))
    right = position_error(poses, world.truth) < 0.5
    assert right or {doubt.kind for doubt in found.doubts} & {OTHER_MAP, SLIP}
    for doubt in found.doubts:
        if doubt.kind == SLIP:
            assert doubt.last == doubt.first + 1
        else:
            assert doubt.loops > 10 and doubt.first < steps[0] < doubt.last


def test_a_trusted_loop_is_never_refused(world):
    bad = spoilt(world, 'random', 10)
    lie = int(np.flatnonzero(is_false(bad, bad.graph.between))[4])
    assert not robust_solve(bad.graph)[0].accepted[lie]
    trusted = np.arange(len(bad.graph.between)) == lie
    assert robust_solve(retold(bad.graph, trusted=trusted))[0].accepted[lie]


@pytest.mark.parametrize('part', [0.0, 0.5])
def test_the_same_graph_gives_the_same_answer_however_its_factors_came(world, part):
    """In whatever order, and whichever end was named first."""
    graph, rng = spoilt(world, 'grouped', 401).graph, np.random.default_rng(0)
    order = rng.permutation(len(graph.between))
    retold = turned(graph, rng.random(len(order)) < part).subset(order)
    (one, poses), (other, again) = robust_solve(graph), robust_solve(retold)
    np.testing.assert_allclose(poses, again, atol=1e-6)
    np.testing.assert_array_equal(one.accepted[order], other.accepted)
    np.testing.assert_allclose(one.sigmas[order], other.sigmas, atol=1e-3)


def test_odometry_may_be_noisier_than_it_says(world):
    noise = np.random.default_rng(3).standard_normal((399, 3)) * [0.15, 0.15, 0.015]
    found, _ = robust_solve(slipped(world.graph, np.arange(399), noise))
    assert np.count_nonzero(~found.accepted) <= 4
    assert found.variance[0] > 2 * found.variance[1]


def test_a_lone_far_loop_is_taken_with_a_doubt():
    """A drive straight on: nothing but the drift says whether a loop to its start may be true."""
    n = 400
    graph = FactorGraph(se2)
    graph.add_poses(n)
    i = np.arange(n - 1)
    step = np.tile([1.0, 0.0, np.pi / 200], (n - 1, 1))
    graph.add_between(i, i + 1, step, np.tile(np.diag([4.0, 4.0, 100.0]), (n - 1, 1, 1)))
    graph.add_between(np.array([0]), np.array([n - 1]), np.array([[1.0, 20.0, 0.5]]),
                      np.diag([100.0, 100.0, 1000.0])[None])
    found, _ = robust_solve(graph)
    assert found.accepted[-1] and found.doubts
    assert 0 < found.sigmas[-1] < 4


def test_one_absolute_pose_fixes_the_gauge_and_nothing_else():
    world = simulate_world(100, 180, WorldOptions(), np.random.default_rng(5))
    graph = world.graph
    without, _ = robust_solve(graph)
    add_absolute(graph, np.array([3]), world.truth[3:4], np.eye(3)[None] * 1e4)
    found, _ = robust_solve(graph)
    assert len(found.accepted) == len(graph.between)
    assert found.accepted.tolist() == [*without.accepted, True]


def test_a_judgement_that_came_to_no_end_is_doubtful(world, monkeypatch):
    graph = spoilt(world, 'random', 170).graph
    assert robust_solve(graph)[0].doubts == ()
    monkeypatch.setattr(batch, '_MOST_ROUNDS', 2)
    kinds = {doubt.kind: doubt.loops for doubt in robust_solve(graph)[0].doubts}
    assert kinds[UNFINISHED] >= 170
