# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Algorithm 3: exact where there is no noise, each of its two steps against HiGHS, its aims."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import chain_and_loops, drive, graph_of, linprog_l1, noisy_graph, random_information
from worlds import made

import l1slam_ros as l1
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.graph.factor_graph import WORLD
from l1slam_ros.core.graph.linear_system import linearise, whitened_residual
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.optimality import l1_cost, l2_cost
from l1slam_ros.core.solvers.seed import chordal_poses, first_poses, seed_poses


def seed_of(graph):
    return seed_poses(graph, cholesky_of(graph))


def cost(graph, poses):
    return l1_cost(whitened_residual(graph, poses))


def part_cost(graph, poses, tangent):
    """Return the cost of one part of the tangent space, and the least that steps of it lead to."""
    system = linearise(graph, poses)
    rows, columns = (np.arange(size).reshape(-1, 3)[:, tangent].ravel()
                     for size in system.A.shape)
    b = system.b[rows]
    return l1_cost(b), linprog_l1(system.A[rows][:, columns], b)[0]


def spinning(n, turn):
    """Return the truth of a robot that turns by `turn` at every keyframe."""
    poses = np.zeros((n, 3))
    for k in range(1, n):
        poses[k] = se2.compose(poses[k - 1 : k], np.array([[1.0, 0.2, turn]]))[0]
    return poses


def test_it_is_exact_where_there_is_no_noise(rng):
    """Also with one rounding in the measurements, so that no row fits to the last bit."""
    for n, loops, size in [(5, 5, 1e-12), (20, 20, 1e-12), (60, 60, 1e-12), *[(12, 2, 0.0)] * 30]:
        truth = drive(n, rng)
        pairs = chain_and_loops(n, loops, rng)
        noise = size * rng.standard_normal((len(pairs), 3))
        poses = seed_of(graph_of(truth, pairs, noise, random_information(len(pairs), rng)))
        assert_allclose(se2.local(poses, truth), 0, atol=1e-8 if size else 1e-9)


@pytest.mark.parametrize('turn', [1.5, -2.0, 3.1])
def test_headings_that_wrap_many_times(turn, rng):
    n = 120
    truth = spinning(n, turn)
    assert n * abs(turn) > 25 * 2 * np.pi
    pairs = chain_and_loops(n, n, rng)
    noise = [1e-3, 1e-3, 0.02] * rng.standard_normal((len(pairs), 3))
    graph = graph_of(truth, pairs, noise)
    poses = seed_of(graph)
    assert np.abs(se2.local(poses, truth)[:, 2]).max() < 0.1
    assert cost(graph, poses) < 1.1 * cost(graph, truth)


def test_each_of_its_two_steps_is_the_best_there_is(rng):
    """Rotations first, no worse than the true ones; translations for these rotations."""
    graph, truth = noisy_graph(40, 40, rng)
    poses = seed_of(graph)
    rotations, least = part_cost(graph, poses, se2.ROTATION)
    assert rotations == pytest.approx(least, rel=1e-4)
    assert rotations <= part_cost(graph, truth, se2.ROTATION)[0]
    translations, least = part_cost(graph, poses, se2.TRANSLATION)
    assert translations == pytest.approx(least, rel=5e-4)


def test_a_few_gross_loops_do_not_bend_the_headings(rng):
    """What L1 is for: three loops of 150 are off by a radian, the headings are not."""
    truth = drive(60, rng)
    pairs = chain_and_loops(60, 150, rng)
    noise = [0.05, 0.05, 0.01] * rng.standard_normal((len(pairs), 3))
    noise[[70, 100, 130], 2] += 1.0
    poses = seed_of(graph_of(truth, pairs, noise))
    assert np.abs(se2.local(poses, truth)[:, 2]).max() < 0.05


@pytest.mark.parametrize('manifold', [se2, se3], ids=lambda manifold: manifold.NAME)
@pytest.mark.parametrize('absolute', [False, True])
def test_the_chordal_relaxation_is_exact_without_noise(manifold, absolute, rng):
    """A hundred turns of any size, also where the world is what is held fixed."""
    truth = manifold.from_pose3(rng.standard_normal((30, 7)))
    if not absolute:
        truth = manifold.between(np.broadcast_to(truth[0], truth.shape), truth)
    i, j = np.array(chain_and_loops(30, 70, rng)).T
    d = manifold.TANGENT_SIZE
    graph = l1.FactorGraph(manifold, 30)
    graph.add_between(i, j, manifold.between(truth[i], truth[j]),
                      np.tile(np.eye(d), (len(i), 1, 1)))
    if absolute:
        graph.add_between(np.array([WORLD]), np.array([3]), truth[3:4], np.eye(d)[None])
    poses = chordal_poses(graph, cholesky_of(graph))
    assert_allclose(manifold.rotation(poses), manifold.rotation(truth), atol=1e-9)


# Large graphs, of which a seed takes seconds


@pytest.fixture(scope='module')
def large(tmp_path_factory):
    return l1.read_graph(made(tmp_path_factory.mktemp('large') / 'a.g2o', 4000, 34000))[0]


def test_a_large_clean_graph_begins_near_its_l2_map(large):
    """That is no worse a start: L1 ends at the same cost."""
    cholesky = cholesky_of(large)
    poses = first_poses(large, cholesky)
    l2 = l1.solve(large, norm='l2', robust=False, start=poses)
    assert l2_cost(whitened_residual(large, poses)) < 1.01 * l2.cost
    seed = seed_poses(large, cholesky)
    assert l2_cost(whitened_residual(large, seed)) > 1.01 * l2.cost
    costs = [l1.solve(large, robust=False, start=start).cost for start in (poses, seed)]
    assert costs[0] <= costs[1] * (1 + 6e-6)


@pytest.mark.parametrize('spoiled', ['a lie', 'noise'])
def test_a_single_lie_or_noise_beyond_what_is_stated_asks_for_the_seed(spoiled, large):
    factors, graph = large.between, large.without_factors()
    root, Z = factors.sqrt_information, factors.measurement.copy()
    if spoiled == 'a lie':
        Z[np.flatnonzero(~factors.is_odometry)[1000], :2] += 30.0
    graph.add_between(factors.i, factors.j, Z,
                      (1 if spoiled == 'a lie' else 3.5) * root.transpose(0, 2, 1) @ root)
    cholesky = cholesky_of(graph)
    assert_array_equal(first_poses(graph, cholesky), seed_poses(graph, cholesky))
