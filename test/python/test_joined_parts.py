# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Parts of a map that no odometry joins, of one robot or of many: by loops, or not at all."""

import numpy as np
import pytest
from outliers import careful, chain_of, drive_of, solved
from worlds import position_error

SEAM = 199


@pytest.fixture(scope='module')
def world():
    """401 true loops, and a gap of the odometry may be made behind keyframe `SEAM`."""
    return careful(400, 800)


def across(drive):
    """Tell which edges are between the two halves, (m,) bool."""
    low, high = np.sort(drive.pairs).T
    return (low <= SEAM) & (high > SEAM)


@pytest.mark.parametrize('joined', [True, False])
def test_two_sessions_are_joined_by_loops_or_stay_two_parts(joined):
    bad = careful(400, 800, lies=170)
    found = solved(bad.rows(~(across(bad) & bad.is_odometry) if joined else ~across(bad)))
    assert found.said['parts'] == (1 if joined else 2) and found.kept == 0 and found.lost <= 1
    assert found.doubts == ['parts'] * (not joined)
    for half in [slice(0, 400)] if joined else [slice(0, 200), slice(200, 400)]:
        assert position_error(found.poses[half, :2], bad.truth[half, :2]) < 0.2


@pytest.mark.parametrize('joined', [True, False])
def test_a_step_that_says_next_to_nothing_joins_no_parts(world, joined):
    step = world.is_odometry & across(world)
    drive = world.rows(np.arange(len(step)))
    drive.information[step] *= 1e-6
    found = solved(drive.rows(step | ~across(world) | joined))
    assert found.said['parts'] == (1 if joined else 2)
    assert found.doubts == ['parts'] * (not joined)


@pytest.mark.parametrize('ends', [
    [(16, 204), (14, 205)], [(134, 204), (136, 204), (135, 205)],
    # Nothing agrees with a single one; two are of two places.
    [(16, 204)], [(16, 204), (61, 200)]])
def test_loops_of_one_place_that_alone_join_two_parts_are_left_out_and_named(world, ends):
    halves = world.rows(~across(world))
    found = solved(halves.seen(ends, information=world.information[~world.is_odometry][0]))
    assert found.said['parts'] == 2 and found.lost == np.count_nonzero(found.suspect) == len(ends)
    assert found.doubts == ['parts']
    assert found.said['doubts'][0]['loops'] == [list(pair) for pair in ends]


@pytest.mark.parametrize('run', [20, 0])
def test_a_long_run_between_two_parts_against_several_places_is_doubtful(run):
    """Two laps that no odometry joins; places opposite each other look alike, one way is seen."""
    n = 120
    angle = 2 * np.pi * np.arange(2 * n) / n
    drive = drive_of(np.column_stack((20 * np.cos(angle), 20 * np.sin(angle), angle)))
    chain = np.delete(chain_of(2 * n), n - 1, axis=0)
    seen, alike = np.arange(10, 10 + run), np.arange(12, 60, 8)
    pairs = np.concatenate((chain, np.column_stack((seen, seen + n)),
                            np.column_stack((alike, alike + n))))
    noise = np.random.default_rng(2).standard_normal((len(pairs), 3)) * [0.02, 0.02, 0.002]
    drive = drive.seen(pairs, noise, np.diag([2500.0, 2500.0, 250_000.0]))
    # The second keyframe of such a pair is said to be where the robot was half a lap later.
    drive.pairs[-len(alike):, 1] = n + (alike + n // 2) % n
    found = solved(drive)
    assert np.flatnonzero(~found.accepted).tolist() == [*range(len(chain), len(chain) + run)]
    assert found.doubts == ['another map'] * (run > 0)
