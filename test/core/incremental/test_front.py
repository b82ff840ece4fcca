# SPDX-License-Identifier: Apache-2.0
"""The front: the map it moves and its gate, while no worker helps it."""

import numpy as np
import pytest
from lies import careful_world, is_false, spoilt
from numpy.testing import assert_allclose
from problems import covariance6, odometry, play

from l1slam_ros.core.graph.linear_system import linearise, whitened_residual
from l1slam_ros.core.online.backend import Backend, BackendOptions
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.online.loop_states import ACCEPTED
from l1slam_ros.core.online.update import EXACT, improve
from l1slam_ros.core.solvers.optimality import l1_cost

EVERY = BackendOptions(KeyframeOptions(0.0, 0.0, 0.0), OdometryOptions('increment'))
N, KNOWN, LAST = 180, 140, 150


@pytest.fixture(scope='module')
def world():
    return careful_world(N, 2 * N)


def alone(world):
    """Return a back end whose front goes on from a settled map, without workers."""
    backend = Backend(EVERY)
    play(backend, world, 0, KNOWN)
    backend.settle()
    backend._begin_due = lambda *_: False
    return backend


def test_without_a_worker_the_map_stays_near_the_optimum_and_knows_how_sure_it_is(world):
    backend = alone(world)
    for k in range(KNOWN, LAST):
        play(backend, world, k, k + 1)
        backend.update(10.0)
        assert len(backend._live.looks) == len(backend.snapshot().graph.between) - len(
            backend._live.optimised.judgement.accepted)
    now = backend.snapshot()
    assert (now.loop_states().state == ACCEPTED).mean() > 0.98
    problem = now.problem()
    cost = l1_cost(whitened_residual(problem.part, now.poses))
    assert cost < 1.1 * improve(problem, EVERY.solver, 1.0, accuracy=EXACT).cost
    # The covariance of any keyframe is that of all factors at once, as they were linearised.
    kinds = (~problem.graph.between.is_odometry)[problem.judgement.accepted].astype(int)
    system = linearise(problem.part, now.views[1].first)
    weights = np.repeat(1 / problem.judgement.variance[kinds], 3)
    A = system.A.toarray()
    whole = np.linalg.inv(A.T @ (weights[:, None] * A))
    for keyframe in (1, 60, KNOWN - 1, KNOWN, LAST - 1):
        own = slice(3 * keyframe - 3, 3 * keyframe)
        assert_allclose(backend.marginal_covariance(keyframe), whole[own, own], rtol=1e-4,
                        atol=1e-9)
    assert_allclose(backend.marginal_covariance(0), 0)
    assert backend.marginal_covariance(LAST) is None is Backend(EVERY).marginal_covariance(0)


@pytest.mark.parametrize('kind', ['random', 'identity', 'grouped'])
def test_the_gate_lets_no_lie_in(world, kind):
    lies = spoilt(world, kind, 130)
    backend = alone(lies)
    for k in range(KNOWN, N):
        play(backend, lies, k, k + 1)
        backend.update(10.0)
    now = backend.snapshot()
    false, accepted = is_false(lies, now.graph.between), now.judgement.accepted
    new = np.arange(len(accepted)) >= len(backend._live.optimised.judgement.accepted)
    loops = new & ~now.graph.between.is_odometry
    assert np.count_nonzero(false & new) > 5 and not (false & accepted).any()
    # The others wait for the judgement.
    assert accepted[loops & ~false].mean() > 0.7


def test_a_front_that_fails_is_closed_and_moves_nothing(world, monkeypatch):
    backend = alone(world)
    front = backend._live.front

    def fail(*_):
        raise np.linalg.LinAlgError

    before = backend.poses
    monkeypatch.setattr(front._map, 'add', fail)
    play(backend, world, KNOWN, KNOWN + 5)
    backend.update(10.0)
    assert front.closed
    assert_allclose(backend.poses[:KNOWN], before, atol=1e-12)
    # Keyframes to come follow the odometry.
    assert len(backend.poses) == KNOWN + 5 and np.isfinite(backend.poses).all()


def test_what_no_odometry_ties_to_the_map_is_for_the_next_one():
    backend = Backend(EVERY)

    def drive(count):
        for k in range(count):
            backend.add_odometry(odometry(k + 1.0, (k, 0.0, 0.0), covariance6(1e-4 * np.eye(3))))

    drive(5)
    backend.settle()
    backend._begin_due = lambda *_: False
    drive(4)  # the clock is set back: a part of its own begins
    assert backend.update(10.0) is not None and backend._live.front.closed
    assert len(backend.poses) == 9 and np.isfinite(backend.poses).all()
