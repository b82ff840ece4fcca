# SPDX-License-Identifier: Apache-2.0
"""The incremental back end: as good as a batch solve, in time, and consistent on the way."""

import time
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import PERIOD, loop, odometry, play

from l1slam_ros.core import se2
from l1slam_ros.core.backend import Backend, BackendOptions, RobustOptions, improve, optimise
from l1slam_ros.core.cholesky import cholesky_of
from l1slam_ros.core.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.linearise import whitened_residual
from l1slam_ros.core.optimality import Status, l1_cost
from l1slam_ros.core.optimiser import OptimiserOptions, minimise
from l1slam_ros.core.primal_dual import PrimalDualOptions
from l1slam_ros.core.seed import seed_poses
from l1slam_ros.core.simulate import WorldOptions, simulate_world

# Every message a keyframe, with the covariance it states: the graph is that of the world.
EVERY = BackendOptions(KeyframeOptions(0.0, 0.0, 0.0), OdometryOptions('increment'))
# Every loop is used, however far off.
CREDULOUS = replace(EVERY, robust=RobustOptions(enabled=False))
PLENTY = 60.0  # [s] of budget: an update then ends by its own tests, on any machine


@pytest.fixture(scope='module')
def world():
    return simulate_world(150, 320, WorldOptions(), np.random.default_rng(1))


def cost(graph, poses):
    return l1_cost(whitened_residual(graph, poses))


def batch_of(graph):
    cholesky = cholesky_of(graph)
    return minimise(graph, seed_poses(graph, cholesky), OptimiserOptions(), cholesky)


def settled(backend):
    """Update until there is nothing left to do; return how often."""
    for count in range(100):
        if backend.update(PLENTY) is None:
            return count
    raise AssertionError('a hundred updates of one graph did not settle')


def test_played_back_the_graph_is_that_of_the_world(world):
    backend = Backend(se2, EVERY)
    play(backend, world)
    ours, theirs = backend.problem().graph.between, world.graph.between

    def rows(factors):
        information = factors.sqrt_information.transpose(0, 2, 1) @ factors.sqrt_information
        table = np.column_stack((factors.i, factors.j, factors.measurement,
                                 information.reshape(-1, 9)))
        return table[np.lexsort(table[:, 1::-1].T)]

    assert_allclose(rows(ours), rows(theirs), rtol=1e-6, atol=1e-6)


def test_incremental_ends_at_the_cost_of_batch(world):
    """Within 2 parts in 10,000; on the way each update ends within 1%."""
    backend = Backend(se2, EVERY)
    for k in range(0, 150, 10):
        play(backend, world, k, k + 10)
        improvement = backend.update(PLENTY)
        assert improvement.cost <= improvement.cost_before
        if k in (40, 90, 140):
            graph = backend.problem().graph
            batch = batch_of(graph)
            assert cost(graph, backend.poses) == pytest.approx(batch.cost, rel=1e-2)
    settled(backend)
    assert cost(world.graph, backend.poses) == pytest.approx(batch.cost, rel=2e-4)


def test_a_solve_to_the_end_is_as_good(world):
    backend = Backend(se2, EVERY)
    play(backend, world)
    problem = backend.problem()
    solved = optimise(problem, EVERY.solver)
    batch = batch_of(world.graph)
    assert solved.cost == cost(problem.graph, solved.poses) == pytest.approx(batch.cost, rel=2e-4)
    assert solved.cost_before == cost(problem.graph, problem.poses)
    backend.adopt(solved)
    assert_array_equal(backend.poses, solved.poses)


def test_nothing_to_do_is_none(world):
    backend = Backend(se2, EVERY)
    assert backend.update(PLENTY) is None
    play(backend, world, 0, 60)
    assert settled(backend) >= 1
    poses = backend.poses
    assert backend.problem().settled and backend.update(PLENTY) is None
    assert_array_equal(backend.poses, poses)
    play(backend, world, 60, 61)
    assert not backend.problem().settled
    assert backend.update(PLENTY) is not None


def test_one_keyframe_is_no_trouble():
    backend = Backend(se2, EVERY)
    backend.add_odometry(odometry(1.0, (3.0, 4.0, 0.5)))
    improvement = backend.update(PLENTY)
    assert (improvement.status, improvement.cost) == (Status.CONVERGED, 0.0)
    assert_allclose(backend.poses, [[3.0, 4.0, 0.5]])
    assert_allclose(backend.map_to_odom, [[0.0, 0.0, 0.0]], atol=1e-15)


def test_a_loop_alone_settles_nothing_new(world):
    """A loop that still waits is no reason to work."""
    backend = Backend(se2, EVERY)
    play(backend, world, 0, 30)
    settled(backend)
    backend.add_loop(loop(0.0, 100.0, (1.0, 0.0, 0.0)))
    assert backend.update(PLENTY) is None
    assert backend.growth.n_waiting == 1


# Time


@pytest.mark.parametrize('budget', [0.0, 0.05, 0.3])
def test_the_budget_is_kept(budget):
    """With a second to spare: one linearisation is always finished, on any machine."""
    world = simulate_world(800, 1800, WorldOptions(), np.random.default_rng(0))
    options = BackendOptions(EVERY.keyframe, EVERY.odometry, solver=OptimiserOptions(
        outer_iterations=10**6, inner=PrimalDualOptions(iterations=10**7, tolerance=0.0)))
    backend = Backend(se2, options)
    play(backend, world)
    problem = backend.problem()
    start = time.monotonic()
    improvement = improve(problem, options.solver, budget)
    spent = time.monotonic() - start
    assert budget <= spent < budget + 1.0
    assert improvement.seconds == pytest.approx(spent, abs=0.5)
    assert improvement.status is Status.OUT_OF_TIME
    assert improvement.cost < improvement.cost_before


def test_small_budgets_add_up(world):
    backend = Backend(se2, EVERY)
    play(backend, world)
    costs = []
    for _ in range(400):
        improvement = backend.update(0.01)
        if improvement is None:
            break
        costs.append(improvement.cost)
    assert improvement is None
    assert (np.diff(costs) <= 1e-9).all()
    batch = batch_of(world.graph)
    assert costs[-1] == pytest.approx(batch.cost, rel=1e-3)


# What is seen from outside


def test_before_an_update_the_poses_are_the_odometry(world):
    backend = Backend(se2, EVERY)
    play(backend, world, 0, 20)
    assert_allclose(backend.poses, world.odometry[:20], atol=1e-12)
    assert_allclose(backend.map_to_odom, [[0, 0, 0]], atol=1e-12)


def test_map_to_odom_puts_the_last_optimised_keyframe_in_its_place(world):
    backend = Backend(se2, EVERY)
    play(backend, world, 0, 140)
    settled(backend)
    there = se2.compose(backend.map_to_odom, world.odometry[139:140])
    assert_allclose(se2.local(backend.poses[139:], there), 0, atol=1e-9)
    assert np.abs(backend.map_to_odom).max() > 0.05


def test_keyframes_after_an_update_follow_the_map(world):
    backend = Backend(se2, EVERY)
    play(backend, world, 0, 100)
    settled(backend)
    before, transform = backend.poses, backend.map_to_odom
    play(backend, world, 100, 120)
    assert_array_equal(backend.poses[:100], before)
    assert_array_equal(backend.map_to_odom, transform)
    expected = se2.compose(np.broadcast_to(transform, (20, 3)), world.odometry[100:120])
    assert_allclose(se2.local(backend.poses[100:], expected), 0, atol=1e-12)


def test_keyframes_during_an_update_follow_the_map(world):
    """Between problem() and adopt(), as with the node's worker."""
    backend = Backend(se2, EVERY)
    play(backend, world, 0, 100)
    problem = backend.problem()
    frozen = problem.poses.copy(), len(problem.graph.between), problem.graph.n_poses
    play(backend, world, 100, 125)
    improvement = improve(problem, EVERY.solver, PLENTY)
    assert_array_equal(problem.poses, frozen[0])
    assert (len(problem.graph.between), problem.graph.n_poses) == frozen[1:]
    backend.adopt(improvement)
    assert len(backend.poses) == 125 and len(improvement.poses) == 100
    assert_array_equal(backend.poses[:100], improvement.poses)
    moved = se2.between(backend.poses[99:124], backend.poses[100:])
    assert_allclose(moved, se2.between(world.odometry[99:124], world.odometry[100:125]),
                    atol=1e-9)
    settled(backend)
    graph = backend.problem().graph
    batch = batch_of(graph)
    assert cost(graph, backend.poses) == pytest.approx(batch.cost, rel=1e-3)


def test_poses_are_always_finite(world, rng):
    backend = Backend(se2, EVERY)
    for k in range(0, 150, 30):
        play(backend, world, k, k + 30)
        for _ in range(3):  # and loops that are nonsense, with covariances that are none
            i, j = np.sort(rng.choice(k + 30, 2, replace=False))
            backend.add_loop(loop(i * PERIOD, j * PERIOD, 1e3 * rng.standard_normal(3),
                                  rng.choice([0.0, -1.0, np.nan, 9999.0]) * np.eye(6)))
        backend.update(0.02)
        assert np.isfinite(backend.poses).all() and np.isfinite(backend.map_to_odom).all()
        assert len(backend.poses) == k + 30


def test_several_loops_at_once_bring_a_drifted_drive_back():
    """Two rounds of a square, drifting by .02 rad a step; loops from the second to the first."""
    n, side = 80, 10
    truth, drifted = np.zeros((n, 3)), np.zeros((n, 3))
    for k in range(1, n):
        step = np.array([[1.0, 0.0, np.pi / 2 if k % side == 0 else 0.0]])
        truth[k] = se2.compose(truth[k - 1 : k], step)[0]
        drifted[k] = se2.compose(drifted[k - 1 : k], step + [[0.0, 0.0, 0.02]])[0]
    backend = Backend(se2, CREDULOUS)
    for k in range(n):
        backend.add_odometry(odometry(k * PERIOD, drifted[k], np.diag([1e-3] * 6)))
    assert np.abs(se2.positions(drifted - truth)).max() > 5
    loops = [(k, k + 4 * side) for k in range(0, 40, 5)]
    for i, j in loops:
        seen = se2.between(truth[i : i + 1], truth[j : j + 1])[0]
        backend.add_loop(loop(i * PERIOD, j * PERIOD, seen, 1e-4 * np.eye(6)))
    improvement = backend.update(PLENTY)
    assert improvement.reweighted_steps > 0
    i, j = np.array(loops).T
    error = se2.local(se2.between(truth[i], truth[j]), se2.between(backend.poses[i],
                                                                   backend.poses[j]))
    assert np.abs(error).max() < 0.05
    assert_allclose(backend.poses[0], drifted[0], atol=1e-12)


# An earlier run


def restored(world, n):
    """Return the first n keyframes as one run left them, and a run that goes on from there."""
    first, second = Backend(se2, EVERY), Backend(se2, EVERY)
    play(first, world, 0, n)
    settled(first)
    second.restore(first.problem().graph, first.poses, first.growth.stamps)
    return first, second


def test_a_restored_map_is_the_map_it_was(world):
    first, second = restored(world, 80)
    assert_array_equal(second.poses, first.poses)
    assert_array_equal(second.growth.stamps, first.growth.stamps)
    second.update(PLENTY)
    # Started anew it may end nearer to the optimum, of which a settled map is within 2e-4.
    before, after = first.problem().last_cost, second.problem().last_cost
    assert (1 - 5e-4) * before <= after <= (1 + 1e-4) * before


def test_after_a_restore_odometry_may_begin_anywhere(world):
    """The robot stands where the first run ended; a loop then ties the new to the old."""
    _, backend = restored(world, 80)
    end = backend.poses[79:80]
    for k in range(5):
        raw = np.array([[50.0, 60.0 + k, np.pi / 2]])  # 1 m ahead each
        backend.add_odometry(odometry(100.0 + k, raw[0], 1e-3 * np.eye(6)))
        there = se2.compose(end, np.array([[float(k), 0.0, 0.0]]))
        assert_allclose(se2.local(backend.poses[-1:], there), 0, atol=1e-9)
        assert_allclose(se2.local(se2.compose(backend.map_to_odom, raw), there), 0, atol=1e-9)
    # Half a metre off: nobody would believe it who was not told to.
    seen = loop(7.9, 104.0, (4.5, 0.0, 0.0), 1e-6 * np.eye(6))
    backend.add_loop(replace(seen, trusted=True))
    settled(backend)
    seen = se2.between(backend.poses[79:80], backend.poses[-1:])
    assert_allclose(seen, [[4.5, 0.0, 0.0]], atol=1e-2)
    assert_allclose(se2.local(backend.poses[-1:], se2.compose(backend.map_to_odom, raw)), 0,
                    atol=1e-9)


# The warm start


def test_the_dual_of_old_rows_is_kept_and_new_rows_start_at_zero(world):
    backend = Backend(se2, EVERY)
    play(backend, world, 0, 100)
    improvement = improve(backend.problem(), EVERY.solver, PLENTY)
    backend.adopt(improvement)
    rows = len(improvement.dual)
    assert rows == 3 * len(backend.growth.graph.between)
    play(backend, world, 100, 110)
    dual = backend.problem().dual
    assert len(dual) == 3 * len(backend.growth.graph.between) > rows
    assert_array_equal(dual[:rows], improvement.dual)
    assert_array_equal(dual[rows:], 0)
    assert np.abs(improvement.dual).max() == 1.0


def test_a_warm_update_does_more_with_little_work_than_a_cold_one(world):
    warm, cold = Backend(se2, EVERY), Backend(se2, EVERY)
    play(warm, world, 0, 149)
    settled(warm)
    play(warm, world, 149)
    play(cold, world)
    options = OptimiserOptions(outer_iterations=2, inner=PrimalDualOptions(iterations=100))
    first, second = (improve(backend.problem(), options, PLENTY) for backend in (warm, cold))
    best = batch_of(world.graph).cost
    assert first.cost_before < 0.2 * second.cost_before
    assert first.reweighted_steps == 0 < second.reweighted_steps
    assert first.cost / best - 1 < 0.5 * (second.cost / best - 1)


def test_the_account_of_an_update_is_true(world):
    backend = Backend(se2, EVERY)
    play(backend, world, 0, 80)
    problem = backend.problem()
    improvement = improve(problem, EVERY.solver, PLENTY)
    assert improvement.cost_before == cost(problem.graph, problem.poses)
    assert improvement.cost == cost(problem.graph, improvement.poses)
    assert improvement.cost <= improvement.cost_before
    assert improvement.reweighted_steps >= 1
    backend.adopt(improvement)
    assert backend.problem().last_cost == improvement.cost


# Options and errors


def test_options_may_change_on_the_way(world):
    backend = Backend(se2, EVERY)
    play(backend, world, 0, 40)
    settled(backend)
    poses = backend.poses
    backend.set_options(BackendOptions(
        KeyframeOptions(1e6, 0.0, 0.0), EVERY.odometry,
        solver=OptimiserOptions(outer_iterations=1)))
    assert_array_equal(backend.poses, poses)
    play(backend, world, 40, 60)
    assert len(backend.poses) == 40


def test_a_variance_of_nearly_zero_does_not_end_the_map():
    backend = Backend(se2, EVERY)
    for k in range(5):
        backend.add_odometry(odometry(k, (k, 0.0, 0.0), 1e-308 * np.eye(6)))
    backend.add_loop(loop(0.0, 4.0, (4.1, 0.0, 0.0)))
    with np.errstate(over='ignore', invalid='ignore'):
        assert backend.update(PLENTY) is not None
