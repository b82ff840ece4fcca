# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The back end of one robot: as good as a batch solve, in time, and consistent on the way."""

from dataclasses import replace

import numpy as np
import pytest
from backends import (
    CREDULOUS,
    EVERY,
    EVERY_MESSAGE,
    PLENTY,
    drive,
    odometry_of,
    play,
    played,
    settled,
    simulated,
    states,
)
from heard import PERIOD, begun, loop, odometry, seconds
from numpy.testing import assert_allclose, assert_array_equal
from worlds import between, compose, whitened

import l1slam_ros as l1


@pytest.fixture(scope='module')
def graph(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp('world'), 150, 320, '--seed', 1).graph


@pytest.fixture(scope='module')
def best(graph):
    """The least cost there is."""
    return l1.solve(graph, robust=False).cost


def cost(graph, poses):
    return np.abs(whitened(graph, poses)).sum()


@pytest.mark.parametrize('options', [EVERY, CREDULOUS], ids=['robust', 'credulous'])
def test_settled_the_map_is_the_optimum_and_all_loops_are_judged(graph, best, options):
    with l1.Backend(options) as backend:
        assert backend.settle() is None
        play(backend, graph)
        found = backend.settle()
        assert found.cost == pytest.approx(best, rel=2e-4)
        assert found.cost == pytest.approx(cost(graph, backend.poses), rel=1e-9)
        assert_array_equal(backend.poses, found.poses)
        assert set(states(backend).values()) == {'accepted'}
        assert np.isfinite(backend.loop_states().sigmas).all() == (options is EVERY)
        assert backend.update() is None


def test_a_settle_minimises_the_norms_that_were_asked_for(graph):
    norms = {'norm': 'l2', 'loop_norm': 'l1'}
    backend = begun({**EVERY_MESSAGE, 'solver': norms})
    play(backend, graph)
    best = l1.solve(graph, robust=False, **norms)
    assert backend.settle().cost == pytest.approx(best.cost, rel=1e-6)
    assert_allclose(backend.poses, best.poses, atol=1e-3)


@pytest.mark.parametrize('dimension', [4, 0])
def test_a_dimension_that_is_not_there_is_refused(dimension):
    with pytest.raises(l1.L1SlamError, match=f'dimension is {dimension}, expected 2 or 3'):
        l1.Backend(EVERY, dimension)


def test_none_and_one_and_some_keyframes_are_no_trouble():
    backend = l1.Backend(EVERY)
    assert backend.update(PLENTY) is None and backend.saved() is None
    assert backend.robot() is None and len(backend.poses) == 0
    backend.add_odometry(odometry(1.0, (3.0, 4.0, 0.5)))
    improvement = backend.update(PLENTY)
    assert (improvement.status.value, improvement.cost) == ('converged', 0.0)
    assert_allclose(backend.poses, [[3.0, 4.0, 0.5]])
    assert_allclose(backend.robot().map_to_odom, [[0.0, 0.0, 0.0]], atol=1e-15)
    settled(backend)
    backend.reset()
    assert len(backend.poses) == 0 and backend.robot() is None
    assert settled(backend) == 0
    drive(backend, 7, 12)
    settled(backend)
    assert_allclose(backend.poses[:, 0], np.arange(7.0, 12.0))


def test_keyframes_after_an_update_follow_the_map(graph):
    """By the transform that puts the last optimised one in its place."""
    backend = played(graph, 0, 130)
    settled(backend)
    before, transform = backend.poses, backend.robot().map_to_odom
    assert np.abs(transform).max() > 0.05
    play(backend, graph, 130, 150)
    assert_array_equal(backend.poses[:130], before)
    robot = backend.robot()
    assert_array_equal(robot.map_to_odom, transform)
    assert robot.stamp == seconds(149 * PERIOD)
    chain = odometry_of(graph)
    assert_allclose(robot.odometry, chain[149:], atol=1e-9)
    assert_allclose(between(backend.poses[129:], compose(transform, chain[129:])), 0, atol=1e-9)
    # What moved since it was asked last.
    backend.moved()
    settled(backend)
    moved = backend.moved()
    assert_array_equal(moved[0], transform)
    assert_array_equal(moved[1], backend.robot().map_to_odom)
    assert np.abs(moved[1] - moved[0]).max() > 1e-4
    assert_array_equal(*backend.moved())


def test_a_large_map_comes_to_rest_though_no_update_ends_by_its_tests(graph, best):
    """As where the budget is over after one linearisation, update after update."""
    backend = begun({**EVERY_MESSAGE, 'solver.outer_iterations': 1})
    play(backend, graph)
    assert not backend.behind().at_rest
    settled(backend)
    assert backend.behind().at_rest
    assert cost(graph, backend.poses) == pytest.approx(best, rel=1e-3)
    backend.add_odometry(odometry(15.0, backend.robot().odometry[0]))
    assert not backend.behind().at_rest


def test_options_may_change_on_the_way():
    """A loop may wait for odometry that makes no keyframe."""
    backend = l1.Backend(EVERY)
    drive(backend, 0, 30)
    assert settled(backend) > 0 and settled(backend) == 0
    backend.set_options(l1.BackendOptions.from_mapping(
        {'keyframe': {'translation': 1e6, 'rotation': 0.0, 'period': 0.0}}))
    backend.add_loop(loop(1.0, 33.0, (32.0, 0.0, 0.0), 1e-4 * np.eye(6)))
    assert settled(backend) == 0
    drive(backend, 30, 34)
    assert settled(backend) > 0 and states(backend)[1.0, 33.0] != 'waiting'
    assert 30 <= len(backend.poses) <= 31


def test_each_loop_has_a_state_and_its_own_stamps(graph):
    backend = begun({**EVERY_MESSAGE, 'loop': {'wait': 3.0}})
    backend.add_loop(loop(0.0, 1e6, (1.0, 0.0, 0.0)))
    play(backend, graph, 0, 60)
    backend.add_loop(loop(2.0, 50.0, (1.0, 0.0, 0.0)))
    backend.update(PLENTY)
    found = backend.loop_states()
    rows, factors = found.rows, backend.snapshot().graph.between
    assert_array_equal(rows, np.flatnonzero(~factors.is_odometry))
    assert_array_equal(found.stamps[:len(rows)], factors.pairs[rows] * seconds(PERIOD))
    assert_array_equal(found.robots, 0)
    assert np.isfinite(found.sigmas[:len(rows)]).all()
    assert np.isnan(found.sigmas[len(rows):]).all()
    assert states(backend)[0.0, 1e6] == 'expired' and states(backend)[2.0, 50.0] == 'waiting'
    sizes = backend.counts().sizes
    assert sizes['keyframes'] == 60 and sizes['factors'] == len(factors) == 59 + len(rows)
    assert (sizes['waiting_loops'], sizes['expired_loops']) == (1, 1)


@pytest.mark.parametrize('change, words', [
    ({'pose3': np.zeros(3)}, r'pose3 of shape \(3,\); expected an array \(7,\)'),
    ({'pose3': [0.0, 0, 0, 0, 0, 0, 1]}, 'pose3 of shape None'),
    ({'covariance': np.eye(3)}, r'covariance of shape \(3, 3\)'),
    ({'pose3': np.array([np.nan, 0, 0, 0, 0, 0, 1])}, 'expected finite numbers'),
    ({'pose3': np.array([1e200, 0, 0, 0, 0, 0, 1])}, 'expected it within 1e'),
    ({'pose3': np.zeros(7)}, 'of norm 0; expected 1'),
    ({'stamp': 2**70}, 'expected whole nanoseconds to 2.62'),
    ({'stamp': 2.5}, r'stamp \(.*2.5.*\); expected whole nanoseconds'),
])
def test_what_is_no_measurement_is_refused_and_leaves_no_trace(change, words):
    here = np.array([0.0, 0, 0, 0, 0, 0, 1])
    sample = l1.OdometrySample(10**9, here, np.eye(6), np.eye(6))
    with l1.Backend(dimension=3) as backend:
        backend.add_odometry(sample)
        with pytest.raises(l1.L1SlamError, match=words):
            backend.add_odometry(replace(sample, **{'stamp': 2 * 10**9, **change}))
        with pytest.raises(l1.L1SlamError, match=words):
            backend.add_loop(replace(l1.LoopClosure(10**9, 2 * 10**9, here, np.eye(6)), **change))
        assert states(backend) == {} and len(backend.poses) == 1
