# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Odometry factors that lie are left out, others stay; the rest of it is in `test_batch.py`."""

import numpy as np
import pytest
from lies import CAREFUL, careful_world, laps, position_error, slipped, spoilt
from problems import chain_of, graph_of, measure, retold, straight
from test_pairwise_consistency import STEP, TURN, grown

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.robust.judgement import OTHER_MAP, SLIP
from l1slam_ros.core.robust.odometry import slips
from l1slam_ros.core.robust.odometry.cuts import without
from l1slam_ros.core.robust.odometry.motion import log_odds_of_slips, usual_motion
from l1slam_ros.core.robust.odometry.slips import SURE, without_slip
from l1slam_ros.core.robust.odometry.untold import LEAST
from l1slam_ros.core.robust.reasons import doubts
from l1slam_ros.core.robust.rounds.growth import Growth


@pytest.fixture(scope='module')
def bad():
    return spoilt(careful_world(400, 800), 'random', 100)


def repaired(graph):
    """Return the graph's state without a slip; None: there is none."""
    growth = grown(graph)
    return without_slip(growth, growth)


def test_a_slip_is_cut_and_loops_come_in(bad):
    growth = grown(slipped(bad.graph, STEP, TURN))
    before, loops = growth.cut.copy(), np.count_nonzero(growth.accepted & growth.given.is_loop)
    found = without_slip(growth, growth)
    (cut,) = np.flatnonzero(found.cut)
    assert growth.given.low[cut] == STEP
    assert np.count_nonzero(found.accepted & found.given.is_loop) > loops + 10
    np.testing.assert_array_equal(growth.cut, before)  # it was tried in a copy


def test_without_a_slip_nothing_is_left_out(bad):
    assert repaired(bad.graph) is None


@pytest.mark.parametrize('steps, offset', [([100, 180], [5.0, 0.0, 0.0]),
                                           ([150, 230], [0.0, 0.0, 1.5]),
                                           ([150, 230, 310], [0.0, 0.0, 0.7])])
def test_slips_are_found_together(bad, steps, offset):
    """Each bends what the loops across the others say: of three, the first was cut elsewhere."""
    graph = slipped(bad.graph, steps, offset)
    judgement, _ = robust_solve(graph)
    assert graph.between.i[judgement.slips].tolist() == steps
    assert not judgement.doubts


def test_the_noise_that_few_loops_learnt_of_slips_is_forgotten_once_they_are_cut():
    """All of them fit by noise ten times as large; cut by that, one of the two was doubtful."""
    world = spoilt(careful_world(300, 312, 3), 'random', 4)
    graph = slipped(world.graph, steps := [100, 200], [2.0, 0.0, 0.0])
    judgement, _ = robust_solve(graph)
    assert graph.between.i[judgement.slips].tolist() == steps and not judgement.doubts
    assert judgement.variance[0] < 2.0


def test_far_loops_alone_say_how_the_robot_moved_at_a_slip():
    """They know it to hundreds of its sigmas; of a map half way there the second was not found."""
    world = spoilt(careful_world(400, 440, 1), 'random', 15)
    graph = slipped(world.graph, steps := [160, 200], [[0.0, 0.0, 1.5], [0.0, 0.0, -1.5]])
    assert graph.between.i[robust_solve(graph)[0].slips].tolist() == steps


def test_a_slip_of_odometry_that_drifts_within_its_noise():
    """Loops behind it fit to a third of the noise; those across see it 2 m off for the drift."""
    rng, ahead = np.random.default_rng(1), np.arange(0, 180, 10)
    near = [np.stack((ahead + k, ahead + k + 15), axis=1) for k in (0, 205)]
    across = np.arange(0, 150, 30)
    far = np.stack((across, 399 - across // 2), axis=1)
    truth = np.cumsum(rng.normal([1.0, 0.0, 0.0], [0.1, 0.0, 0.0], (400, 3)), axis=0)
    drifted = truth + np.arange(400)[:, None] * [0.0, 0.006, 0.0]
    sure = np.diag([400.0, 400.0, 1e5])
    graph = graph_of(drifted, np.concatenate((chain_of(400), *near)), 0.0, sure)
    measure(graph, truth, *far.T, 0.0, sure)
    Z = graph.between.measurement
    Z += 0.3 * rng.standard_normal(Z.shape) / np.sqrt(np.diag(sure))
    judgement, _ = robust_solve(slipped(graph, [STEP], [0.0, 0.0, 1.5]))
    assert graph.between.i[judgement.slips].tolist() == [STEP] and not judgement.doubts


@pytest.mark.parametrize('n, rounds, loops, steps, metres', [
    (300, 2, 120, [100], 5.0), (300, 2, 120, [100, 180], 3.0), (240, 3, 100, [100, 110], 2.0)])
def test_where_all_loops_along_a_lap_are_of_one_place_they_still_tell_of_slips(
        n, rounds, loops, steps, metres):
    """A run of them joins what a cut left in two; of the last two each was unlikely by itself."""
    rng = np.random.default_rng(1)
    world = spoilt(laps(n, rounds, loops, CAREFUL, rng), 'random', loops // 3)
    judgement, poses = robust_solve(graph := slipped(world.graph, steps, [0.0, metres, 0.0]))
    assert graph.between.i[judgement.slips].tolist() == steps and not judgement.doubts
    assert position_error(poses, world.truth) < 0.4


@pytest.mark.parametrize('n, rounds, loops, lies, steps, turn', [
    (358, 2, 150, 33, [49], 1.48), (441, 3, 170, 63, [110, 404], 1.48)])
def test_a_run_of_loops_that_a_cut_lets_in_counts_though_their_place_was_known(
        n, rounds, loops, lies, steps, turn):
    """Of laps one place is accepted on either side of the slip, so a cut wins no other one."""
    rng = np.random.default_rng(1)
    world = spoilt(laps(n, rounds, loops, CAREFUL, rng), 'random', lies)
    judgement, _ = robust_solve(graph := slipped(world.graph, steps, [0.0, 0.0, turn]))
    assert graph.between.i[judgement.slips].tolist() == steps and not judgement.doubts


@pytest.mark.parametrize('stated, turn, named', [(1.0, 0.14, [STEP]), (4.0, 0.056, []),
                                                 (4.0, 0.2, [STEP]), (10.0, 0.14, [STEP])])
def test_what_is_within_the_noise_as_stated_is_no_slip(bad, stated, turn, named):
    """3 sigmas are none, though loops that know better speak against it; 40 real ones are."""
    graph = retold(slipped(bad.graph, STEP, (0.0, 0.0, turn)), times=stated)
    slips = robust_solve(graph)[0].slips
    assert graph.between.i[slips].tolist() == named


@pytest.mark.parametrize('turned, cut, odds, doubted', [
    (True, False, 1 + LEAST - SURE, True), (True, False, LEAST - SURE - 1, False),
    (False, False, 1 + LEAST, True), (False, False, LEAST - 1, False),
    (False, True, 1 - SURE, True), (False, True, -SURE - 1, False)])
def test_refused_loops_that_agree_and_a_cut_speak_for_a_slip_that_is_unlikely_by_itself(
        bad, turned, cut, odds, doubted):
    """Of two slips each is, since the other one bends what the loops across it say."""
    growth = grown(slipped(bad.graph, STEP, TURN) if turned else bad.graph)
    (step,) = np.flatnonzero(~growth.given.is_loop & (growth.given.low == STEP))
    growth.cut[step - 1] = cut
    growth.slip_odds = {int(step): odds}
    assert (SLIP in [doubt.kind for doubt in doubts(growth)]) == doubted


def test_what_fits_the_loops_that_come_in_without_it_did_not_slip(bad):
    """As if a lie had held the map elsewhere, and all loops across a step were left out for it."""
    growth = grown(bad.graph)
    (step,) = np.flatnonzero(~growth.given.is_loop & (growth.given.low == STEP))
    across = growth.accepted & growth.given.spanning(step)
    growth.accepted[across] = False
    growth.solve()
    found = without_slip(growth, growth)
    assert not found.cut.any() and found.accepted[across].all()
    assert max(growth.slip_odds.values()) < -SURE
    # To cut it again leads to the same, which wins nothing.
    assert without_slip(found, found) is None
    assert max(found.slip_odds.values()) < -SURE


def test_a_loop_that_was_chosen_shows_a_slip_or_nothing(bad, monkeypatch):
    """A step is cut and put back, and loops come in; but the first was the best of many."""
    growth = grown(bad.graph)
    (step,) = np.flatnonzero(~growth.given.is_loop & (growth.given.low == STEP))
    growth.accepted[growth.accepted & growth.given.spanning(step)] = False
    growth.solve()
    tried = slips._tried
    monkeypatch.setattr(slips, '_tried', lambda *given: (
        (step, state, costs or chosen) for step, state, costs in tried(*given)))
    monkeypatch.setattr(slips, '_told', lambda growth, shown: [])
    monkeypatch.setattr(slips, 'with_runs', lambda growth: None)
    chosen = 0.0
    assert without_slip(growth, growth)
    chosen = growth.given.log_odds_of_place
    assert without_slip(growth, growth) is None


def test_where_no_loops_across_agree_a_step_is_not_cut_for_an_unusual_motion(bad, monkeypatch):
    """Nothing accepted spans it, so each side stays as it is: no map is made to find that out."""
    growth = grown(bad.graph.subset(np.arange(len(bad.graph.between))))
    growth.accepted[growth.given.spanning(STEP)] = False
    growth.solve()
    left_out = growth.given.is_loop & ~growth.accepted
    monkeypatch.setattr(Growth, 'solve', lambda growth: pytest.fail('solved'))
    growth.given.factors.measurement[left_out] += np.random.default_rng(0).normal(
        0.0, 50.0, (np.count_nonzero(left_out), 3))
    assert without(growth, STEP) is None


@pytest.mark.parametrize('seed, turn', [(0, 0.01), (1, 0.02)])
def test_odometry_that_drifts_did_not_slip(seed, turn):
    """A hundredth of a radian more on each metre; of twice that most loops were refused."""
    world = careful_world(400, 440, seed)
    odometry = world.graph.between.is_odometry
    way = np.linalg.norm(world.graph.between.measurement[odometry, :2], axis=1)
    drift = slipped(world.graph, np.arange(399), way[:, None] * [0.0, 0.0, turn])
    judgement, poses = robust_solve(drift)
    assert judgement.accepted.all() and not judgement.doubts
    assert position_error(poses, world.truth) < 0.3


@pytest.mark.parametrize('keyframe', [106, 276])
def test_two_slips_that_cancel_are_doubted(bad, keyframe):
    """The loops of one keyframe say, and all others have nothing against it, that it is off."""
    truth, near = bad.truth.copy(), np.array([keyframe - 1, keyframe])
    truth[keyframe] = se2.retract(truth[keyframe], np.array([0.0, 5.0, 0.0]))
    Z = bad.graph.between.measurement.copy()
    rows = np.flatnonzero(bad.graph.between.is_odometry & np.isin(bad.graph.between.i, near))
    Z[rows] = se2.between(truth[near], truth[near + 1])
    judgement, _ = robust_solve(retold(bad.graph, Z))
    assert not len(judgement.slips)
    doubt, = judgement.doubts
    assert doubt.kind == OTHER_MAP and keyframe in (doubt.first, doubt.last)


def test_where_the_odometry_jumped_it_slipped(bad):
    """Nothing else tells: no loop is left that spans the step."""
    growth = grown(slipped(bad.graph, STEP, (5.0, 0.0, 0.0)))
    odds = log_odds_of_slips(growth, usual_motion(growth))
    assert growth.given.low[np.argmax(odds)] == STEP and odds.max() > 0
    assert np.sort(odds)[-2] < -SURE


def test_where_no_loop_can_tell_an_unusual_motion_is_no_slip(bad):
    """The robot goes on behind its last loop, in other steps than ever before."""
    graph = bad.graph.copy()
    last = graph.n_poses - 1 + np.arange(4)
    graph.add_poses(4)
    graph.add_between(last, last + 1, np.tile([[0.1, 0.0, 0.0]], (4, 1)),
                      np.tile(np.diag([1e4, 1e4, 1e4]), (4, 1, 1)))
    assert robust_solve(graph)[0].doubts == ()


def test_a_robot_does_not_jump_because_lies_say_so(bad):
    """Streets that one transform takes for others agree; but then the robot jumped."""
    graph = bad.graph.copy()
    rng, poses = np.random.default_rng(1), odometry_poses(graph)
    i, j = rng.integers(20, 80, 60), rng.integers(320, 380, 60)
    wrong = np.broadcast_to([40.0, 15.0, 1.0], (60, 3))
    graph.add_between(i, j, se2.compose(se2.compose(se2.inverse(poses[i]), wrong), poses[j]),
                      np.tile(np.diag([100.0, 100.0, 1000.0]), (60, 1, 1)))
    assert repaired(graph) is None


@pytest.mark.parametrize('seed', [0, 5])
def test_a_robot_that_backs_up_but_once_did_not_slip(seed):
    """It is like no other step, and of few loops hardly one can tell; but so the robot moved."""
    world = careful_world(800, 825, seed)
    truth, factors = world.truth.copy(), world.graph.between
    ends = factors.i, factors.j
    noise = se2.local(se2.between(*(truth[end] for end in ends)), factors.measurement)
    heading = truth[STEP + 1, 2]
    truth[STEP + 1:, :2] -= 2 * np.array([np.cos(heading), np.sin(heading)])
    Z = se2.retract(se2.between(*(truth[end] for end in ends)), noise)
    judgement, _ = robust_solve(retold(world.graph, Z))
    assert judgement.accepted.all() and not judgement.doubts


def test_steps_all_alike_leave_no_tail():
    motion = usual_motion(grown(graph_of(straight(31), chain_of(31), 0.0, np.eye(3))))
    like, jump = motion.log_density(np.array([[1.0, 0, 0], [9.0, 0, 0]]))
    assert np.isfinite([like, jump]).all() and like > jump + 10
