# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam simulate`: streets, buildings, spheres, and noise that is what it says."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds import made, pairs_of, position_error, truth_of, whitened

import l1slam_ros as l1


@pytest.mark.parametrize('poses, edges', [(2, 1), (3, 3), (12, 66), (100, 99), (300, 9000)])
@pytest.mark.parametrize('world', ['streets', 'torus'])
def test_a_world_has_the_size_asked_for(poses, edges, world, tmp_path):
    path = made(tmp_path / 'a.g2o', poses, edges, '--world', world)
    (graph, start), truth = l1.read_graph(path), truth_of(path)
    assert graph.n_poses == len(truth) == len(start) == poses
    assert len({tuple(pair) for pair in pairs_of(path)}) == len(graph.between) == edges
    assert graph.between.is_odometry.sum() == poses - 1
    np.testing.assert_allclose(truth[0], start[0], atol=1e-12)
    np.testing.assert_allclose(truth[0], np.eye(1, len(truth[0]), 6)[0], atol=1e-12)


def test_a_seed_makes_one_world(tmp_path):
    texts = [made(tmp_path / f'{k}.g2o', 200, 500, '--seed', seed).read_text()
             for k, seed in enumerate((5, 5, 6))]
    assert texts[0] == texts[1] != texts[2]


@pytest.fixture(scope='module')
def streets(tmp_path_factory):
    """Return a world of streets, and its truth."""
    path = made(tmp_path_factory.mktemp('streets') / 'a.g2o', 3000, 9000)
    return path, truth_of(path)


def test_the_robot_drives_along_streets_and_turns_at_crossings(streets):
    x, y, theta = streets[1].T
    # It moves the way it looks, and looks along an axis.
    np.testing.assert_allclose(np.cos(theta[:-1]), np.diff(x), atol=1e-9)
    np.testing.assert_allclose(np.sin(theta[:-1]), np.diff(y), atol=1e-9)
    turns = np.diff(theta) / (math.pi / 2)
    turns = np.round((turns + 2) % 4 - 2).astype(int)
    at_crossing = np.arange(1, 3000) % 5 == 0
    assert set(turns[at_crossing]) == {-1, 0, 1} and not turns[~at_crossing].any()
    on_street = [np.abs(v / 5 - np.round(v / 5)) < 1e-9 for v in (x, y)]
    assert (on_street[0] | on_street[1]).all()
    _, visits = np.unique(np.round(streets[1][:, :2]), axis=0, return_counts=True)
    assert np.median(visits) >= 2 and np.ptp(streets[1][:, :2], axis=0).min() > 20


def test_factors_come_in_the_order_of_a_drive_and_loops_join_poses_that_are_near(streets):
    (graph, _), truth = l1.read_graph(streets[0]), streets[1]
    i, j, odometry = graph.between.i, graph.between.j, graph.between.is_odometry
    order = list(zip(j.tolist(), (j - i != 1).tolist(), i.tolist(), strict=True))
    assert order == sorted(set(order)) and (i < j).all()
    assert np.linalg.norm(truth[i, :2] - truth[j, :2], axis=1).max() < 3
    # Most of them after a long way round, not around the last corner.
    assert np.median((j - i)[~odometry]) > 200


def test_noise_has_the_information_stated(streets):
    graph, _ = l1.read_graph(streets[0])
    sigma = 1 / np.diagonal(graph.between.sqrt_information, axis1=1, axis2=2)
    np.testing.assert_allclose(sigma, [[0.05, 0.05, 0.01]] * 9000, rtol=1e-9)
    residual, odometry = whitened(graph, streets[1]), graph.between.is_odometry
    for part in residual[odometry], residual[~odometry]:
        spread = 5 / math.sqrt(len(part))
        np.testing.assert_allclose(part.mean(axis=0), 0, atol=spread)
        np.testing.assert_allclose(part.std(axis=0), 1, atol=spread)


@pytest.mark.parametrize('seed', range(4))
def test_odometry_drifts_by_metres_and_loops_mend_it(seed, tmp_path):
    path = made(tmp_path / 'a.g2o', 1000, 2000, '--seed', seed)
    (graph, start), truth = l1.read_graph(path), truth_of(path)[:, :2]
    assert 1 < position_error(start[:, :2], truth) < 15
    assert position_error(l1.solve(graph, norm='l2', robust=False).poses[:, :2], truth) < 0.15


# In space


@pytest.mark.parametrize('world', ['building', 'sphere', 'torus'])
def test_a_drive_in_space_is_even_round_and_measured_as_it_says(world, tmp_path):
    path = made(tmp_path / 'a.g2o', 1500, 2500, '--world', world)
    factors, truth = l1.read_graph(path)[0].between, truth_of(path)
    at, turned = truth[:, :3], Rotation.from_quat(truth[:, 3:])
    step = np.diff(at, axis=0)
    length = np.linalg.norm(step, axis=1)
    np.testing.assert_allclose(length, 1, rtol=0.15)
    np.testing.assert_allclose(turned[:-1].as_matrix()[:, :, 0], step / length[:, None], atol=1e-6)
    moved = turned[factors.i].inv().apply(at[factors.j] - at[factors.i])
    error = (turned[factors.i].inv() * turned[factors.j]).inv() * Rotation.from_quat(
        factors.measurement[:, 3:])
    np.testing.assert_allclose((factors.measurement[:, :3] - moved).std(axis=0), 0.05, rtol=0.1)
    np.testing.assert_allclose(error.as_rotvec().std(axis=0), 0.01, rtol=0.1)
    assert np.linalg.norm(at[factors.i] - at[factors.j], axis=1).max() < 4
    middle = np.linalg.norm(at - at.mean(axis=0), axis=1)
    if world == 'sphere':
        np.testing.assert_allclose(np.ptp(at, axis=0), 2 * np.sqrt(1500) / np.pi, rtol=0.1)
    elif world == 'torus':
        assert middle.max() / middle.min() == pytest.approx(3, rel=0.05)
    else:  # floors, with ramps between them
        z = at[:, 2]
        on_floor = np.isclose(z % 3, 0, atol=1e-6) | np.isclose(z % 3, 3, atol=1e-6)
        assert set(np.round(z[on_floor] / 3)) <= {0, 1, 2, 3, 4} and z.max() >= 6
        assert 0.05 < 1 - on_floor.mean() < 0.3
