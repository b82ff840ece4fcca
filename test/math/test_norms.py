# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Norms of factors: turned frames, SciPy's solvers, proofs, what each norm promises."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import add_absolute, chain_and_loops, drive, graph_of, noisy_graph
from scipy.optimize import least_squares, minimize

import l1slam_ros as l1
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.graph.linear_system import linearise, step_poses, whitened_residual
from l1slam_ros.core.names import NORMS, SAME
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import Huber, l2_cost
from l1slam_ros.core.solvers.solve import choose, minimise_by, norm_for

DELTA = 1.345
# Of the odometry, of loops.
PURE = [(name, SAME) for name in NORMS]
MIXED = [('l2', 'l1'), ('l2', 'group-l1'), ('l1', 'l2'), ('group-l1', 'l1'), ('group-l1', 'huber'),
         ('huber', 'l1')]


def solve(graph, norm, start=None, loop_norm=SAME):
    return l1.solve(graph, norm=norm, loop_norm=loop_norm, robust=False, start=start)


def cost(graph, names, poses):
    return norm_for(graph, *names, DELTA).cost(whitened_residual(graph, poses))


def space_graph(n, rng):
    """Return a graph in space, every entry of its information non-zero, and its truth."""
    truth = se3.from_pose3(rng.standard_normal((n, 7)))
    truth = se3.between(np.broadcast_to(truth[0], truth.shape), truth)
    i = np.concatenate((np.arange(n - 1), rng.integers(0, n - 4, n)))
    j = i + np.concatenate((np.ones(n - 1, int), rng.integers(2, 4, n)))
    root = rng.standard_normal((len(i), 6, 6))
    information = 30 * (root @ root.transpose(0, 2, 1) + np.eye(6))
    noise = 0.1 * rng.standard_normal((len(i), 6))
    graph = l1.FactorGraph(se3)
    graph.add_poses(n)
    graph.add_between(i, j, se3.retract(se3.between(truth[i], truth[j]), noise), information)
    return graph, truth


def in_turned_frames(graph, turn):
    """Return the graph of the same robot, its body's axes turned, (1, p) the pose of the new."""
    manifold, factors = graph.manifold, graph.between
    turns = np.broadcast_to(turn, factors.measurement.shape)
    back = manifold.inverse(turns)
    measurement = manifold.compose(back, manifold.compose(factors.measurement, turns))
    # A residual e becomes Ad(turn^-1) e, so its root becomes root Ad(turn).
    root = factors.sqrt_information @ manifold.adjoint(turns)
    other = l1.FactorGraph(manifold)
    other.add_poses(graph.n_poses)
    other.add_between(factors.i, factors.j, measurement, root.transpose(0, 2, 1) @ root)
    return other


def moved_by(graph, turn, norm):
    """Return how far the map of the turned graph lies from the map [m], at most."""
    manifold = graph.manifold
    maps = [solve(one, norm).poses for one in (graph, in_turned_frames(graph, turn))]
    turns = np.broadcast_to(turn, maps[1].shape)
    back = manifold.compose(manifold.compose(turns, maps[1]), manifold.inverse(turns))
    return np.abs(manifold.positions(back) - manifold.positions(maps[0])).max()


def test_turned_frames_move_component_wise_l1_and_not_group_l1(datasets, rng):
    graph, _ = l1.read_graph(datasets / 'intel.g2o')
    for angle in (np.pi / 4, 2.0):
        turn = np.array([[0.0, 0.0, angle]])
        assert moved_by(graph, turn, 'group-l1') < 1e-6
    assert moved_by(graph, turn, 'l1') > 1e-2
    turn = np.array([[0, 0, 0, 0.5, 0.5, -0.5, 0.5]])
    assert moved_by(space_graph(25, rng)[0], turn, 'group-l1') < 1e-6


@pytest.mark.parametrize('manifold', ['plane', 'space'])
@pytest.mark.parametrize('names', PURE + MIXED)
def test_each_norm_ends_where_another_solver_does(names, manifold, rng):
    """SciPy's BFGS on the smoothed cost of a step from there finds nothing lower."""
    graph, truth = noisy_graph(8, 7, rng) if manifold == 'plane' else space_graph(5, rng)
    k, odometry = graph.manifold.TANGENT_SIZE, graph.between.is_odometry
    found = solve(graph, names[0], truth, names[1])
    assert found.status == 'converged'
    assert found.cost == pytest.approx(cost(graph, names, found.poses), rel=1e-12)
    name, other_name = (names[0] if name == SAME else name for name in names)
    half = 1.0 if name == other_name else 0.5

    def smooth_cost(name, r, mu):
        if name in ('l2', 'huber'):
            return half * (Huber(k, DELTA) if name == 'huber' else Huber()).cost(r)
        size = k if name == 'group-l1' else 1
        return np.sqrt((r.reshape(-1, size) ** 2).sum(axis=1) + mu * mu).sum()

    def smoothed(x, mu):
        r = whitened_residual(graph, step_poses(graph, found.poses, x)).reshape(-1, k)
        return smooth_cost(name, r[odometry].ravel(), mu) + smooth_cost(
            other_name, r[~odometry].ravel(), mu)

    x = np.zeros((graph.n_poses - 1) * graph.manifold.TANGENT_SIZE)
    for mu in (1e-1, 1e-2, 1e-3):
        x = minimize(smoothed, x, (mu,), method='BFGS', options={'gtol': 1e-4}).x
    other = cost(graph, names, step_poses(graph, found.poses, x))
    assert found.cost <= other * (1 + 2e-5)
    assert other <= found.cost * (1 + 2e-3)


def test_l2_agrees_with_scipy(rng):
    graph, truth = noisy_graph(25, 20, rng)
    expected = least_squares(lambda x: whitened_residual(graph, step_poses(graph, truth, x)),
                             np.zeros(3 * 24), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    found = solve(graph, 'l2')
    assert found.cost == pytest.approx(2 * expected.cost, rel=1e-8)
    assert_allclose(se2.local(found.poses, step_poses(graph, truth, expected.x)), 0, atol=1e-4)


def test_huber_cost_by_hand():
    """Lengths 5 (beyond 2: 2 2 5 - 2^2 = 16), 1 (1^2) and 2 (2^2, either way)."""
    residual = np.array([3.0, 4.0, 0.0, 0.6, 0.0, -0.8, 0.0, 2.0, 0.0])
    assert Huber(3, 2.0).cost(residual) == pytest.approx(16 + 1 + 4)
    assert Huber(3, 1e9).cost(residual) == pytest.approx(l2_cost(residual))
    assert Huber(3, 1.0).cost(np.zeros(0)) == 0.0


# From where a map is begun


@pytest.mark.parametrize('norm', NORMS)
def test_a_graph_without_noise_is_solved_exactly(norm, rng):
    """Also one pose alone, and a chain; what it began with is not written to."""
    for n, loops in (1, 0), (3, 0), (20, 12):
        truth = drive(n, rng)
        graph = l1.FactorGraph(se2, 1)
        if n > 1:
            graph = graph_of(truth, chain_and_loops(n, loops, rng) if loops else [(0, 1), (1, 2)])
        for size in 0.0, 0.05:
            start = step_poses(graph, truth, size * rng.standard_normal(3 * (n - 1)))
            begun = start.copy()
            start.flags.writeable = False
            found = solve(graph, norm, start)
            assert_array_equal(start, begun)
            assert found.cost < 1e-7
            assert_allclose(se2.local(found.poses, truth), 0, atol=1e-8)


@pytest.mark.parametrize('seed', [0, 1, 3, 4])
@pytest.mark.parametrize('norm', NORMS)
def test_where_a_plain_step_fails_another_one_is_found(norm, seed):
    """From poses anywhere Gauss-Newton leaps too far: it is shortened, bent or damped."""
    rng = np.random.default_rng(seed)
    graph, truth = noisy_graph(25, 20, rng)
    start = np.concatenate((truth[:1], 3 * rng.standard_normal((24, 3))))
    assert solve(graph, norm, start).cost < 0.1 * cost(graph, (norm, SAME), start)


@pytest.mark.parametrize('turn', [0.5, -1.5])
def test_a_long_chain_that_a_loop_bends_takes_few_steps(turn):
    """Its keyframes go along the tangent of their arc, which tears them apart."""
    n = 300
    heading = turn * np.arange(n) / n
    arc = np.column_stack((np.cumsum(np.cos(heading)), np.cumsum(np.sin(heading)), heading))
    straight = np.arange(n)[:, None] * np.array([[1.0, 0.0, 0.0]])
    graph = graph_of(straight, [(k, k + 1) for k in range(n - 1)],
                     information=np.diag((1e6, 1e6, 1e4)))
    graph.add_between(0, n - 1, se2.between(arc[:1], arc[-1:]), np.eye(3)[None])
    found, _ = minimise_by(choose('auto', graph, 'l2'), graph, straight, OptimiserOptions())
    assert found.status == 'converged' and found.outer_iterations <= 8
    assert (np.diff(found.history) <= 0).all()


@pytest.mark.parametrize('norm', NORMS)
def test_the_world_takes_the_place_of_the_anchor(norm, rng):
    graph, truth = noisy_graph(40, 35, rng)
    alone = solve(graph, norm, truth)
    there = se2.compose(np.broadcast_to([10.0, 20.0, 0.5], truth.shape), truth)
    add_absolute(graph, np.array([7]), there[7:8], 1e4 * np.eye(3)[None])
    found = solve(graph, norm, there)
    assert found.cost == pytest.approx(alone.cost, rel=1e-4)
    assert_allclose(found.poses[7], there[7], atol=1e-3)


# What a norm promises


@pytest.mark.parametrize('names', [('l1', SAME), ('group-l1', SAME), *MIXED])
def test_the_gap_is_proven_by_a_dual(names, rng):
    graph, truth = noisy_graph(60, 60, rng)
    found, _ = minimise_by(choose('auto', graph, *names), graph, truth, OptimiserOptions())
    norm, system = norm_for(graph, *names, DELTA), linearise(graph, found.poses)
    balance = system.transposed_times(found.dual)
    assert_allclose(balance, 0, atol=1e-8 * np.abs(system.blocks).max())
    assert_allclose(norm.resolvent(found.dual, 0.0), found.dual, atol=1e-12)
    assert norm.gap(-system.b, found.dual) == pytest.approx(found.gap, abs=1e-9)
    assert 0 <= found.gap < 1e-3 * found.cost


@pytest.fixture
def promising(rng):
    """Return a graph of 20 factors."""
    return noisy_graph(13, 8, rng)[0]


@pytest.mark.parametrize('names', PURE + MIXED)
def test_the_promises_of_a_norm(names, promising, rng):
    """Fenchel's inequality, tight where the dual is a derivative; the resolvent's own equation."""
    norm, r = norm_for(promising, *names, DELTA), 2 * rng.standard_normal(60)
    dual = norm.resolvent(5 * rng.standard_normal(60), 0.0)
    assert norm.gap(r, dual) >= 0
    h = 1e-6
    y = np.array([(norm.cost(r + h * axis) - norm.cost(r - h * axis)) / (2 * h)
                  for axis in np.eye(60)])
    assert norm.gap(r, y) == pytest.approx(0, abs=1e-4 * norm.cost(r))
    # y = (I + sigma dF*)^-1 (y + sigma r) where r is in dF*(y), which y = dF(r) says.
    assert_allclose(norm.resolvent(y + 0.7 * r, 0.7), y, atol=1e-5)
    assert (norm.weights(r) > 0).all()
