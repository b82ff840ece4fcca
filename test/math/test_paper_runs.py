# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The paper's two runs with a draw: a noisy start and loops that lie, and how far off maps end."""

import numpy as np
import pytest

from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.paper import figures, printed, runs
from l1slam_ros.paper.runs import NOISES, off


@pytest.fixture(scope='module')
def world():
    return simulate_world(80, 160, WorldOptions(), np.random.default_rng(3))


@pytest.fixture(scope='module')
def liars(world):
    return runs.run_false_loops(world.graph, world.odometry, 3, np.random.default_rng(0))


def test_noise_has_its_size_in_every_axis_of_every_pose(rng):
    world = simulate_world(3000, 4000, WorldOptions(), np.random.default_rng(3))
    noisy = runs.with_noise(world.graph, world.truth, 0.2, rng)
    step = world.graph.manifold.local(world.truth, noisy)
    np.testing.assert_allclose(step.std(axis=0), 0.2, rtol=0.05)
    np.testing.assert_allclose(step.mean(axis=0), 0, atol=0.015)


def test_the_start_that_is_drawn_is_the_first_that_l2_does_not_survive(world, rng, monkeypatch):
    run = runs.run_noisy_start(world.graph, world.odometry, rng)
    size = np.linalg.norm(np.ptp(world.odometry[:, :2], axis=0))
    assert NOISES[0] < run.noise and off(world.graph, run.l2, run.l1) > 0.02 * size
    assert off(world.graph, run.start, run.l1) > off(world.graph, run.seed, run.l1) > 0
    # With less noise L2 makes the same of any start.
    monkeypatch.setattr(runs, 'NOISES', NOISES[:1])
    least = runs.run_noisy_start(world.graph, world.odometry, rng)
    assert least.noise == NOISES[0] and off(world.graph, least.l2, run.l1) < 0.02 * size


def test_the_robust_map_is_the_clean_one_and_hubers_is_not(liars):
    np.testing.assert_array_equal(liars.accepted, ~liars.false)
    robust, huber = (off(liars.graph, poses, liars.clean) for poses in (liars.robust, liars.huber))
    assert robust < 1e-6 < 1e-2 < huber


def test_each_panel_shows_its_loops_on_the_clean_map(world, liars):
    clean, *panels, robust = figures._panels('Intel', world.graph, liars)
    true, false = (liars.graph.between.pairs[mask] for mask in (
        ~liars.graph.between.is_odometry & ~liars.false, liars.false))
    for drawing in panels:
        np.testing.assert_array_equal(drawing.loops, true)
        np.testing.assert_array_equal(drawing.false, false)
        apart = np.linalg.norm(drawing.positions - clean.positions, axis=1)
        assert drawing.note == f'{np.sqrt((apart**2).mean()):.2f} m off'
    np.testing.assert_array_equal(robust.rejected, false)
    assert not len(robust.false) and clean.note.startswith('L1 cost ')
    assert set(printed.FALSE_LOOPS) == {printed.INTEL, printed.MANHATTAN_3500}
