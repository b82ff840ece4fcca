# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Absolute poses: they tie the map to the world, and a GPS that jumps is refused."""

import heard
import numpy as np
import pytest
from command import solve_json
from numpy.testing import assert_allclose
from outliers import careful, chain_of, drive_of, solved
from worlds import between, compose, lines_of

# Where the map frame is to the first keyframe: far off, and turned.
FRAME = np.array([100.0, -40.0, 2.0])
POSITION = np.diag([1.0, 1.0, 0.0])


def seen_from_above(drive, every, sigma=0.3, part_false=0.2):
    """Return the odometry of a drive in the world, with some positions 50 m off."""
    rng = np.random.default_rng(3)
    drive = drive.rows(drive.is_odometry)
    drive.truth[:] = compose(FRAME, drive.truth)
    k = np.arange(0, len(drive.truth), every)
    position = drive.truth[k] * [1, 1, 0]
    position[:, :2] += sigma * rng.standard_normal((len(k), 2))
    bad = np.zeros(len(k), bool)
    bad[rng.permutation(len(k))[:round(part_false * len(k))]] = True
    angle = rng.uniform(0, 2 * np.pi, bad.sum())
    position[bad, :2] += 50 * np.stack((np.cos(angle), np.sin(angle)), axis=1)
    pairs = np.stack((np.full(len(k), -1), k), axis=1)
    for false in (False, True):
        rows = bad == false
        drive = drive.told(pairs[rows], position[rows], POSITION / sigma**2, false)
    return drive


def error(poses, truth):
    """Return the RMSE of the positions [m], nothing aligned."""
    return np.sqrt(((poses - truth)[:, :2]**2).sum(axis=1).mean())


@pytest.fixture(scope='module')
def world():
    """400 keyframes, a position every twenty, four in twenty of them false."""
    return seen_from_above(careful(400, 600, 3), 20)


@pytest.mark.parametrize('norm', ['l1', 'l2', 'huber'])
def test_false_positions_are_refused_in_every_norm(world, norm):
    found = solved(world, norm)
    assert found.kept == found.lost == 0 and world.false.sum() == 4
    assert error(found.poses, world.truth) < 0.6
    assert found.said['parts'] == 1 and found.said['loops'] == 0
    # By L1 the map is twice as far off as by L2, of which all are sure.
    assert found.doubts == ['another norm'] * (norm == 'l1')


@pytest.mark.parametrize(('norm', 'solver'), [
    ('l1', 'primal-dual'), ('l1', 'interior-point'), ('l2', 'auto'), ('huber', 'auto')])
def test_who_believes_all_gets_the_map_in_the_world(capsys, tmp_path, norm, solver):
    drive = seen_from_above(careful(200, 350, 4), 10, 0.1, 0.0)
    output = tmp_path / 'out.g2o'
    solve_json(capsys, drive.write(tmp_path / 'a.g2o'), '--norm', norm, '--solver', solver,
               '--no-robust', '--output', output)
    poses = np.array([row[1:] for row in lines_of(output, 'VERTEX')], float)
    assert error(poses, drive.truth) < 0.3


@pytest.mark.parametrize('information', [POSITION, np.eye(3), np.diag([0, 0, 1.0])])
def test_a_single_absolute_pose_bends_nothing(information):
    drive = careful(100, 160)
    there = np.array([50.0, 60.0, 2.5])
    found = solved(drive.told([[-1, 30]], [there], information))
    alone = solved(drive)
    speaks = np.diagonal(information) > 0
    assert found.accepted.all()
    assert_allclose(between(there, found.poses[30])[speaks], 0, atol=1e-6)
    steps, before = (between(one.poses[:-1], one.poses[1:]) for one in (found, alone))
    assert_allclose(between(before, steps), 0, atol=1e-6)


@pytest.mark.parametrize('norm', ['l1', 'l2', 'huber'])
def test_two_parts_that_only_positions_tie_together(norm):
    truth = np.cumsum(np.tile([0.9, 0.2, 0.01], (60, 1)), axis=0)
    truth[:, 1] += np.sin(np.arange(60) / 5)
    drive = drive_of(truth).seen(np.delete(chain_of(60), 29, axis=0))
    k = np.array([0, 10, 20, 29, 30, 40, 50, 59])
    drive = drive.told(np.stack((np.full(8, -1), k), axis=1), truth[k] * [1, 1, 0], 100 * POSITION)
    found = solved(drive, norm)
    assert found.said['parts'] == 1 and found.accepted.all()
    assert_allclose(between(truth, found.poses), 0, atol=1e-4)


@pytest.mark.parametrize('robust', [True, False])
@pytest.mark.parametrize('trusted', [True, False])
def test_a_running_map_comes_to_the_world_with_the_first_absolute_pose(robust, trusted):
    backend = heard.driven(heard.straight(20), {'robust.enabled': robust})
    backend.update()
    there = compose(FRAME, np.array([10.0, 0.0, 0.0]))
    backend.add_loop(heard.loop(None, 1.0, there, 0.01 * np.eye(6), trusted=trusted))
    while backend.update() is not None:
        pass
    ends = compose(FRAME, np.array([[0.0, 0, 0], [19, 0, 0]]))
    assert_allclose(between(backend.poses[[0, -1]], ends), 0, atol=0.05)
