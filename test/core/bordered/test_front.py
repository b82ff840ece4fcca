# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The front: the map it moves and its gate, while no worker helps it."""

import numpy as np
import pytest
from fixes import seen
from lies import careful_world, is_false, spoilt
from numpy.testing import assert_allclose
from problems import EVERY, covariance6, drive_on, play, straight
from systems import dense_covariance

from l1slam_ros.core.bordered import front
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.online.builder_state import BuilderState
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.running.factor_table import FRONT
from l1slam_ros.core.running.improve import improve
from l1slam_ros.core.running.keeper.work import make_map
from l1slam_ros.core.running.optimised import Optimised
from l1slam_ros.core.running.snapshot import ACCEPTED, SavedMap
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

N = 180
KNOWN = 140
LAST = 150
SURE = covariance6(1e-4 * np.eye(3))


@pytest.fixture(scope='module')
def world():
    return careful_world(N, 2 * N)


def alone(world):
    """Return a back end whose front goes on from a settled map, without workers."""
    backend = Backend(EVERY)
    play(backend, world, 0, KNOWN)
    backend.settle()
    backend._updates._begin_due = lambda *_: False
    return backend


def test_without_a_worker_the_map_stays_near_the_optimum_and_knows_how_sure_it_is(world):
    backend = alone(world)
    for k in range(KNOWN, LAST):
        play(backend, world, k, k + 1)
        backend.update(10.0)
        assert backend._keeper.state.table.looked == len(backend.snapshot().graph.between)
    now = backend.snapshot()
    assert (now.loop_states().state == ACCEPTED).mean() > 0.98
    problem = now.problem()
    cost = l1_cost(whitened_residual(problem.part, now.poses))
    assert cost < 1.1 * improve(problem, EVERY.solver, 1.0, exact=True).cost
    # The covariance of any keyframe is that of all factors at once, as they were linearised.
    whole = dense_covariance(now)
    for keyframe in (1, 60, KNOWN - 1, KNOWN, LAST - 1):
        assert_allclose(backend.marginal_covariance(keyframe),
                        whole[keyframe - 1, :, keyframe - 1], rtol=1e-4, atol=1e-9)
    assert_allclose(backend.marginal_covariance(0), 0)
    assert backend.marginal_covariance(LAST) is None is Backend(EVERY).marginal_covariance(0)


def in_space():
    return simulate_world(60, 130, WorldOptions(), np.random.default_rng(2), 'building').graph


def seen_from_above():
    made = simulate_world(60, 90, WorldOptions(), np.random.default_rng(2))
    return seen(made.graph, made.truth, 5, np.random.default_rng(3), sigma=0.3).graph


@pytest.mark.parametrize(('graph_of', 'fixed'), [(in_space, 1), (seen_from_above, 0)])
def test_how_sure_it_is_in_space_and_in_the_world(graph_of, fixed):
    graph = graph_of()
    poses = odometry_poses(graph)
    state = BuilderState.of_graph(graph, poses, np.arange(60) * 10**9)
    backend = Backend(EVERY, len(graph.manifold.positions(poses)[0]))
    backend.restore(SavedMap(state, Optimised.nothing(poses), Judgement.nothing(), True))
    assert backend.marginal_covariance(59) is None
    backend.settle()
    whole = dense_covariance(backend.snapshot())
    assert len(whole) == 60 - fixed
    for keyframe in (1, 30, 59):
        own = keyframe - fixed
        assert_allclose(backend.marginal_covariance(keyframe), whole[own, :, own], rtol=1e-6,
                        atol=1e-9)


def test_at_rest_the_noise_is_that_of_the_last_judgement(world):
    backend = Backend(EVERY)
    for first in range(0, 120, 10):
        play(backend, world, first, first + 10)
        backend.update(10.0)
    while backend.update(10.0) is not None:
        pass
    assert_allclose(backend.marginal_covariance(119),
                    dense_covariance(backend.snapshot())[-1, :, -1], rtol=1e-6, atol=1e-12)


def test_of_a_part_that_nothing_joins_hardly_anything_is_known():
    backend = Backend(EVERY)

    def drive(first, count):
        drive_on(backend, straight(count), 0, SURE, first, 1.0)
        backend.settle()
        return backend.marginal_covariance(len(backend.poses) - 1)

    known, unknown = drive(100.0, 10), drive(50.0, 3)
    assert 0 < known[0, 0] < 0.1 and unknown[0, 0] > 50 and unknown[2, 2] > 0.9


@pytest.mark.parametrize('kind', ['random', 'identity', 'grouped'])
def test_the_gate_lets_no_lie_in(world, kind):
    lies = spoilt(world, kind, 130)
    backend = alone(lies)
    for k in range(KNOWN, N):
        play(backend, lies, k, k + 1)
        backend.update(10.0)
    now = backend.snapshot()
    false, accepted = is_false(lies, now.graph.between), now.judgement.accepted
    new = backend._keeper.state.table.rows['said_by'] == FRONT
    loops = new & ~now.graph.between.is_odometry
    assert np.count_nonzero(false & new) > 5 and not (false & accepted).any()
    # The others wait for the judgement.
    assert accepted[loops & ~false].mean() > 0.7


def test_what_it_is_not_to_take_costs_a_front_nothing(world):
    backend = alone(world)
    play(backend, world, KNOWN, LAST)
    front, factors = backend._keeper._front, backend.snapshot().graph.between
    new = slice(front.rows, front.rows + 20)
    odometry = factors.is_odometry[new]
    looks = front.take(factors, odometry.astype(int))
    assert [look.accepted for look in looks] == odometry.tolist() and not odometry.all()
    # What is touched: the last keyframe it knew and the new ones, not the far ends of loops.
    assert [system.points for system in front._systems] == 2 * [1 + odometry.sum()]
    assert front.rows == new.stop and front.taken == odometry.sum()


def test_loops_that_come_before_a_map_is_made_are_looked_at_by_its_front(world):
    backend = alone(world)
    begun = len(backend.snapshot().graph.between)
    play(backend, world, KNOWN, LAST)
    # No update lets the last front look at them.
    assert not (backend._keeper.state.table.rows['said_by'] == FRONT).any()
    make_map(backend._keeper, False, 10.0, lambda: None)
    now = backend.snapshot()
    assert backend._keeper._front.rows == len(now.graph.between) > begun + 2 * (LAST - KNOWN) / 3
    assert now.judgement.accepted[begun:].mean() > 0.9


def test_a_front_that_is_full_leaves_loops_to_the_next_one(world, monkeypatch):
    backend = alone(world)
    begun = len(backend.snapshot().graph.between)
    play(backend, world, KNOWN, LAST)
    with monkeypatch.context() as patched:
        patched.setattr(front, '_MOST_POINTS', -1)
        make_map(backend._keeper, False, 10.0, lambda: None)
    assert backend._keeper._front.closed and backend.behind().bound > 0
    now = backend.snapshot()
    new = now.graph.between.is_odometry[begun:]
    assert now.judgement.accepted[begun:].tolist() == new.tolist()
    assert now.judgement.suspect[begun:].tolist() == (~new).tolist()
    make_map(backend._keeper, False, 10.0, lambda: None)
    assert backend.snapshot().judgement.accepted[begun:].mean() > 0.9


def test_a_front_that_fails_is_closed_and_moves_nothing(world, monkeypatch):
    backend = alone(world)
    front = backend._keeper._front

    def fail(*_):
        raise np.linalg.LinAlgError

    before = backend.poses
    monkeypatch.setattr(front._systems[1], 'add', fail)
    play(backend, world, KNOWN, KNOWN + 5)
    backend.update(10.0)
    assert front.closed
    assert_allclose(backend.poses[:KNOWN], before, atol=1e-12)
    # Keyframes to come follow the odometry.
    assert len(backend.poses) == KNOWN + 5 and np.isfinite(backend.poses).all()


def test_what_no_odometry_ties_to_the_map_is_for_the_next_one():
    backend = Backend(EVERY)
    drive_on(backend, straight(5), 0, SURE, 1.0, 1.0)
    backend.settle()
    backend._updates._begin_due = lambda *_: False
    # The clock is set back: a part of its own begins.
    drive_on(backend, straight(4), 0, SURE, 1.0, 1.0)
    assert backend.update(10.0) is not None and backend._keeper._front.closed
    assert len(backend.poses) == 9 and np.isfinite(backend.poses).all()


def test_how_far_the_optimum_is_at_most_is_known_at_any_time(world):
    backend = Backend(EVERY)
    assert np.isnan(backend.behind().bound)
    play(backend, world, 0, KNOWN)
    backend.settle()
    proved = backend.behind()
    backend._updates._begin_due = lambda *_: False
    play(backend, world, KNOWN, LAST)
    backend.update(10.0)
    now, behind = backend.snapshot(), backend.behind()
    best = improve(now.problem(), EVERY.solver, 1.0, exact=True).cost
    assert behind.bound == proved.bound and behind.bound_age > proved.bound_age
    # With ten keyframes more the optimum has risen, by little.
    assert 0.8 * best < behind.bound <= best
    assert behind.rows > 0 == proved.rows and behind.loops > 0 == proved.loops
    # Of fewer factors nothing was proved.
    states = backend.loop_states()
    reference, stamp = states.stamps[np.argmax(states.state == ACCEPTED)].tolist()
    backend.add_loop(LoopClosure(reference, stamp, np.eye(7)[6], np.eye(6), struck=True))
    backend.update(10.0)
    assert np.isnan(backend.behind().bound)
