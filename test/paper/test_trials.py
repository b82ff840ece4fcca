# SPDX-License-Identifier: Apache-2.0
"""The paper's two trials: noisy starts and loops that lie, and how far off the maps end."""

import numpy as np
import pytest

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.paper import trials
from l1slam_ros.paper.experiments import Effort
from l1slam_ros.paper.trials import JOINT, L1, L2, NOISES, ROBUST, SEED, START, huber_name

TWICE = Effort(draws=2)
PRINTED = Effort(outer=2, inner=40)


def generator():
    return np.random.default_rng(0)


@pytest.fixture(scope='module')
def world():
    return simulate_world(80, 160, WorldOptions(), np.random.default_rng(3))


@pytest.fixture(scope='module')
def starts(world):
    return trials.try_noisy_starts(world.graph, world.odometry, TWICE, PRINTED, generator())


@pytest.fixture(scope='module')
def liars(world):
    return trials.try_false_loops(world.graph, world.odometry, 3, TWICE, generator())


def pairs_of(graph):
    return set(zip(graph.between.i.tolist(), graph.between.j.tolist(), strict=True))


def test_noise_has_its_size_in_every_axis_of_every_pose():
    world = simulate_world(3000, 4000, WorldOptions(), np.random.default_rng(3))
    noisy = trials.with_noise(world.graph, world.truth, 0.2, generator())
    step = world.graph.manifold.local(world.truth, noisy)
    np.testing.assert_allclose(step.std(axis=0), 0.2, rtol=0.05)
    np.testing.assert_allclose(step.mean(axis=0), 0, atol=0.015)


def test_every_noise_is_drawn_as_often_as_asked_and_every_draw_is_another(starts):
    assert [trial.noise for trial in starts.trials] == np.repeat(NOISES, 2).tolist()
    costs = [trial.maps[START].cost for trial in starts.trials]
    assert len(set(costs)) == len(costs)
    assert np.all(np.diff(np.reshape(costs, (-1, 2)).mean(axis=1)) > 0)


def test_a_method_never_ends_above_the_start_and_the_seed_needs_none(world, starts):
    for trial in starts.trials:
        assert max(trial.maps[L2].cost, trial.maps[L1].cost) < trial.maps[START].cost
        assert starts.solution.cost <= trial.maps[L1].cost * (1 + 1e-5)
    assert starts.solution.cost < starts.seed.cost < starts.l2.cost
    assert starts.printed[0] == starts.seed.cost and len(starts.printed) == 3
    assert starts.solution.error < 1e-12 < starts.seed.error < starts.bent
    other = trials.try_noisy_starts(world.graph, world.truth, Effort(draws=1), PRINTED,
                                    generator())
    assert other.seed.cost == starts.seed.cost and other.l2.cost == starts.l2.cost


def test_much_noise_bends_what_l2_makes_and_little_does_not(starts):
    of = {noise: [trial.maps[L2].error for trial in starts.trials if trial.noise == noise]
          for noise in (NOISES[0], NOISES[-1])}
    assert max(of[NOISES[0]]) < starts.bent < min(of[NOISES[-1]])


def test_maps_lie_on_the_one_they_are_compared_with(world, starts):
    ours = starts.solution.positions
    np.testing.assert_allclose(starts.bent, 0.02 * np.hypot(*np.ptp(ours, axis=0)))
    for trial in starts.trials:
        shown = trial.maps[L2]
        np.testing.assert_allclose(
            np.sqrt(((shown.positions - ours) ** 2).sum(axis=1).mean()), shown.error)
        assert absolute_trajectory_error(shown.positions, ours) == pytest.approx(shown.error)


def test_false_loops_are_new_and_between_far_poses(world, liars):
    assert len(liars.trials) == 2
    true = pairs_of(world.graph)
    for trial in liars.trials:
        assert len(trial.false) == 3 and not {tuple(pair) for pair in trial.false.tolist()} & true
        i, j = trial.false.T
        apart = np.linalg.norm(world.truth[i, :2] - world.truth[j, :2], axis=1)
        assert apart.min() > 0.5
    assert (liars.trials[0].false != liars.trials[1].false).any()
    assert {tuple(pair) for pair in liars.loops.tolist()} < true
    assert len(liars.loops) == np.count_nonzero(~world.graph.between.is_odometry)


def test_the_robust_map_is_the_clean_one_and_the_widest_huber_is_not(liars):
    widest = huber_name(max(trials.HUBER_WIDTHS))
    for trial in liars.trials:
        assert len(trial.refused) == 3 and not len(trial.kept) and not len(trial.lost)
        assert trial.maps[ROBUST].error < 1e-6
        assert trial.maps[widest].error > 10 * max(trial.maps[ROBUST].error, 1e-3)
        assert set(trial.maps) == set(liars.clean) >= {SEED, JOINT}


def test_each_method_is_compared_with_its_own_clean_map(liars):
    assert liars.clean[JOINT].error < 1e-12
    for trial in liars.trials:
        for method, shown in trial.maps.items():
            assert shown.error == pytest.approx(absolute_trajectory_error(
                shown.positions, liars.clean[method].positions), abs=1e-9)


def test_a_lie_costs_in_l1(world, liars):
    clean = liars.clean[JOINT].cost
    assert all(trial.maps[JOINT].cost > clean for trial in liars.trials)
    assert np.abs(whitened_residual(world.graph, world.truth)).sum() > clean


def test_each_step_is_counted(world):
    told = []
    trials.try_false_loops(world.graph, world.odometry, 1, Effort(draws=1), generator(),
                           lambda: told.append('draw'))
    trials.try_noisy_starts(world.graph, world.odometry, Effort(draws=1), PRINTED, generator(),
                            lambda: told.append('start'))
    assert told == ['draw'] * 2 + ['start'] * len(NOISES)


def test_too_small_a_graph_has_no_room_for_them():
    world = simulate_world(6, 6, WorldOptions(), np.random.default_rng(3))
    with pytest.raises(GraphError, match='50 false loops asked for'):
        trials.try_false_loops(world.graph, world.odometry, 50, TWICE, generator())
