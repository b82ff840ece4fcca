# SPDX-License-Identifier: Apache-2.0
"""Lies are refused, truth is kept, and what cannot be told is left open."""

import numpy as np
import pytest
from problems import add_absolute, retold

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.spanning_tree import pair_key
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.robust.judgement import OTHER_MAP, SLIP
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world, with_false_loops

# Odometry good enough for a drive of 400 m to come back near where it was.
OPTIONS = WorldOptions(odometry_sigma_rotation=0.005)


def error(poses, others):
    return absolute_trajectory_error(se2.positions(poses), se2.positions(others))


@pytest.fixture(scope='module')
def world():
    return simulate_world(400, 800, OPTIONS, np.random.default_rng(0))


def spoilt(world, kind, count, seed=1):
    """Return the graph with false loops, and which of its factors are true."""
    loops = FALSE_LOOPS[kind](world.graph, world.truth, count, np.random.default_rng(seed))
    graph = with_false_loops(world, loops).graph
    n, factors = graph.n_poses, graph.between
    return graph, ~np.isin(pair_key(factors.i, factors.j, n), pair_key(loops.i, loops.j, n))


@pytest.mark.parametrize('kind', FALSE_LOOPS)
@pytest.mark.parametrize('count', [20, 401, 1600])
def test_false_loops_are_refused_and_true_ones_kept(world, kind, count):
    graph, true = spoilt(world, kind, count)
    solution, poses = robust_solve(graph)
    assert not (solution.accepted & ~true).any()
    assert np.count_nonzero(true & ~solution.accepted) <= 4
    assert error(poses, world.truth) < 0.2
    assert not len(solution.slips)


def test_a_clean_graph_keeps_all_its_loops(world):
    solution, _ = robust_solve(world.graph)
    # One true loop in a thousand is beyond the gate.
    assert np.count_nonzero(~solution.accepted) <= 2
    assert not solution.doubts


def test_a_graph_of_odometry_alone_is_its_chain(world):
    loops = ~world.graph.between.is_odometry
    solution, poses = robust_solve(world.graph.subset(~loops))
    assert error(poses, world.odometry) < 1e-6
    assert solution.accepted.all() and not solution.suspect.any()


@pytest.mark.parametrize('offset', [(5.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2)])
def test_a_slip_of_the_odometry_is_found_and_named(world, offset):
    graph, true = spoilt(world, 'random', 170)
    factors = graph.between
    slip = int(np.flatnonzero(factors.is_odometry)[200])

    def change(measurement):
        measurement[slip] = se2.retract(measurement[slip][None], np.array([offset]))[0]
        return measurement

    solution, poses = robust_solve(retold(graph, change(graph.between.measurement.copy())))
    assert len(solution.slips) == 1
    # Between loops nobody can tell which of the steps it was.
    assert abs(factors.i[solution.slips[0]] - factors.i[slip]) <= 3
    assert not (solution.accepted & ~true).any()
    assert error(poses, world.truth) < 0.3


def test_a_map_that_loops_agree_is_wrong_is_doubtful(world):
    # Two slips, and no single step explains what the loops across both agree upon.
    graph, _ = spoilt(world, 'random', 170)
    rng = np.random.default_rng(5)
    slipped = rng.choice(np.flatnonzero(graph.between.is_odometry), 2, replace=False)
    off = rng.normal(size=(2, 3)) * [4, 4, 1.5]

    def change(measurement):
        measurement[slipped] = se2.retract(measurement[slipped], off)
        return measurement

    steps = graph.between.i[np.sort(slipped)]
    solution, poses = robust_solve(retold(graph, change(graph.between.measurement.copy())))
    right = error(poses, world.truth) < 0.5
    assert right or {doubt.kind for doubt in solution.doubts} & {OTHER_MAP, SLIP}
    for doubt in solution.doubts:
        if doubt.kind == SLIP:
            assert doubt.last == doubt.first + 1
        else:
            assert doubt.loops > 10 and doubt.first < steps[0] < doubt.last


def test_a_trusted_loop_is_never_refused(world):
    graph, true = spoilt(world, 'random', 10)
    lie = int(np.flatnonzero(~true)[4])
    assert not robust_solve(graph)[0].accepted[lie]
    solution, _ = robust_solve(retold(graph, trusted=np.arange(len(true)) == lie))
    assert solution.accepted[lie]


def test_the_same_graph_gives_the_same_answer(world):
    graph, _ = spoilt(world, 'grouped', 401)
    (one, poses), (other, again) = robust_solve(graph), robust_solve(graph)
    np.testing.assert_array_equal(poses, again)
    np.testing.assert_array_equal(one.accepted, other.accepted)
    np.testing.assert_array_equal(one.sigmas, other.sigmas)


@pytest.mark.parametrize('variance', [0.01, 100.0])
def test_information_may_be_off_by_a_constant(world, variance):
    graph, true = spoilt(world, 'random', 401)
    solution, poses = robust_solve(retold(graph, times=np.sqrt(variance)))
    assert not (solution.accepted & ~true).any()
    assert np.count_nonzero(true & ~solution.accepted) <= 4
    np.testing.assert_allclose(solution.variance, 1 / variance, rtol=0.3)


def test_odometry_may_be_noisier_than_it_says(world):
    odometry = np.flatnonzero(world.graph.between.is_odometry)
    noise = np.random.default_rng(3).standard_normal((len(odometry), 3)) * [0.15, 0.15, 0.015]

    def change(measurement):
        measurement[odometry] = se2.retract(measurement[odometry], noise)
        return measurement

    graph = retold(world.graph, change(world.graph.between.measurement.copy()))
    solution, poses = robust_solve(graph)
    assert np.count_nonzero(~solution.accepted) <= 4
    assert solution.variance[0] > 2 * solution.variance[1]


def test_a_lone_far_loop_is_left_open():
    # A drive straight on: nothing but the drift says whether a loop to its start may be true.
    n = 400
    graph = FactorGraph(se2)
    graph.add_poses(n)
    i = np.arange(n - 1)
    step = np.tile([1.0, 0.0, np.pi / 200], (n - 1, 1))
    graph.add_between(i, i + 1, step, np.tile(np.diag([4.0, 4.0, 100.0]), (n - 1, 1, 1)))
    graph.add_between(np.array([0]), np.array([n - 1]), np.array([[1.0, 20.0, 0.5]]),
                      np.diag([100.0, 100.0, 1000.0])[None])
    solution, poses = robust_solve(graph)
    assert solution.suspect[-1] and not solution.accepted[-1]
    assert 0 < solution.sigmas[-1] < 4


def test_sigmas_say_how_far_off_a_loop_is(world):
    graph, true = spoilt(world, 'random', 50)
    solution, poses = robust_solve(graph)
    assert solution.sigmas[~true].min() > 4
    assert np.median(solution.sigmas[true]) < 3
    assert not (solution.suspect & solution.accepted).any()


def test_one_absolute_pose_fixes_the_gauge_and_nothing_else():
    world = simulate_world(100, 180, WorldOptions(), np.random.default_rng(5))
    graph = world.graph
    without, poses = robust_solve(graph)
    add_absolute(graph, np.array([3]), world.truth[3:4], np.eye(3)[None] * 1e4)
    found, poses = robust_solve(graph)
    assert len(found.accepted) == len(graph.between)
    assert found.accepted.tolist() == [*without.accepted, True]
