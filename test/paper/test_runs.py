# SPDX-License-Identifier: Apache-2.0
"""The paper's two repeated runs: noisy starts and loops that lie, and how far off the maps end."""

import numpy as np
import pytest

from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.paper import runs
from l1slam_ros.paper.experiments import Effort
from l1slam_ros.paper.runs import HUBERS, JOINT, L1, L2, NOISES, ROBUST, SEED, START

TWICE = Effort(draws=2)
PRINTED = Effort(outer=2, inner=40)


def generator():
    return np.random.default_rng(0)


@pytest.fixture(scope='module')
def world():
    return simulate_world(80, 160, WorldOptions(), np.random.default_rng(3))


@pytest.fixture(scope='module')
def told():
    """What the runs counted, each as it was done."""
    return []


@pytest.fixture(scope='module')
def starts(world, told):
    return runs.run_noisy_starts(world.graph, world.odometry, TWICE, PRINTED, generator(),
                                 lambda: told.append('start'))


@pytest.fixture(scope='module')
def liars(world, told):
    return runs.run_false_loops(world.graph, world.odometry, 3, TWICE, generator(),
                                lambda: told.append('draw'))


def pairs_of(graph):
    return set(map(tuple, graph.between.pairs.tolist()))


def test_noise_has_its_size_in_every_axis_of_every_pose():
    world = simulate_world(3000, 4000, WorldOptions(), np.random.default_rng(3))
    noisy = runs.with_noise(world.graph, world.truth, 0.2, generator())
    step = world.graph.manifold.local(world.truth, noisy)
    np.testing.assert_allclose(step.std(axis=0), 0.2, rtol=0.05)
    np.testing.assert_allclose(step.mean(axis=0), 0, atol=0.015)


def test_every_noise_is_drawn_as_often_as_asked_and_every_draw_is_another(starts):
    costs = np.array([[maps[START].cost for maps in starts.noisy[noise]] for noise in NOISES])
    assert costs.shape == (len(NOISES), 2) and len(np.unique(costs)) == costs.size
    assert np.all(np.diff(costs.mean(axis=1)) > 0)


def test_a_method_never_ends_above_the_start_and_the_seed_needs_none(world, starts):
    seed, l2, ours = (starts.from_seed[method] for method in (START, L2, L1))
    for maps in sum(starts.noisy.values(), []):
        assert max(maps[L2].cost, maps[L1].cost) < maps[START].cost
        assert ours.cost <= maps[L1].cost * (1 + 1e-5)
    assert ours.cost < seed.cost < l2.cost
    assert starts.printed[0] == seed.cost and len(starts.printed) == 3
    assert ours.error < 1e-12 < seed.error < starts.bent
    other = runs.run_noisy_starts(world.graph, world.truth, Effort(draws=0), PRINTED, generator())
    assert {m: shown.cost for m, shown in other.from_seed.items()} == {
        m: shown.cost for m, shown in starts.from_seed.items()}


def test_much_noise_bends_what_l2_makes_and_little_does_not(starts):
    least, most = ([maps[L2].error for maps in starts.noisy[noise]]
                   for noise in (NOISES[0], NOISES[-1]))
    assert max(least) < starts.bent < min(most)


def test_maps_lie_on_the_one_they_are_compared_with(starts):
    ours = starts.from_seed[L1].positions
    np.testing.assert_allclose(starts.bent, 0.02 * np.hypot(*np.ptp(ours, axis=0)))
    for maps in sum(starts.noisy.values(), []):
        shown = maps[L2]
        np.testing.assert_allclose(
            np.sqrt(((shown.positions - ours) ** 2).sum(axis=1).mean()), shown.error)
        assert absolute_trajectory_error(shown.positions, ours) == pytest.approx(shown.error)


def test_false_loops_are_new_and_between_far_poses(world, liars):
    assert len(liars.runs) == 2
    true = pairs_of(world.graph)
    for run in liars.runs:
        assert len(run.refused) == 3 and not {tuple(pair) for pair in run.refused.tolist()} & true
        i, j = run.refused.T
        apart = np.linalg.norm(world.truth[i, :2] - world.truth[j, :2], axis=1)
        assert apart.min() > 0.5
    assert (liars.runs[0].refused != liars.runs[1].refused).any()
    assert {tuple(pair) for pair in liars.loops.tolist()} < true
    assert len(liars.loops) == np.count_nonzero(~world.graph.between.is_odometry)


def test_the_robust_map_is_the_clean_one_and_the_widest_huber_is_not(liars):
    *_, widest = HUBERS
    for run in liars.runs:
        assert not len(run.kept) and not len(run.lost)
        assert run.maps[ROBUST].error < 1e-6
        assert run.maps[widest].error > 10 * max(run.maps[ROBUST].error, 1e-3)
        assert run.maps.keys() == liars.clean.keys() >= {SEED, JOINT}


def test_each_method_is_compared_with_its_own_clean_map_and_a_lie_costs_in_l1(liars):
    assert liars.clean[JOINT].error < 1e-12
    for run in liars.runs:
        assert run.maps[JOINT].cost > liars.clean[JOINT].cost
        for method, shown in run.maps.items():
            assert shown.error == pytest.approx(absolute_trajectory_error(
                shown.positions, liars.clean[method].positions), abs=1e-9)


def test_each_step_is_counted(starts, liars, told):
    assert told.count('start') == 2 * len(NOISES) and told.count('draw') == 1 + 2
