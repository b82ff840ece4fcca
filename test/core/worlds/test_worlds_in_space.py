# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Drives in space: their shapes, and that what was measured along them is solved and recorded."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import EVERY, play

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry import se3
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.names import WORLDS
from l1slam_ros.core.robust.door import solve
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS
from l1slam_ros.core.worlds.in_space import DRIVES
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world, with_false_loops


@pytest.fixture
def world(rng):
    """A building with true loops, and with random lies."""
    made = simulate_world(150, 330, WorldOptions(), rng, 'building')
    return made, with_false_loops(made, FALSE_LOOPS['random'](made.graph, made.truth, 40, rng))


@pytest.mark.parametrize('name', sorted(DRIVES))
@pytest.mark.parametrize('n', [1, 2, 500])
def test_a_drive_goes_where_it_looks_in_even_steps(name, n, rng):
    truth = DRIVES[name](n, 0.5, 5, rng)
    assert_allclose(truth[:1], se3.identity(1), atol=1e-12)
    assert len(truth) == n
    step = np.diff(truth[:, :3], axis=0)
    length = np.linalg.norm(step, axis=1)
    assert_allclose(length, 0.5, rtol=0.15 if n > 2 else 0.3)
    assert_allclose(se3.rotation(truth[:-1])[:, :, 0], step / length[:, None], atol=1e-9)


def test_a_building_has_floors_with_ramps_between_them(rng):
    z = DRIVES['building'](1500, 1.0, 5, rng)[:, 2]
    on_floor = np.isclose(z % 3, 0) | np.isclose(z % 3, 3)
    assert set(np.round(z[on_floor] / 3)) <= {0, 1, 2, 3, 4} and z.max() >= 6
    assert 0.05 < 1 - on_floor.mean() < 0.3


def test_a_sphere_and_a_torus_are_round(rng):
    sphere, torus = (DRIVES[name](2000, 1.0, 5, rng)[:, :3] for name in ('sphere', 'torus'))
    extent = np.ptp(sphere, axis=0)
    assert_allclose(extent, 2 * np.sqrt(2000) / np.pi, rtol=0.1)
    # From the first pose, in its axes; so compare with all distances from the middle.
    radius = np.linalg.norm(torus - torus.mean(axis=0), axis=1)
    assert radius.max() / radius.min() == pytest.approx(3, rel=0.05)


def test_a_world_in_space_is_measured_as_it_says(rng):
    for name in WORLDS[1:]:
        made = simulate_world(200, 500, WorldOptions(), rng, name)
        factors = made.graph.between
        e = se3.local(factors.measurement, se3.between(made.truth[factors.i],
                                                       made.truth[factors.j]))
        assert (len(factors), made.graph.n_poses) == (500, 200)
        assert_allclose(e.std(axis=0), [0.05] * 3 + [0.01] * 3, rtol=0.15)
        distance = np.linalg.norm(made.truth[factors.i, :3] - made.truth[factors.j, :3], axis=1)
        assert distance.max() < 4


def test_a_back_end_in_space_ends_at_the_map_of_the_batch(world):
    made = world[0]
    with Backend(EVERY, dimension=3) as backend:
        for k in range(0, 150, 30):
            play(backend, made, k, k + 30)
            backend.update(budget=0.05)
        backend.settle()
        batch = solve(made.graph)
        # A valley is flat: .01 m along it change the cost by less than a millionth.
        assert backend.snapshot().state.optimised.cost == pytest.approx(batch.cost, rel=1e-5)
        assert absolute_trajectory_error(backend.poses[:, :3], batch.poses[:, :3]) < 0.03
        saved = backend.saved()
    with Backend(EVERY, dimension=2) as flat, pytest.raises(
            GraphError, match='a map of SE3, expected one of SE2'):
        flat.restore(saved)
