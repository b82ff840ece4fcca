# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Norms of factors: turned frames, smooth convex references, proofs, what each norm promises."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import noisy_graph
from scipy.optimize import minimize

from l1slam_ros.core.geometry import se3
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import linearise, step_poses, whitened_residual
from l1slam_ros.core.names import NORMS, SAME
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.exact import minimise_interior_point
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import Huber, Lengths, Status
from l1slam_ros.core.solvers.primal_dual import PrimalDualOptions, minimise_l1
from l1slam_ros.core.solvers.primal_dual_newton import minimise_norm
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import choose, minimise_by, norm_for
from l1slam_ros.io.graphs.graph_file import read_graph_file

DELTA = 1.345
OPTIONS = OptimiserOptions(outer_iterations=100)
# Of the odometry, of loops.
PURE = [(name, SAME) for name in NORMS]
MIXED = [('l2', 'l1'), ('l2', 'group-l1'), ('l1', 'l2'), ('group-l1', 'l1'), ('group-l1', 'huber'),
         ('huber', 'l1')]


def solve(graph, start):
    norm = Lengths(graph.manifold.TANGENT_SIZE)
    return minimise_norm(graph, start, norm, OPTIONS, cholesky_of(graph))


def space_graph(n, rng):
    """Return a graph in space, every entry of its information non-zero, and its truth."""
    truth = se3.from_pose3(rng.standard_normal((n, 7)))
    truth = se3.between(np.broadcast_to(truth[0], truth.shape), truth)
    i = np.concatenate((np.arange(n - 1), rng.integers(0, n - 4, n)))
    j = i + np.concatenate((np.ones(n - 1, int), rng.integers(2, 4, n)))
    root = rng.standard_normal((len(i), 6, 6))
    information = 30 * (root @ root.transpose(0, 2, 1) + np.eye(6))
    noise = 0.1 * rng.standard_normal((len(i), 6))
    graph = FactorGraph(se3)
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
    other = FactorGraph(manifold)
    other.add_poses(graph.n_poses)
    other.add_between(factors.i, factors.j, measurement, root.transpose(0, 2, 1) @ root)
    return other


def moved_by(graph, turn, minimise):
    """Return how far the map of the turned graph lies from the map [m], at most."""
    manifold = graph.manifold
    maps = [minimise(one, seed_poses(one, cholesky_of(one))).poses
            for one in (graph, in_turned_frames(graph, turn))]
    turns = np.broadcast_to(turn, maps[1].shape)
    back = manifold.compose(manifold.compose(turns, maps[1]), manifold.inverse(turns))
    return np.abs(manifold.positions(back) - manifold.positions(maps[0])).max()


def test_turned_frames_move_component_wise_l1_and_not_group_l1(datasets):
    graph = read_graph_file(datasets / 'intel.g2o').graph
    for angle in (np.pi / 4, 2.0):
        turn = np.array([[0.0, 0.0, angle]])
        assert moved_by(graph, turn, solve) < 1e-6
    assert moved_by(graph, turn, lambda one, start: minimise_interior_point(
        one, start, OPTIONS, cholesky_of(one))) > 1e-2


def test_turned_frames_in_space(rng):
    graph, _ = space_graph(25, rng)
    assert moved_by(graph, np.array([[0, 0, 0, 0.5, 0.5, -0.5, 0.5]]), solve) < 1e-6


@pytest.mark.parametrize('manifold', ['plane', 'space'])
@pytest.mark.parametrize('names', PURE + MIXED)
def test_each_norm_ends_where_another_solver_does(names, manifold, rng):
    """SciPy's BFGS on the smoothed cost of a step from there finds nothing lower."""
    graph, truth = noisy_graph(8, 7, rng) if manifold == 'plane' else space_graph(5, rng)
    k, odometry = graph.manifold.TANGENT_SIZE, graph.between.is_odometry
    norm = norm_for(graph, *names, DELTA)
    found, _ = minimise_by(choose('auto', graph, *names), graph, truth, OPTIONS)
    assert found.status is Status.CONVERGED
    name, other_name = (names[0] if name == SAME else name for name in names)
    half = 1.0 if name == other_name else 0.5

    def smooth_cost(name, r, mu):
        if name in ('l2', 'huber'):
            return half * (Huber(k, DELTA) if name == 'huber' else Huber()).cost(r)
        size = k if name == 'group-l1' else 1
        return np.sqrt((r.reshape(-1, size) ** 2).sum(axis=1) + mu * mu).sum()

    def cost(x, mu):
        r = whitened_residual(graph, step_poses(graph, found.poses, x)).reshape(-1, k)
        return smooth_cost(name, r[odometry].ravel(), mu) + smooth_cost(
            other_name, r[~odometry].ravel(), mu)

    x = np.zeros((graph.n_poses - 1) * graph.manifold.TANGENT_SIZE)
    for mu in (1e-1, 1e-2, 1e-3):
        x = minimize(cost, x, (mu,), method='BFGS', options={'gtol': 1e-4}).x
    other = norm.cost(whitened_residual(graph, step_poses(graph, found.poses, x)))
    assert found.cost <= other * (1 + 2e-5)
    assert other <= found.cost * (1 + 2e-3)


@pytest.mark.parametrize('names', [('l1', SAME), ('group-l1', SAME), *MIXED])
def test_the_gap_is_proven_by_a_dual(names, rng):
    graph, truth = noisy_graph(60, 60, rng)
    found, _ = minimise_by(choose('auto', graph, *names), graph, truth, OPTIONS)
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


@pytest.mark.parametrize('names', PURE + MIXED)
def test_a_smoothed_norm_is_differentiated(names, promising, rng):
    """Its gradient by differences; and its curvature at the dual that is the gradient, for Huber
    reweighted, which is no less."""
    norm, e = norm_for(promising, *names, DELTA), 2 * rng.standard_normal((20, 3))
    mu, h = 0.3, 1e-5
    y = norm.smoothed(e, np.zeros((20, 3)), mu).gradient
    cost, d, W = norm.smoothed(e, y, mu)
    assert cost >= norm.cost(e.ravel())
    axes = h * np.eye(60).reshape(60, 20, 3)
    ahead, behind = ([norm.smoothed(e + sign * axis, y, mu) for axis in axes] for sign in (1, -1))
    assert_allclose(d.ravel(), [(a.cost - b.cost) / (2 * h) for a, b in zip(
        ahead, behind, strict=True)], atol=1e-6)
    H = np.array([(a.gradient - b.gradient).ravel() / (2 * h) for a, b in zip(
        ahead, behind, strict=True)])
    W = sum(np.kron(np.diag(row), W[f]) for f, row in enumerate(np.eye(20)))
    assert np.linalg.eigvalsh(W - H).min() > -1e-6
    if 'huber' not in names:
        assert_allclose(W, H, atol=1e-5)


@pytest.mark.parametrize('names', PURE + MIXED)
def test_the_primal_dual_method_takes_any_norm(names, rng):
    graph, truth = noisy_graph(8, 6, rng)
    system, norm = linearise(graph, truth), norm_for(graph, *names, DELTA)
    found = minimise_l1(system.A, system.b, np.zeros(21), np.zeros(len(system.b)),
                        PrimalDualOptions(20000, 1e-6), norm=norm)
    other = minimize(lambda x: norm.cost(system.A @ x - system.b), found.x, method='Powell',
                     options={'xtol': 1e-10, 'ftol': 1e-12})
    assert found.objective <= other.fun * (1 + 1e-4) and found.gap < 1e-3 * found.objective
