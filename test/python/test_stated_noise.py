# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""How the map is weighed by the noise that a file states, and by what is found of it."""


import numpy as np
import pytest
from command import run, solve_json
from outliers import SURE, chain_of, drive_of, laps, solved
from worlds import position_error


def test_of_the_identity_what_a_turn_is_worth_is_found_and_weighs_the_map():
    """A radian is no metre: as if it were, right loops make a map that is twice as far off."""
    bad = laps(600, 3, 90, (0.02, 0.003), lies=60)
    identity = bad.told(np.zeros((0, 2), int), np.zeros((0, 3)))
    identity.information[:] = np.eye(3)
    found, stated = solved(identity), solved(bad)
    assert found.kept == found.lost == 0 and not found.doubts
    assert found.error < 1.1 * stated.error


STEP, LOOP = np.array([0.03, 0.03, 0.0005]), np.array([1.0, 1.0, 0.1])
# Loops of each place.
COUNTS = np.array([50, *[8] * 7])


def rounds_of(shared, stated=1.0, seed=0):
    """Return two rounds with loops that share a part of their error by place."""
    rng, angle = np.random.default_rng(seed), 2 * np.pi * np.arange(400) / 200
    truth = np.column_stack((32 * np.sin(angle), 32 * (1 - np.cos(angle)), angle))
    first = np.concatenate([start + np.arange(count) for start, count in zip(
        (0, *range(64, 190, 18)), COUNTS, strict=True)])
    own, common = (rng.standard_normal((m, 3)) for m in (COUNTS.sum(), len(COUNTS)))
    error = LOOP * (np.sqrt(1 - shared) * own + np.sqrt(shared) * common.repeat(COUNTS, axis=0))
    drive = drive_of(truth).seen(
        chain_of(400), STEP * rng.standard_normal((399, 3)), np.diag(STEP**-2))
    return drive.seen(np.stack((first, first + 200), axis=1), error,
                      np.diag((stated * LOOP)**-2))


TOGETHER = 'the errors of loops of one place are correlated: each place counts as one loop'


def test_loops_that_err_together_are_worth_one_in_the_map(capsys, tmp_path):
    """And the cost is told by what the file says of the noise."""
    errors = np.zeros(2)
    for seed in range(3):
        drive = rounds_of(0.9, 0.4, seed)
        judged = solved(drive)
        assert judged.lost <= 0.1 * COUNTS.sum()
        path, output = drive.write(tmp_path / f'{seed}.g2o'), tmp_path / f'{seed}.tum'
        stated = solve_json(capsys, path, '--norm', 'l2', '--no-robust', '--output', output)
        assert judged.said['final_cost'] > stated['final_cost']
        errors += judged.error, position_error(np.loadtxt(output)[:, 1:3], drive.truth[:, :2])
    assert errors[0] < errors[1]
    assert TOGETHER in run(capsys, 'solve', path, code=None)[0]


@pytest.mark.parametrize(('shared', 'stated'), [(0.0, 1.0), (0.0, 0.3), (0.9, 1.0)])
def test_loops_keep_the_optimum_they_state_unless_that_is_wrong_beyond_doubt(
        capsys, tmp_path, shared, stated):
    """Each errs for itself, or all by no more than they say."""
    drive = rounds_of(shared, stated)
    path = drive.write(tmp_path / 'a.g2o')
    best = solve_json(capsys, path, '--norm', 'l2', '--no-robust')['final_cost']
    assert solved(drive).said['final_cost'] == pytest.approx(best, rel=1e-9)
    assert TOGETHER not in run(capsys, 'solve', path, code=None)[0]


def test_a_lone_far_loop_is_taken_with_a_doubt():
    """A drive straight on: nothing but the drift says whether a loop to its start may be true."""
    turn = np.tile([1.0, 0.0, np.pi / 200], (399, 1))
    drive = drive_of(np.zeros((400, 3))).told(chain_of(400), turn, np.diag([4.0, 4.0, 100.0]))
    found = solved(drive.told([[0, 399]], [[1.0, 20.0, 0.5]], np.diag([100.0, 100.0, 1000.0])))
    assert found.accepted.all() and found.doubts == ['unconfirmed loops']


@pytest.mark.parametrize('loops', [7, 20])
def test_one_place_that_carries_all_is_doubtful_where_odometry_hardly_bears_it_out(loops):
    """However many loops there are, they may be one mistake."""
    angle = 2 * np.pi * np.arange(600 + loops) / 600
    drive = drive_of(np.column_stack((20 * np.cos(angle), 20 * np.sin(angle), angle)))
    back = np.arange(loops)
    pairs = np.concatenate((chain_of(len(angle)), np.stack((back, back + 600), axis=1)))
    noise = np.random.default_rng(2).standard_normal((len(pairs), 3)) * [0.05, 0.05, 0.005]
    found = solved(drive.seen(pairs, noise, SURE))
    assert found.accepted.all() and found.doubts == ['unconfirmed loops']
