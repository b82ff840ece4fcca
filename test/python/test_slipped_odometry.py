# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Odometry that slipped is named and left out; what is no slip is not."""

from dataclasses import replace

import numpy as np
import pytest
from outliers import SURE, careful, chain_of, drive_of, laps, solved
from worlds import between, compose

STEP, QUARTER = 200, [0.0, 0.0, np.pi / 2]
CAREFUL = 0.05, 0.005


@pytest.fixture(scope='module')
def bad():
    """401 true loops, 100 false ones."""
    return careful(400, 800, lies=100)


def slips_are_found(drive, steps, error=0.4, near=0):
    """Solve a drive and check that these steps alone slipped, and that all else is right."""
    found = solved(drive)
    assert len(found.slips) == len(steps) and not found.doubts
    assert np.abs(np.subtract(found.slips, steps)).max() <= near
    assert found.kept == 0 and found.error < error and found.said['parts'] == 1
    return found


@pytest.mark.parametrize(('steps', 'off'), [
    ([STEP], [5.0, 0.0, 0.0]), ([STEP], QUARTER), ([100, 180], [5.0, 0.0, 0.0]),
    ([150, 230, 310], [0.0, 0.0, 0.7])])
def test_slips_are_found_together(bad, steps, off):
    """Each bends what the loops across the others say; true loops are all in."""
    assert slips_are_found(bad.slipped(steps, off), steps, 0.2).lost - len(steps) <= 2


@pytest.mark.parametrize(('stated', 'turn', 'named'), [
    (1.0, 0.14, [STEP]), (4.0, 0.056, []), (4.0, 0.2, []), (10.0, 0.14, [])])
def test_what_is_within_the_noise_as_stated_is_no_slip(bad, stated, turn, named):
    """Though loops that know better speak against it: they hold the map all the same."""
    found = solved(bad.slipped([STEP], [0.0, 0.0, turn]).restated(stated, stated))
    assert found.slips == named and found.error < 0.2 and not found.doubts


@pytest.mark.parametrize(('world', 'steps', 'off'), [
    # All of its few loops fit by noise ten times as large.
    ((300, 312, 3, 4), [100, 200], [2.0, 0.0, 0.0]),
    # Far loops alone say how the robot moved: they know it to hundreds of its sigmas.
    ((400, 440, 1, 15), [160, 200], [[0.0, 0.0, 1.5], [0.0, 0.0, -1.5]]),
    # Two of three leave the loops across the third in a map that is off as far.
    ((300, 389, 3, 30), [90, 150, 220], [0.0, 0.0, 1.5])])
def test_slips_of_which_each_explains_little(world, steps, off):
    slips_are_found(careful(*world).slipped(steps, off), steps, 1.0)


@pytest.mark.parametrize(('n', 'rounds', 'loops', 'lies', 'steps', 'off'), [
    (300, 2, 120, 40, [100, 180], [0.0, 3.0, 0.0]), (240, 3, 100, 33, [100, 110], [0.0, 2.0, 0.0]),
    (358, 2, 150, 33, [49], [0.0, 0.0, 1.48]), (441, 3, 170, 63, [110, 404], [0.0, 0.0, 1.48])])
def test_where_all_loops_along_a_lap_are_of_one_place_they_still_tell_of_slips(
        n, rounds, loops, lies, steps, off):
    slips_are_found(laps(n, rounds, loops, CAREFUL, lies=lies).slipped(steps, off), steps)


@pytest.fixture(scope='module')
def way_and_back():
    """About two corners and back again, with 25 loops from the one way to the other."""
    rng = np.random.default_rng(0)
    heading = np.repeat([0.0, np.pi / 2, 0.0], 50)
    out = np.cumsum(np.column_stack((np.cos(heading), np.sin(heading))), axis=0)
    truth = np.column_stack((np.concatenate((out, out[::-1] + rng.normal(0, 0.2, out.shape))),
                             np.concatenate((heading, heading[::-1] + np.pi))))
    first = np.sort(rng.choice(len(out) - 10, 25, replace=False))
    pairs = np.concatenate((chain_of(len(truth)), np.stack((first, len(truth) - 1 - first), 1)))
    noise = rng.standard_normal((len(pairs), 3)) / np.sqrt(np.diag(SURE))
    return drive_of(truth).seen(pairs, noise)


@pytest.mark.parametrize('steps', [
    [60, 130, 200],  # each alone leaves a motion as no robot moves
    [110, 140, 250]])  # the same loops span the last one on the way out
def test_slips_that_no_loop_tells_apart_from_others(way_and_back, steps):
    slips_are_found(way_and_back.slipped(steps, QUARTER), steps, 1.0)


@pytest.fixture(scope='module')
def block():
    """Once round a block, with one loop of its ends and three along the way."""
    heading = np.cumsum(np.pi / 2 * (np.arange(80) % 20 == 0)) - np.pi / 2
    steps = np.column_stack((np.cos(heading), np.sin(heading)))[:-1]
    way = np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0)))
    pairs = np.concatenate((chain_of(80), [[0, 79], [1, 3], [5, 8], [70, 74]]))
    sure = np.diag([400.0, 400.0, 1e4])
    noise = np.random.default_rng(1).standard_normal((len(pairs), 3)) / np.sqrt(np.diag(sure))
    return drive_of(np.column_stack((way, heading))).seen(pairs, noise, sure)


@pytest.mark.parametrize(('step', 'off'), [
    (45, [0.0, 0.0, -np.pi / 2]), (30, [5.0, 0.0, 0.0])])
def test_one_loop_shows_a_slip_after_which_the_robot_moved_on_as_ever(block, step, off):
    """To turn by a right angle is nothing unusual there, so nothing else tells of it."""
    assert slips_are_found(block.slipped([step], off), [step], 1.0).lost == 1


@pytest.mark.parametrize('seed', range(2))
def test_one_loop_that_lies_is_no_slip(block, seed):
    """After a slip that fits it, the robot would have moved as it never does."""
    off = np.random.default_rng(seed).normal(0.0, [8.0, 8.0, 2.0])
    lie = block.pairs[:, 1] - block.pairs[:, 0] == 79
    drive = block.rows(~lie).told([[0, 79]], [off], block.information[0], True)
    found = solved(drive)
    assert found.kept == found.lost == 0 and not found.slips and not found.doubts


@pytest.mark.parametrize(('turn', 'count'), [(0.0, 20), (np.pi / 2, 20), (np.pi / 2, 4)])
def test_a_slip_that_one_place_alone_shows_is_cut(turn, count):
    """The second lap's loops are refused first; those of the first half do not span the step."""
    angle = 2 * np.pi * np.arange(620) / 600
    ring = drive_of(np.column_stack((95 * np.cos(angle), 95 * np.sin(angle), angle)))
    back, near, rng = np.arange(count), np.arange(0, 240, 6), np.random.default_rng(0)
    pairs = np.concatenate((chain_of(620), np.stack((back, back + 600), axis=1),
                            np.stack((near, near + 6), axis=1)))
    noise = rng.standard_normal((len(pairs), 3)) * [0.05, 0.05, 0.005]
    found = solved(ring.seen(pairs, noise).slipped([400], [0.0, 0.0, turn]))
    assert found.slips == [400] * bool(turn) and found.lost == len(found.slips)
    assert not found.doubts


@pytest.mark.parametrize('keyframe', [106, 276])
def test_two_slips_that_cancel_bend_no_map(bad, keyframe):
    """The loops of one keyframe say that it is off, and all others have nothing against it."""
    truth, near = bad.truth.copy(), np.array([keyframe - 1, keyframe])
    truth[keyframe] = compose(truth[keyframe], np.array([0.0, 5.0, 0.0]))
    rows = np.flatnonzero(bad.is_odometry & np.isin(bad.pairs[:, 0], near))
    measured = bad.measured.copy()
    measured[rows] = between(truth[near], truth[near + 1])
    found = solved(replace(bad, measured=measured))
    assert not found.slips and found.error < 0.5
    assert keyframe in np.array(found.said['rejected'] + found.said['suspect'])


def test_an_unusual_motion_that_no_loop_spans_is_no_slip(bad):
    """The robot goes on behind its last loop, in other steps than ever before."""
    ends = np.array([[399 + k, 400 + k] for k in range(4)])
    drive = bad.told(ends, np.tile([0.1, 0.0, 0.0], (4, 1)), np.diag([1e4, 1e4, 1e4]))
    found = solved(replace(drive, truth=np.append(bad.truth, np.zeros((4, 3)), axis=0)))
    assert not found.slips and not found.doubts


@pytest.mark.parametrize('seed', [0, 5])
def test_a_robot_that_backs_up_but_once_did_not_slip(seed):
    """It is like no other step, and of few loops hardly one can tell; but so the robot moved."""
    world = careful(800, 825, seed)
    i, j = world.pairs.T
    noise = between(between(world.truth[i], world.truth[j]), world.measured)
    truth = world.truth.copy()
    heading = truth[STEP + 1, 2]
    truth[STEP + 1:, :2] -= 2 * np.array([np.cos(heading), np.sin(heading)])
    found = solved(replace(world, truth=truth,
                           measured=compose(between(truth[i], truth[j]), noise)))
    assert found.accepted.all() and not found.doubts and found.error < 1
