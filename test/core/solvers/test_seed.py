# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Algorithm 3: exact where there is no noise, and each of its two steps against HiGHS."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import chain_and_loops, drive, graph_of, linprog_l1, noisy_graph, random_information

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.graph.factor_graph import WORLD, FactorGraph
from l1slam_ros.core.graph.linear_system import linearise, whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.solvers import seed as seeding
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.exact import minimise_interior_point
from l1slam_ros.core.solvers.gauss_newton import ROUGH_L2, LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import l1_cost, l2_cost
from l1slam_ros.core.solvers.seed import chordal_poses, first_poses, seed_poses
from l1slam_ros.core.worlds.false_loops import random_false_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world, with_false_loops


def seed_of(graph):
    return seed_poses(graph, cholesky_of(graph))


def cost(graph, poses):
    return l1_cost(whitened_residual(graph, poses))


def l2_cost_at(graph, poses):
    return l2_cost(whitened_residual(graph, poses))


def part(graph, poses, tangent):
    """Return the A and b of one part of the tangent space, rows and columns alike."""
    system = linearise(graph, poses)
    kept = [np.arange(size).reshape(-1, 3)[:, tangent].ravel() for size in system.A.shape]
    return system.A[kept[0]][:, kept[1]], system.b[kept[0]]


def spinning(n, turn):
    """Return the truth of a robot that turns by `turn` at every keyframe."""
    poses = np.zeros((n, 3))
    for k in range(1, n):
        poses[k] = se2.compose(poses[k - 1 : k], np.array([[1.0, 0.2, turn]]))[0]
    return poses


def test_it_is_exact_on_noise_free_graphs(rng):
    """One rounding in the measurements, so that no row fits to the last bit."""
    for n in (5, 20, 60):
        truth = drive(n, rng)
        pairs = chain_and_loops(n, n, rng)
        noise = 1e-12 * rng.standard_normal((len(pairs), 3))
        poses = seed_of(graph_of(truth, pairs, noise, random_information(len(pairs), rng)))
        assert_allclose(se2.local(poses, truth), 0, atol=1e-8)


def test_it_is_exact_on_graphs_without_any_noise(rng):
    for _ in range(100):
        truth = drive(12, rng)
        poses = seed_of(graph_of(truth, chain_and_loops(12, 2, rng)))
        assert_allclose(se2.local(poses, truth), 0, atol=1e-9)


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


def test_the_rotations_are_the_best_there_are(rng):
    """No better ones near them, by HiGHS, and none at the truth either."""
    graph, truth = noisy_graph(40, 40, rng)
    poses = seed_of(graph)
    A, b = part(graph, poses, se2.ROTATION)
    assert l1_cost(b) == pytest.approx(linprog_l1(A, b)[0], rel=1e-4)
    assert l1_cost(b) <= l1_cost(part(graph, truth, se2.ROTATION)[1])


def test_the_translations_are_the_best_for_these_rotations(rng):
    graph, _ = noisy_graph(40, 40, rng)
    A, b = part(graph, seed_of(graph), se2.TRANSLATION)
    assert l1_cost(b) == pytest.approx(linprog_l1(A, b)[0], rel=5e-4)


def test_a_few_gross_loops_do_not_bend_the_headings(rng):
    """What L1 is for: three loops of 150 are off by a radian, the headings are not."""
    truth = drive(60, rng)
    pairs = chain_and_loops(60, 150, rng)
    noise = [0.05, 0.05, 0.01] * rng.standard_normal((len(pairs), 3))
    noise[[70, 100, 130], 2] += 1.0
    poses = seed_of(graph_of(truth, pairs, noise))
    assert np.abs(se2.local(poses, truth)[:, 2]).max() < 0.05


def test_it_needs_no_odometry(rng):
    """Keyframes seen from one hub alone, and from each other."""
    truth = drive(20, rng)
    pairs = [(7, k) for k in range(20) if k != 7] + [(k, k + 5) for k in range(10, 15)]
    noise = 0.01 * rng.standard_normal((len(pairs), 3))
    poses = seed_of(graph_of(truth, pairs, noise))
    assert np.abs(se2.local(poses, truth)[:, 2]).max() < 0.1


def test_a_graph_in_two_parts_is_refused(rng):
    with pytest.raises(GraphError, match='keyframe 3 has no path'):
        seed_of(graph_of(drive(5, rng), [(0, 1), (1, 2), (3, 4)]))


@pytest.mark.parametrize('manifold', [se2, se3], ids=lambda manifold: manifold.NAME)
@pytest.mark.parametrize('absolute', [False, True])
def test_the_chordal_relaxation_is_exact_without_noise(manifold, absolute, rng):
    """A hundred turns of any size, also where the world is what is held fixed."""
    truth = manifold.from_pose3(rng.standard_normal((30, 7)))
    if not absolute:
        truth = manifold.between(np.broadcast_to(truth[0], truth.shape), truth)
    i, j = np.array(chain_and_loops(30, 70, rng)).T
    d = manifold.TANGENT_SIZE
    graph = FactorGraph(manifold)
    graph.add_poses(30)
    graph.add_between(i, j, manifold.between(truth[i], truth[j]),
                      np.tile(np.eye(d), (len(i), 1, 1)))
    if absolute:
        graph.add_between(np.array([WORLD]), np.array([3]), truth[3:4], np.eye(d)[None])
    poses = chordal_poses(graph, cholesky_of(graph))
    assert_allclose(manifold.rotation(poses), manifold.rotation(truth), atol=1e-9)


def test_in_space_it_finds_what_the_odometry_does_not(rng):
    """Rotations of half a radian of noise at each step, on a grid of many small circles."""
    n = 60
    truth = se3.from_pose3(rng.standard_normal((n, 7)))
    truth = se3.between(np.broadcast_to(truth[0], truth.shape), truth)
    i, j = np.array(chain_and_loops(n, 5 * n, rng)).T
    noise = [0.1, 0.1, 0.1, 0.3, 0.3, 0.3] * rng.standard_normal((len(i), 6))
    graph = FactorGraph(se3)
    graph.add_poses(n)
    graph.add_between(i, j, se3.retract(se3.between(truth[i], truth[j]), noise),
                      np.tile(np.diag([100.0] * 3 + [10.0] * 3), (len(i), 1, 1)))
    poses = seed_of(graph)
    assert np.median(se3.motion(se3.local(odometry_poses(graph), truth))[1]) > 1.0
    costs = [np.abs(whitened_residual(graph, at).reshape(-1, 6)[:, 3:]).sum()
             for at in (poses, truth)]
    assert costs[0] < costs[1]


@pytest.fixture
def no_graph_is_small(monkeypatch):
    monkeypatch.setattr(seeding, '_MANY_ROWS', 0)


@pytest.mark.parametrize('sigma', [0.01, 0.05, 0.1])
@pytest.mark.usefixtures('no_graph_is_small')
def test_a_clean_graph_is_solved_from_its_l2_map(sigma, rng):
    """That is no worse a start: exact L1 ends at the same cost."""
    options = WorldOptions(odometry_sigma_rotation=sigma, loop_sigma_rotation=sigma)
    graph = simulate_world(1000, 3000, options, rng).graph
    cholesky = cholesky_of(graph)
    poses = first_poses(graph, cholesky)
    rough, best = (minimise_l2(graph, poses, options, cholesky).poses
                   for options in (ROUGH_L2, LeastSquaresOptions()))
    assert cost(graph, rough) == pytest.approx(cost(graph, best), rel=1e-2)
    found = [minimise_interior_point(graph, start, OptimiserOptions(), cholesky)
             for start in (poses, seed_poses(graph, cholesky))]
    assert found[0].cost <= found[1].cost * (1 + 6e-6)
    assert found[0].outer_iterations <= found[1].outer_iterations + 2


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.usefixtures('no_graph_is_small')
def test_exact_l1_begins_one_step_nearer_the_l2_map_of_a_clean_graph(seed):
    """From the poses as they are some place of a large graph bends more than first steps may."""
    graph = simulate_world(2000, 4000, WorldOptions(), np.random.default_rng(seed)).graph
    cholesky = cholesky_of(graph)
    poses = first_poses(graph, cholesky)
    begun = minimise_interior_point(graph, poses, OptimiserOptions(outer_iterations=1), cholesky)
    best = l2_cost_at(graph, minimise_l2(graph, poses, LeastSquaresOptions(), cholesky).poses)
    assert l2_cost_at(graph, poses) > best * (1 + 1e-3)
    assert l2_cost_at(graph, begun.poses) == pytest.approx(best, rel=1e-4)


@pytest.mark.usefixtures('no_graph_is_small')
def test_noise_of_twenty_degrees_asks_for_the_seed(rng):
    """L1 has several optima there; from the L2 map it may end a part in a thousand above."""
    options = WorldOptions(odometry_sigma_rotation=0.35, loop_sigma_rotation=0.35)
    graph = simulate_world(300, 900, options, rng).graph
    cholesky = cholesky_of(graph)
    assert (first_poses(graph, cholesky) == seed_poses(graph, cholesky)).all()


@pytest.mark.usefixtures('no_graph_is_small')
def test_a_single_lie_among_thousands_of_loops_asks_for_the_seed(rng):
    world = simulate_world(1000, 5000, WorldOptions(), rng)
    world = with_false_loops(world, random_false_loops(world.graph, world.truth, 1, rng))
    cholesky = cholesky_of(world.graph)
    assert (first_poses(world.graph, cholesky) == seed_poses(world.graph, cholesky)).all()


@pytest.mark.usefixtures('no_graph_is_small')
def test_noise_beyond_what_is_stated_asks_for_the_seed(rng):
    stated = simulate_world(1000, 3000, WorldOptions(), rng).graph
    factors = stated.between
    graph = stated.without_factors()
    graph.add_between(factors.i, factors.j, factors.measurement,
                      4 * factors.sqrt_information.transpose(0, 2, 1) @ factors.sqrt_information)
    cholesky = cholesky_of(graph)
    assert (first_poses(graph, cholesky) == seed_poses(graph, cholesky)).all()


def test_a_small_graph_starts_from_the_seed(rng):
    graph = simulate_world(300, 900, WorldOptions(), rng).graph
    cholesky = cholesky_of(graph)
    assert (first_poses(graph, cholesky) == seed_poses(graph, cholesky)).all()
