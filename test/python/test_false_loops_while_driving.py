# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""While a robot drives: false loops, slips and drift bend no map, and at rest all is judged."""

import time
from functools import cache

import numpy as np
import pytest
from backends import (
    CREDULOUS,
    EVERY,
    PLENTY,
    World,
    loops_by,
    odometry_of,
    play,
    played,
    remeasured,
    settled,
    simulated,
    states,
    turning,
)
from heard import PERIOD, covariance6, loop, odometry, seconds
from numpy.testing import assert_allclose
from worlds import between, compose, position_error

import l1slam_ros as l1

N, FALSE = 300, 130  # keyframes and false loops


@pytest.fixture(scope='module')
def world(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp('clean'), N, 2 * N)


@pytest.fixture(scope='module')
def spoilt(tmp_path_factory):
    """The same drive with false loops of a kind."""
    return cache(lambda kind: simulated(tmp_path_factory.mktemp(kind), N, 2 * N,
                                        '--false-loops', FALSE, '--kind', kind))


def error_of(backend, truth):
    poses = backend.poses
    return position_error(poses[:, :2], truth[:len(poses), :2])


def errors_on_the_way(world, backend, look=lambda: None):
    """Return the position error [m] after each update, one every 15 keyframes."""
    errors = []
    for k in range(0, N, 15):
        play(backend, world.graph, k, k + 15)
        backend.update(PLENTY)
        errors.append(error_of(backend, world.truth))
        look()
    return np.array(errors)


@pytest.fixture(scope='module')
def clean_errors(world):
    return errors_on_the_way(world, l1.Backend(EVERY))


def wrong(world, backend):
    """Return how many false loops are accepted, and how many true ones are not, and rejected."""
    accepted, rejected = (loops_by(backend, state) for state in ('accepted', 'rejected'))
    lost = loops_by(backend, 'suspect', 'rejected')
    return len(accepted & world.false), len(lost - world.false), len(rejected - world.false)


@pytest.mark.parametrize('kind', ['random', 'identity', 'grouped'])
def test_no_false_loop_is_accepted_at_any_time(spoilt, world, clean_errors, kind):
    """With 30% of them false the map never bends, and at rest it is that of the batch."""
    bad, backend = spoilt(kind), l1.Backend(EVERY)
    np.testing.assert_array_equal(bad.truth, world.truth)

    def look():
        false, _, refused = wrong(bad, backend)
        assert false == 0 and refused <= 0.01 * (N + 1) + 1

    errors = errors_on_the_way(bad, backend, look)
    assert (errors < 1.2 * clean_errors + 0.1).all()
    assert len(loops_by(backend, 'rejected') & bad.false) > 0.95 * FALSE
    assert wrong(bad, backend)[1] <= 0.01 * (N + 1)
    found = backend.settle()
    graph = backend.snapshot().graph
    batch = l1.solve(graph)
    assert found.cost == pytest.approx(batch.cost, rel=1e-6)
    pairs = graph.between.pairs[batch.inliers & ~graph.between.is_odometry]
    assert loops_by(backend, 'accepted') == {
        (0, 0, *pair) for pair in (pairs * seconds(PERIOD)).tolist()}


def test_at_rest_all_is_judged_from_the_graph_alone(world, clean_errors):
    """While driving a slip is not looked for, and what was accepted beside it stays."""
    factors, measurement = world.graph.between, world.graph.between.measurement.copy()
    measurement[factors.step_to[151], 2] += 0.8
    slipped = World(remeasured(world.graph, measurement), world.truth, set())
    backend = l1.Backend(EVERY)
    errors_on_the_way(slipped, backend)
    settled(backend)
    now = backend.snapshot().graph.between
    assert now.pairs[backend.counts().verdict.slips].tolist() == [[150, 151]]
    assert error_of(backend, world.truth) < 1.2 * clean_errors[-1] + 0.1


def test_false_loops_in_the_map_are_rejected_once_loops_are_judged(spoilt):
    bad = spoilt('random')
    backend = played(bad.graph, options=CREDULOUS)
    settled(backend)
    assert set(states(backend).values()) == {'accepted'}
    backend.set_options(EVERY)
    settled(backend)
    false, lost, _ = wrong(bad, backend)
    assert false == 0 and lost <= 2
    backend.set_options(CREDULOUS)
    assert set(states(backend).values()) == {'accepted'}


def test_a_loop_that_could_be_chance_is_suspect_until_another_confirms_it():
    """On a round whose odometry drifts so far that one loop back to its start could be chance."""
    noise, rng = np.array([0.3, 0.3, 0.03]), np.random.default_rng(0)
    step, truth = np.array([1.0, 0.0, 2 * np.pi / 200]), np.zeros((220, 3))
    backend, pose = l1.Backend(EVERY), np.zeros(3)
    for k in range(220):
        backend.add_odometry(odometry(k * PERIOD, pose, covariance6(np.diag(noise**2))))
        truth[k] = compose(truth[k - 1], step) if k else truth[0]
        pose = compose(pose, compose(step, noise * rng.standard_normal(3)))
    settled(backend)
    drifted = error_of(backend, truth)

    def see(i, j):
        backend.add_loop(loop(i * PERIOD, j * PERIOD, between(truth[i], truth[j]),
                              covariance6(np.diag([1e-2, 1e-2, 1e-3]))))
        backend.update(PLENTY)

    see(3, 203)
    assert list(states(backend).values()) == ['suspect']
    assert backend.loop_states().sigmas[0] < 4
    assert error_of(backend, truth) == pytest.approx(drifted, rel=1e-6)
    see(30, 140)
    assert list(states(backend).values()) == ['accepted', 'accepted']
    assert error_of(backend, truth) < 0.5 * drifted


def test_a_run_of_false_loops_that_comes_first_bends_no_map_before_the_robot_stands(datasets):
    """Bicocca begins with eleven of them, and hardly a true loop."""
    graph, _ = l1.read_graph(datasets / 'real' / 'bicocca25b_0.150.g2o')
    backend = played(graph, 0, 1600)
    chain = odometry_of(graph)[:1600]
    backend.update(PLENTY)
    assert len(loops_by(backend, 'accepted')) == 0 and backend.behind().loops == 0
    assert error_of(backend, chain) < 1e-6
    time.sleep(2.0)  # it stands
    settled(backend)
    assert len(loops_by(backend, 'accepted')) > 10 and error_of(backend, chain) > 1.0


# Odometry that drifts

DRIFT = 0.05  # [rad/m]


@pytest.fixture(scope='module')
def bad(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp('drift'), 400, 800, '--false-loops', 100)


def test_odometry_that_drifts_is_corrected_while_driving_and_at_rest(bad):
    backend, errors = l1.Backend(EVERY), []
    drifting = turning(bad.graph, -DRIFT)
    for k in range(0, 400, 4):
        play(backend, drifting, k, k + 4)
        backend.update(0.05)
        errors.append(error_of(backend, bad.truth))
        if k == 196:
            backend.settle()
    backend.settle()
    assert backend.counts().verdict.drift == pytest.approx(DRIFT, abs=2e-3)
    assert error_of(backend, bad.truth) < 0.5
    # Once it is known, what comes is corrected before any loop of it is judged.
    assert max(errors[:50]) > 5.0 > 1.0 > max(errors[50:])
    loaded = l1.Backend(EVERY)
    loaded.restore(backend.saved())
    loaded.update(PLENTY)
    assert_allclose(loaded.poses, backend.poses, atol=1e-6)
    assert loaded.counts().verdict.drift == backend.counts().verdict.drift
