# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Absolute poses: they tie the map to the world, and a GPS that jumps is refused."""

import numpy as np
import pytest
from fixes import FRAME, seen
from numpy.testing import assert_allclose
from problems import (
    PERIOD,
    add_absolute,
    covariance6,
    drive,
    drive_on,
    graph_of,
    seconds,
    straight,
)

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.first_fixes import first_fixes
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.robust.batch_map import SolveOptions, solve
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.core.running.snapshot import ACCEPTED
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import read_graph_file

POSITION = np.diag([1.0, 1.0, 0.0])[None]


@pytest.fixture(scope='module')
def manhattan(datasets):
    """The paper's graph and its true poses."""
    truth = np.loadtxt(datasets / 'manhattan3500.truth.txt')[:, 1:]
    return read_graph_file(datasets / 'manhattan3500.g2o').graph, truth


@pytest.mark.parametrize('part_false', [0.0, 0.1])
def test_a_position_every_hundred_keyframes_holds_a_world_without_loops(manhattan, part_false):
    """What the odometry states is 40 times what it errs by, so the positions lead alone."""
    world = seen(*manhattan, 100, np.random.default_rng(1), part_false)
    outcome = solve(world.graph, None, SolveOptions(norm='l2'))
    factors, judgement = world.graph.between, outcome.judgement
    assert factors.j[~judgement.accepted].tolist() == world.false.tolist()
    assert factors.is_absolute[~judgement.accepted].all() and judgement.doubt is None
    assert world.error(outcome.solution.poses) < 1.35
    # As good as if somebody had said which are false.
    known = world.graph.subset(judgement.accepted)
    told = solve(known, None, SolveOptions(norm='l2', robust=False)).solution
    assert world.error(outcome.solution.poses) == pytest.approx(
        world.error(told.poses), rel=1e-3)


@pytest.fixture(scope='module')
def world():
    """A world of 400 keyframes, a position every twenty, four in twenty of them false."""
    rng = np.random.default_rng(3)
    made = simulate_world(400, 600, WorldOptions(), rng)
    return seen(made.graph, made.truth, 20, rng, 0.2, sigma=0.3)


@pytest.mark.parametrize('norm', ['l1', 'l2', 'huber'])
def test_false_positions_are_refused_in_every_norm(world, norm):
    outcome = solve(world.graph, None, SolveOptions(norm=norm))
    assert world.graph.between.j[~outcome.judgement.accepted].tolist() == world.false.tolist()
    assert world.error(outcome.solution.poses) < 0.6
    assert outcome.parts == 1


@pytest.mark.parametrize(('norm', 'solver'), [
    ('l1', 'primal-dual'), ('l1', 'interior-point'), ('l2', 'auto'), ('huber', 'auto')])
def test_who_believes_all_gets_the_map_in_the_world(norm, solver):
    made = simulate_world(200, 350, WorldOptions(), np.random.default_rng(4))
    world = seen(made.graph, made.truth, 10, np.random.default_rng(4), sigma=0.1)
    outcome = solve(world.graph, None, SolveOptions(norm=norm, solver=solver, robust=False))
    assert world.error(outcome.solution.poses) < 0.3


def test_those_that_agree_come_first(world):
    rows, variance = first_fixes(world.graph)
    keyframes = world.graph.between.j[rows]
    assert not np.isin(keyframes, world.false).any() and len(rows) > 8
    assert 0.1 < variance < 10


@pytest.mark.parametrize('information', [POSITION, np.eye(3)[None], np.diag([0, 0, 1.0])[None]])
def test_a_single_absolute_factor_bends_nothing(information, rng):
    world = simulate_world(100, 160, WorldOptions(), rng)
    graph, alone = world.graph, robust_solve(world.graph)[1]
    there = np.array([[50.0, 60.0, 2.5]])
    add_absolute(graph, np.array([30]), there, information)
    found, poses = robust_solve(graph)
    assert found.accepted[-1]
    speaks = np.diagonal(information[0]) > 0
    assert_allclose(se2.local(there, poses[30:31])[0, speaks], 0, atol=1e-6)
    ends = np.arange(99)
    assert_allclose(se2.between(poses[ends], poses[ends + 1]),
                    se2.between(alone[ends], alone[ends + 1]), atol=2e-3)


def test_two_parts_that_only_gps_ties_together(rng):
    truth = drive(60, rng)
    chain = [(k, k + 1) for k in range(59) if k != 29]
    graph = graph_of(truth, chain)
    k = np.array([0, 10, 20, 29, 30, 40, 50, 59])
    add_absolute(graph, k, truth[k] * [1, 1, 0], np.tile(100 * POSITION, (8, 1, 1)))
    for norm in ('l1', 'l2', 'huber'):
        outcome = solve(graph, None, SolveOptions(norm=norm))
        assert outcome.parts == 1 and not outcome.unjudged
        assert_allclose(outcome.solution.poses, truth, atol=1e-4)


def test_a_trusted_pose_stays_whatever_the_others_say(world):
    graph, wrong = world.graph.copy(), world.truth[200:201] + [0.0, 80.0, 0.0]
    graph.add_between(-1, 200, wrong, np.eye(3)[None], True)
    found, _ = robust_solve(graph)
    assert found.accepted[-1]


@pytest.mark.parametrize('robust', [True, False])
@pytest.mark.parametrize('trusted', [True, False])
def test_a_running_map_comes_to_the_world_with_the_first_absolute_pose(robust, trusted):
    backend = Backend(BackendOptions.from_mapping({'robust': {'enabled': robust}}))
    drive_on(backend, straight(20))
    backend.update()
    there = se2.compose(np.array([FRAME]), np.array([[10.0, 0.0, 0.0]]))
    backend.add_loop(LoopClosure(None, seconds(10 * PERIOD), se2.to_pose3(there)[0],
                                 covariance6(0.01 * np.eye(3)), trusted))
    while backend.update() is not None:
        pass
    assert backend.loop_states().state.tolist() == [ACCEPTED]
    ends = se2.compose(np.array(2 * [FRAME]), np.array([[0.0, 0, 0], [19, 0, 0]]))
    assert_allclose(se2.local(backend.poses[[0, -1]], ends), 0, atol=0.05)
