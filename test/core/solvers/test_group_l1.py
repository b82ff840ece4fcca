# SPDX-License-Identifier: Apache-2.0
"""Group L1: turned frames, smooth convex references, its proof; and what each norm promises."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import noisy_graph
from scipy.optimize import minimize

from l1slam_ros.core.geometry import se3
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import linearise, step_poses, whitened_residual
from l1slam_ros.core.names import NORMS
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.exact import minimise_interior_point
from l1slam_ros.core.solvers.group_l1 import minimise_group_l1
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import Status, norm_of
from l1slam_ros.core.solvers.primal_dual import PrimalDualOptions, minimise_l1
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import choose, minimise_by
from l1slam_ros.io.graphs.graph_file import read_graph_file

DELTA = 1.345
OPTIONS = OptimiserOptions(outer_iterations=100)


def solve(graph, start):
    return minimise_group_l1(graph, start, OPTIONS, cholesky_of(graph))


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
@pytest.mark.parametrize('name', NORMS)
def test_each_norm_ends_where_another_solver_does(name, manifold, rng):
    """SciPy's BFGS on the smoothed cost of a step from there finds nothing lower."""
    graph, truth = noisy_graph(12, 10, rng) if manifold == 'plane' else space_graph(6, rng)
    norm = norm_of(name, graph.manifold.TANGENT_SIZE, DELTA)
    found, _ = minimise_by(choose('auto', graph, name), graph, truth, OPTIONS)
    assert found.status is Status.CONVERGED

    def cost(x, mu):
        r = whitened_residual(graph, step_poses(graph, found.poses, x))
        if name in ('l2', 'huber'):
            return norm.cost(r)
        return np.sqrt((r.reshape(-1, norm.size) ** 2).sum(axis=1) + mu * mu).sum()

    x = np.zeros((graph.n_poses - 1) * graph.manifold.TANGENT_SIZE)
    for mu in (1e-1, 1e-2, 1e-3):
        x = minimize(cost, x, (mu,), method='BFGS', options={'gtol': 1e-4}).x
    other = norm.cost(whitened_residual(graph, step_poses(graph, found.poses, x)))
    assert found.cost <= other * (1 + 2e-5)
    assert other <= found.cost * (1 + 2e-3)


@pytest.mark.parametrize('name', ['l1', 'group-l1'])
def test_the_gap_is_proven_by_a_dual(name, rng):
    graph, truth = noisy_graph(60, 60, rng)
    found, _ = minimise_by(choose('auto', graph, name), graph, truth, OPTIONS)
    norm, system = norm_of(name, 3), linearise(graph, found.poses)
    balance = system.transposed_times(found.dual)
    assert_allclose(balance, 0, atol=1e-8 * np.abs(system.blocks).max())
    assert_allclose(norm.resolvent(found.dual, 0.0), found.dual, atol=1e-12)
    assert norm.gap(-system.b, found.dual) == pytest.approx(found.gap, abs=1e-9)
    assert 0 <= found.gap < 1e-3 * found.cost


@pytest.mark.parametrize('name', NORMS)
def test_the_promises_of_a_norm(name, rng):
    """Fenchel's inequality, tight where the dual is a derivative; the resolvent's own equation."""
    norm, r = norm_of(name, 3, DELTA), 2 * rng.standard_normal(60)
    dual = norm.resolvent(5 * rng.standard_normal(60), 0.0)
    assert norm.gap(r, dual) >= 0
    h = 1e-6
    y = np.array([(norm.cost(r + h * axis) - norm.cost(r - h * axis)) / (2 * h)
                  for axis in np.eye(60)])
    assert norm.gap(r, y) == pytest.approx(0, abs=1e-4 * norm.cost(r))
    # y = (I + sigma dF*)^-1 (y + sigma r) where r is in dF*(y), which y = dF(r) says.
    assert_allclose(norm.resolvent(y + 0.7 * r, 0.7), y, atol=1e-5)
    assert (norm.weights(r) > 0).all()


@pytest.mark.parametrize('name', NORMS)
def test_the_primal_dual_method_takes_any_norm(name, rng):
    graph, truth = noisy_graph(8, 6, rng)
    system, norm = linearise(graph, truth), norm_of(name, 3, DELTA)
    found = minimise_l1(system.A, system.b, np.zeros(21), np.zeros(len(system.b)),
                        PrimalDualOptions(20000, 1e-6), norm=norm)
    other = minimize(lambda x: norm.cost(system.A @ x - system.b), found.x, method='Powell',
                     options={'xtol': 1e-10, 'ftol': 1e-12})
    assert found.objective <= other.fun * (1 + 1e-4) and found.gap < 1e-3 * found.objective
