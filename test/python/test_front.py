# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The map between two solves: `Backend.update` while no background work helps it."""

import numpy as np
import pytest
from backends import CREDULOUS, EVERY, PLENTY, STATES, drive, loops_by, play, played, simulated
from heard import seconds
from numpy.testing import assert_allclose
from worlds import whitened

import l1slam_ros as l1

N, KNOWN = 180, 140
ACCEPTED = STATES.index('accepted')
COVARIANCE = np.diag([4e-4, 1e-4, 2e-4, 1e-5, 3e-5, 2e-5])


def take_all(backend):
    """Update as often as it takes on a busy machine until nothing waits for the front."""
    for _ in range(20):
        backend.update(0.0)


def covariance_of_all(graph, poses):
    """Return the covariance of all keyframes, by a dense inverse, (n, d, n, d)."""
    factors, manifold = graph.between, graph.manifold
    n, d = len(poses), manifold.TANGENT_SIZE
    ends = np.concatenate((poses, manifold.identity(1)))  # the last one is the world
    J = manifold.residual_jacobians(factors.measurement, ends[factors.i], ends[factors.j])
    A = np.zeros((len(factors), d, n + 1, d))
    for k, (i, j) in enumerate(zip(factors.i, factors.j, strict=True)):
        A[k][:, [i, j]] = (factors.sqrt_information[k] @ J[k]).swapaxes(0, 1)
    free = slice(0 if factors.is_absolute.any() else 1, n)
    A = A[:, :, free].reshape(len(factors) * d, -1)
    whole = np.zeros((n, d, n, d))
    whole[free, :, free] = np.linalg.inv(A.T @ A).reshape(whole[free, :, free].shape)
    return whole


@pytest.mark.parametrize('absolute', [False, True], ids=['from the first', 'in the world'])
@pytest.mark.parametrize('dimension', [2, 3])
def test_how_sure_the_map_is_of_a_keyframe(dimension, absolute):
    """Without noise all maps are the truth, where the covariance is a dense inverse."""
    backend = l1.Backend(CREDULOUS, dimension)
    manifold, n, loops = backend.manifold, 40, [(2, 17), (5, 30), (9, 34), (31, 38)]
    assert backend.marginal_covariance(0) is None
    step = manifold.from_pose3(np.array([[0.5, 0.1, 0.05, 0.02, -0.03, 0.2, 0.97]]))
    truth = manifold.identity(1)
    for _ in range(n - 1):
        truth = np.concatenate((truth, manifold.compose(truth[-1:], step)))

    def add(first, last):
        for k in range(first, last):
            backend.add_odometry(l1.OdometrySample(
                seconds(k), manifold.to_pose3(truth[k:k + 1])[0], COVARIANCE, 0 * COVARIANCE))
            for i in [i for i, j in loops if j == k]:
                seen = manifold.to_pose3(manifold.between(truth[i:i + 1], truth[k:k + 1]))
                backend.add_loop(l1.LoopClosure(seconds(i), seconds(k), seen[0], COVARIANCE / 9))
            if absolute and k % 8 == 0:
                backend.add_loop(l1.LoopClosure(
                    None, seconds(k), manifold.to_pose3(truth[k:k + 1])[0], COVARIANCE))

    def compare(count):
        now = backend.snapshot().graph
        assert now.n_poses == count
        assert_allclose(manifold.local(truth[:count], backend.poses), 0, atol=1e-5)
        whole = covariance_of_all(now, truth[:count])
        for k in (0, 1, 20, count - 1):
            assert_allclose(backend.marginal_covariance(k), whole[k, :, k], rtol=1e-6, atol=1e-12)
        i, j = 3, count - 1
        ends = truth[i:i + 1], truth[j:j + 1]
        J = np.hstack(manifold.residual_jacobians(manifold.between(*ends), *ends)[0])
        both = whole[[i, j]][:, :, [i, j]].reshape(J.shape[1], J.shape[1])
        assert_allclose(backend.marginal_covariance(j, i), J @ both @ J.T, rtol=1e-6, atol=1e-12)
        assert backend.marginal_covariance(count) is None

    add(0, 33)
    backend.settle()
    compare(33)
    with backend.calm:
        for k in range(33, n):
            add(k, k + 1)
            backend.update(0.0)
        take_all(backend)
        compare(n)


def test_of_a_part_that_nothing_joins_hardly_anything_is_known():
    backend = l1.Backend(EVERY)
    drive(backend, 100, 110)
    backend.settle()
    assert 0 < backend.marginal_covariance(9)[0, 0] < 0.1
    drive(backend, 50, 53)  # the clock was set back
    backend.settle()
    unknown = backend.marginal_covariance(12)
    assert unknown[0, 0] > 50 and unknown[2, 2] > 0.9
    with backend.calm:
        drive(backend, 1, 5)
        assert backend.update(0.0) is not None
        assert len(backend.poses) == 17 and np.isfinite(backend.poses).all()


def settled(graph):
    """Return a back end with a settled map of the first keyframes."""
    backend = played(graph, 0, KNOWN)
    backend.settle()
    return backend


def drive_on(backend, graph, last=N):
    """Add the other keyframes one by one, with an update each."""
    for k in range(KNOWN, last):
        play(backend, graph, k, k + 1)
        backend.update(0.0)
    take_all(backend)


def test_the_map_stays_near_the_optimum_and_a_bound_of_it_stays_true(tmp_path):
    graph = simulated(tmp_path, N, 2 * N).graph
    assert np.isnan(l1.Backend(EVERY).behind().bound)
    backend = settled(graph)
    proved = backend.behind()
    assert (proved.rows, proved.loops) == (0, 0) and not proved.failing
    assert 0 <= proved.age < PLENTY and 0 <= proved.bound_age < PLENTY
    with backend.calm:
        drive_on(backend, graph, KNOWN + 10)
        now, states, behind = backend.snapshot().graph, backend.loop_states(), backend.behind()
        assert (states.state == ACCEPTED).mean() > 0.98
        accepted = now.between.is_odometry.copy()
        accepted[states.rows[states.state[:len(states.rows)] == ACCEPTED]] = True
        used = now.subset(accepted)
        best = l1.solve(used, robust=False).cost
        assert np.abs(whitened(used, backend.poses)).sum() < 1.1 * best
        # With ten keyframes more the optimum has risen, by little.
        assert behind.bound == proved.bound and behind.bound_age > proved.bound_age
        assert 0.8 * best < behind.bound <= best
        assert behind.rows > 0 and behind.loops > 0
        # Of fewer factors nothing was proved.
        reference, stamp = states.stamps[np.argmax(states.state == ACCEPTED)].tolist()
        backend.add_loop(l1.LoopClosure(reference, stamp, np.eye(7)[6], np.eye(6), struck=True))
        take_all(backend)
        assert np.isnan(backend.behind().bound)


@pytest.mark.parametrize('kind', ['random', 'identity', 'grouped'])
def test_the_gate_lets_no_lie_in(tmp_path, kind):
    world = simulated(tmp_path, N, 2 * N, '--false-loops', 130, '--kind', kind)
    backend = settled(world.graph)
    known = loops_by(backend)
    with backend.calm:
        drive_on(backend, world.graph)
        new, accepted = loops_by(backend) - known, loops_by(backend, 'accepted')
    assert len(new & world.false) > 5 and not accepted & world.false
    # The others wait for the judgement.
    assert len(new & accepted) > 0.7 * len(new - world.false)
