# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""False loops are refused, true ones kept, whatever the file says of its noise and its order."""


import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from outliers import careful, chain_of, drive_of, laps, solved
from worlds import between, compose, whitened

import l1slam_ros as l1


@pytest.fixture(scope='module')
def world():
    """401 true loops."""
    return careful(400, 800)


@pytest.fixture(scope='module')
def half():
    """As many false loops as true ones, in runs that agree."""
    return careful(400, 800, lies=401, kind='grouped')


@pytest.fixture(scope='module')
def found(half):
    """Its map."""
    return solved(half)


@pytest.mark.parametrize(('kind', 'count'), [
    ('random', 1600), ('identity', 401), ('grouped', 20)])
def test_false_loops_are_refused_and_true_ones_kept(kind, count):
    found = solved(careful(400, 800, lies=count, kind=kind))
    assert found.kept == 0 and found.lost <= 1 and found.error < 0.1
    assert not found.slips and not found.doubts and found.said['drift'] == 0
    assert found.said['confidence'] > 0.95
    # All but a few are off by more than chance: they are refused, not suspect.
    assert np.count_nonzero(found.suspect) <= 0.05 * count


def test_a_clean_graph_keeps_its_loops_and_a_chain_is_its_odometry(world):
    found = solved(world)
    assert found.accepted.sum() >= len(world.pairs) - 1 and found.error < 0.1
    alone = solved(world.rows(world.is_odometry))
    assert alone.accepted.all() and alone.said['confidence'] is None
    steps = between(world.measured[world.is_odometry],
                    between(alone.poses[:-1], alone.poses[1:]))
    assert_allclose(steps, 0, atol=1e-6)


@pytest.mark.parametrize('norm', ['l1', 'l2', 'huber', 'group-l1'])
def test_the_map_is_an_optimum_of_the_norm_over_what_is_accepted(tmp_path, half, found, norm):
    graph, _ = l1.read_graph(half.write(tmp_path / 'a.g2o'))
    solution = l1.solve(graph, norm=norm)
    assert_array_equal(solution.inliers, found.accepted)  # the choice is the same in every norm
    good, _ = l1.read_graph(half.rows(~half.false).write(tmp_path / 'good.g2o'))
    best = l1.solve(good, norm=norm, robust=False)
    assert solution.cost == pytest.approx(best.cost, rel=1e-4)
    if norm in ('l1', 'l2'):
        power = 1 if norm == 'l1' else 2
        residual = whitened(graph, solution.poses)[found.accepted]
        assert solution.cost == pytest.approx((np.abs(residual)**power).sum(), rel=1e-9)


def test_the_same_graph_gives_the_same_map_however_its_edges_came(half, found):
    """In whatever order, and whichever end is named first."""
    rng = np.random.default_rng(0)
    order = rng.permutation(len(half.pairs))
    pairs, Z, information = half.pairs.copy(), half.measured.copy(), half.information.copy()
    rows = np.flatnonzero(rng.random(len(order)) < 0.5)
    pairs[rows], Z[rows] = pairs[rows, ::-1], between(Z[rows], np.zeros(3))
    # The covariance of the way back is Ad_Z C Ad_Z', so the information Ad_Z^-T L Ad_Z^-1.
    for row in rows:
        x, y, theta = Z[row]
        adjoint = np.array([[np.cos(theta), -np.sin(theta), y], [np.sin(theta), np.cos(theta), -x],
                            [0, 0, 1]])
        information[row] = adjoint.T @ information[row] @ adjoint
    other = drive_of(half.truth).told(pairs[order], Z[order], information[order])
    again = solved(other)
    assert found.kept == found.lost == 0
    assert_allclose(again.poses, found.poses, atol=3e-4)
    assert_array_equal(again.accepted, found.accepted[order])
    assert_array_equal(again.suspect, found.suspect[order])


def test_a_loop_told_twice_vouches_for_nothing():
    bad = careful(400, 800, lies=170, kind='grouped').slipped([200], [1.0, 0.0, 0.0])
    loops = ~bad.is_odometry
    again = bad.told(bad.pairs[loops], bad.measured[loops].round(5), bad.information[loops])
    once, twice = solved(bad), solved(again)
    assert_array_equal(twice.accepted, np.append(once.accepted, once.accepted[loops]))
    assert twice.doubts == once.doubts and twice.slips == once.slips == [200]
    assert twice.said['confidence'] == pytest.approx(once.said['confidence'], rel=1e-9)


@pytest.mark.parametrize('trusted', [True, False])
def test_what_a_person_vouches_for_is_in_and_others_may_lean_on_it(trusted):
    """Two loops that agree, far off the odometry: both are in if one is vouched for."""
    rng, angle = np.random.default_rng(0), 2 * np.pi * np.arange(160) / 200
    truth = np.column_stack((32 * np.sin(angle), 32 * (1 - np.cos(angle)), angle))
    sigmas = np.array([0.3, 0.3, 0.03])
    drive = drive_of(truth).seen(
        chain_of(160), sigmas * rng.standard_normal((159, 3)), np.diag(sigmas**-2))
    drive = drive.seen([(10, 100), (11, 101)], [0.0, 0.0, 2.5], np.diag([100.0, 100.0, 1e3]))
    found = solved(drive, trusted=[(10, 100)] * trusted)
    assert found.accepted[-2:].tolist() == [trusted, trusted]


@pytest.mark.parametrize(('odometry', 'loops'), [
    (1e-2, 1), (1e2, 1), (1, 1e-2), (1, 1e2), (1e-3, 1e-3), (1e3, 1e3)])
def test_misstated_information_changes_no_decision(odometry, loops):
    found = solved(careful(300, 420, lies=100).restated(odometry, loops))
    assert found.kept == 0 and found.lost <= 2 and found.error < 0.6 and not found.doubts


@pytest.mark.parametrize('times', [1e-4, 1e4])
@pytest.mark.parametrize('odometry', [True, False], ids=['odometry', 'loops'])
def test_of_sharp_odometry_one_true_loop_in_fifty_is_refused_at_most(odometry, times):
    """Odometry far better than the loops: the weights of the one are lost in the others'."""
    bad = laps(800, 5, 160, (1e-3, 1e-4), lies=70)
    found = solved(bad.restated(*((times, 1.0) if odometry else (1.0, times))))
    assert found.kept == 0 and found.lost <= 160 / 50 and not found.doubts
    assert found.error < 0.5


@pytest.mark.parametrize('times', [1.0, 10.0])
def test_noise_stated_too_large_lets_in_no_loop_that_is_off_by_metres(world, times):
    """A corridor that looks alike everywhere is wrong by metres, not by the width of the map."""
    rng = np.random.default_rng(0)
    loops = np.flatnonzero(~world.is_odometry & (world.pairs[:, 1] < 390))
    lies, along = rng.choice(loops, 80, replace=False), np.zeros((80, 3))
    along[:, 0] = rng.choice([-1, 1], 80) * rng.uniform(1.0, 5.0, 80)
    bad = world.seen(world.pairs[lies] + [2, 3], along, world.information[loops[0]], True)
    found = solved(bad.restated(times, times))
    assert found.kept == found.lost == 0


@pytest.mark.parametrize('runs', [1, 3])
def test_a_corridor_taken_for_another_is_no_slip(world, runs):
    starts = [(20, 220), (70, 300), (120, 260)][:runs]
    found = solved(alike(world, starts, 30))
    assert found.kept == 0 and not found.slips and found.error < 0.1


def alike(drive, starts, length):
    """Return the drive with false runs of loops (i + k, j + k) that agree that j is elsewhere."""
    pairs = np.concatenate([np.array(start) + np.arange(length)[:, None] for start in starts])
    i, j = drive.truth[pairs.T]
    off = between(i, compose(np.array([8.0, -6.0, 0.4]), j))
    return drive.told(pairs, off, np.diag([400.0, 400.0, 1e4]), True)


@pytest.mark.parametrize('contradicted', [True, False])
def test_half_a_map_that_says_it_is_elsewhere_is_doubtful_unless_loops_contradict(contradicted):
    """109 true loops against 54, of nine places, that agree with each other."""
    bad = alike(careful(500, 499 + 109), [(5 + 20 * k, 260 + 20 * k) for k in range(9)], 6)
    low, high = bad.pairs.T
    across = ~bad.is_odometry & ~bad.false & (low < 220) & (high >= 220)
    found = solved(bad if contradicted else bad.rows(~across))
    assert found.kept == 0
    assert ('another map' in found.doubts) == (not contradicted)
    assert not contradicted or found.said['confidence'] > 0.9


def test_loops_stated_too_vague_come_in_with_their_tails():
    """Noise of heavy tails, stated 1000 times too large: lies are out, the tails are in."""
    bad, rng = careful(400, 800, lies=100), np.random.default_rng(0)
    rows = np.flatnonzero(~bad.is_odometry & ~bad.false)
    tails = rng.standard_normal((len(rows), 3)) * np.sqrt(2 / rng.chisquare(2, (len(rows), 1)))
    bad.measured[rows] = compose(bad.measured[rows], tails * [0.05, 0.05, 0.01])
    found = solved(bad.restated(1e3, 1e3))
    assert found.kept == 0 and found.lost <= 4
