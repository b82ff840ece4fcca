# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A drift of the odometry that loops agree on is taken out of the map; noise and lies are none."""

import numpy as np
import pytest
from command import solve_json
from outliers import careful, chain_of, drive_of, laps, solved, with_lies

DRIFT = 0.05
DOUBT = 'a drift suspected'


@pytest.mark.parametrize(('drift', 'kind', 'norm'), [
    (DRIFT, 'random', 'l1'), (DRIFT, 'identity', 'l2'), (DRIFT, 'grouped', 'l2'),
    (-0.02, 'random', 'l2')])
def test_the_map_is_made_without_the_drift_that_loops_agree_on(drift, kind, norm):
    bad = careful(400, 800, lies=300, kind=kind)
    found = solved(bad.drifting(drift), norm)
    assert found.said['drift'] == pytest.approx(drift, abs=2e-3)
    assert found.kept == 0 and found.error < 0.2 and not found.doubts


@pytest.mark.parametrize(('lies', 'drift', 'taken'), [
    (100, 0.01, True), (100, 0.004, False), (0, 0.002, False)])
def test_a_drift_is_taken_beyond_what_the_odometry_states(lies, drift, taken):
    """Within that it is left, with lies as without: by it no place is won."""
    found = solved(careful(400, 800, lies=lies).drifting(drift).restated(3.0, 3.0))
    assert found.said['drift'] == pytest.approx(drift * taken, abs=1e-3 * taken)
    assert found.error < 0.1 and not found.slips


def test_of_laps_that_are_no_circles_the_drift_that_leaves_the_least_noise_is_taken():
    """By a turn less on each lap all loops fit, too, in a map that is 40 m off."""
    drift = 2 * np.pi / 200
    found = solved(laps(600, 3, 90, (0.05, 0.01), lies=40).drifting(drift))
    assert found.said['drift'] == pytest.approx(drift, abs=1e-3)
    assert found.error < 1 and not found.doubts


def test_laps_that_are_circles_fit_by_a_turn_more_on_each_so_that_the_map_is_less_sure():
    n, radius = 300, 48
    angle = 2 * np.pi * np.arange(2 * n) / n
    truth = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), angle))
    back = np.arange(0, n, 10)
    pairs = np.concatenate((chain_of(2 * n), np.column_stack((back, back + n))))
    noise = np.random.default_rng(0).normal(0, (0.05, 0.05, 0.005), (len(pairs), 3))
    found = solved(drive_of(truth).seen(pairs, noise).drifting(DRIFT))
    turns = (found.said['drift'] - DRIFT) * radius
    assert turns == pytest.approx(round(turns), abs=0.1)
    assert found.said['confidence'] < 0.95


def out_and_back(drift=0.0, seed=0, loops=30, noisier=1.0):
    """Return a way along three corridors and back; its odometry turns too much or is noisier."""
    rng = np.random.default_rng(seed)
    heading = np.repeat(np.cumsum(np.pi / 2 * rng.choice([-1, 1], 3)), 60)
    there = np.cumsum(np.column_stack((np.cos(heading), np.sin(heading))), axis=0)
    truth = np.column_stack((np.concatenate((there, there[::-1] + 0.1)), np.unwrap(
        np.concatenate((heading, heading[::-1] + np.pi)))))
    first = rng.choice(len(there) - 10, loops, replace=False)
    chain = chain_of(len(truth))
    pairs = np.concatenate((chain, np.column_stack((first, len(truth) - 1 - first))))
    noise = rng.standard_normal((len(pairs), 3)) * [0.05, 0.05, 0.005]
    noise[:len(chain)] *= noisier
    return drive_of(truth).seen(pairs, noise).drifting(-drift)


@pytest.mark.parametrize('seed', range(2))
def test_a_drift_that_passes_for_noise_is_taken_out_and_noise_is_none(seed):
    found = solved(out_and_back(0.007, seed))
    assert found.said['drift'] == pytest.approx(-0.007, rel=0.3) and not found.doubts
    assert found.said['confidence'] > 0.9 and found.lost == 0
    straight = solved(out_and_back(0.0, seed))
    assert straight.said['drift'] == 0 and not straight.doubts


def test_a_map_without_an_accepted_loop_is_as_likely_wrong():
    drive, rng = out_and_back(), np.random.default_rng(0)
    rows = np.flatnonzero(~drive.is_odometry)
    drive.measured[rows, :2] += rng.uniform(20, 60, (len(rows), 2))
    found = solved(drive)
    assert found.doubts == ['a weak map'] and found.said['confidence'] < 0.6
    assert not found.accepted[rows].any()


@pytest.mark.parametrize('seed', [3, 6])
def test_a_vague_map_that_has_all_true_loops_is_not_doubtful(seed):
    """It is as right as its factors allow, and no loop that is left out would mend it."""
    drive = with_lies(out_and_back(0.0, seed, 14, noisier=10), 5, np.random.default_rng(seed))
    found = solved(drive)
    assert found.kept == found.lost == 0
    assert found.said['confidence'] > 0.9 and not found.doubts


SIGMAS = np.array([[0.05, 0.05, 0.003], [0.1, 0.1, 0.02]])


def ring(n, loops, seed, lies, noisier=1.0):
    """Return a lap that is not quite round, and closes where it began."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(n + loops) / n
    radius = n / 6.3 * (1 + rng.uniform(0, 0.3) * np.sin(rng.integers(2, 6) * angle))
    way = radius[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
    along = np.gradient(way, axis=0)
    drive = drive_of(np.column_stack((way, np.unwrap(np.arctan2(along[:, 1], along[:, 0])))))
    back = np.arange(loops)
    for pairs, sigmas, times in ((chain_of(n + loops), SIGMAS[0], noisier),
                                 (np.column_stack((back, back + n)), SIGMAS[1], 1.0)):
        noise = times * sigmas * rng.standard_normal((len(pairs), 3))
        drive = drive.seen(pairs, noise, np.diag(sigmas**-2))
    return with_lies(drive, lies, rng)


@pytest.mark.parametrize('seed', [1, 2])
def test_loops_that_agree_begin_a_map_where_odometry_is_far_noisier_than_it_says(seed):
    found = solved(ring(450, 24, seed, 10, noisier=6.0))
    assert found.kept == found.lost == 0 and found.said['drift'] == 0 and not found.doubts


@pytest.mark.parametrize(('n', 'loops', 'seed', 'lies', 'times'), [
    # All that lies say is that keyframes are near each other: in a small world they are.
    (590, 33, 3, 140, (1.0, 1.0)), (583, 25, 1, 10, (0.1, 1.0)), (659, 37, 110, 15, (1.0, 10.0))])
def test_neither_lies_nor_misstated_noise_make_a_drift(n, loops, seed, lies, times):
    found = solved(ring(n, loops, seed, lies).restated(*times))
    assert found.said['drift'] == 0 and found.error < 3


@pytest.mark.parametrize(('drift', 'seed'), [
    (-0.01, 0), (-0.01, 1), (-0.01, 4), (-0.06, 0), (-0.06, 7)])
def test_of_turns_more_that_loops_fit_the_one_is_taken_that_leaves_the_largest_map(drift, seed):
    """The lap may be driven the other way round, which one place cannot tell."""
    found = solved(ring(400, 20, seed, 15).drifting(drift))
    assert found.doubts == [DOUBT] and found.said['confidence'] < 0.9
    assert found.said['drift'] == pytest.approx(drift, abs=2e-3) and found.error < 1
    assert found.kept == found.lost == 0


@pytest.mark.parametrize('seed', [2, 5])
def test_a_jump_that_a_lap_closes_within_its_noise_is_a_slip(seed):
    """No loop is refused for it, but the robot never moved so: the map was off twice as far."""
    found = solved(ring(400, 20, seed, 10).slipped([200], [0.0, 5.0, 0.0]))
    slip, = found.slips
    assert abs(slip - 200) < 5 and not found.doubts and found.error < 1.2


def in_space(drive, path):
    """Write a drive as a graph in space, whose heights and tilts are measured, too."""
    rng, lines = np.random.default_rng(0), []
    for (i, j), (x, y, turn), known in zip(
            drive.pairs, drive.measured, drive.information, strict=True):
        # Of the quaternion's vector part, as g2o means it: half the angle.
        diagonal = [known[0, 0], known[1, 1], 400.0, 4e5, 4e5, 4 * known[2, 2]]
        z, roll, pitch = rng.standard_normal(3) * [0.05, 0.003, 0.003]
        half = np.array([roll / 2, pitch / 2, np.sin(turn / 2), np.cos(turn / 2)])
        half /= np.linalg.norm(half)
        upper = [diagonal[r] * (r == c) for r in range(6) for c in range(r, 6)]
        numbers = ' '.join(f'{number:.9g}' for number in (x, y, z, *half, *upper))
        lines.append(f'EDGE_SE3:QUAT {i} {j} {numbers}\n')
    path.write_text(''.join(lines))
    return path


def test_a_drift_about_the_vertical_is_found_in_space(tmp_path, capsys):
    bad = careful(400, 800, lies=100)
    path = in_space(bad.drifting(DRIFT), tmp_path / 'space.g2o')
    solved_map = tmp_path / 'solved.g2o'
    said = solve_json(capsys, path, '--output', solved_map)
    assert said['drift'] == pytest.approx(DRIFT, abs=2e-3) and not said['doubts']
    assert {tuple(pair) for pair in said['rejected'] + said['suspect']} == {
        tuple(pair) for pair in bad.pairs[bad.false].tolist()}
    # What is written is the map, and what was measured stands beside it.
    again = solve_json(capsys, solved_map)
    assert again['drift'] == pytest.approx(said['drift'], abs=1e-9)
    assert again['final_cost'] == pytest.approx(said['final_cost'], rel=1e-6)
