# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A judgement that fails: the map is of what was believed by then, doubtful, and says why."""

import numpy as np
import pytest
from lies import careful_world, is_false, position_error, spoilt
from numpy.testing import assert_array_equal
from problems import EVERY, play

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.robust import batch
from l1slam_ros.core.robust.batch import doubts_of_norm, judge, minimise_robustly, robust_solve
from l1slam_ros.core.robust.batch_map import SolveOptions, solve
from l1slam_ros.core.robust.judgement import FAILED, UNSOLVED
from l1slam_ros.core.robust.rounds import growth
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.optimality import Status, l1_cost, l2_cost

WHY = 'the normal matrix is singular'


@pytest.fixture(scope='module')
def bad():
    """160 keyframes, 161 true loops and 70 false ones."""
    return spoilt(careful_world(160, 320), 'random', 70)


@pytest.fixture
def failing(monkeypatch):
    """Return what lets the judgement fail when it samples a map for the n-th time."""
    def fail_at(number, error=GraphError):
        asked, sample = [], growth.sample_posterior

        def sampled(*arguments):
            asked.append(1)
            if len(asked) >= number:
                raise error(WHY)
            return sample(*arguments)

        monkeypatch.setattr(growth, 'sample_posterior', sampled)

    return fail_at


def in_l2(graph, poses):
    return minimise_l2(graph, poses, LeastSquaresOptions(), cholesky_of(graph))


@pytest.mark.parametrize('error', [GraphError, np.linalg.LinAlgError])
@pytest.mark.parametrize('number', [1, 2, 3, 5])
def test_no_loop_is_believed_that_nobody_judged(bad, failing, number, error):
    lies, factors = is_false(bad, bad.graph.between), bad.graph.between
    failing(number, error)
    found = minimise_robustly(bad.graph, in_l2)
    judgement = found.judgement
    assert not (judgement.accepted & lies).any() and judgement.accepted[factors.is_odometry].all()
    assert_array_equal(judgement.suspect, ~judgement.accepted)
    doubt = judgement.doubts[0]
    assert (doubt.kind, doubt.detail) == (FAILED, WHY)
    assert doubt.loops == np.count_nonzero(~judgement.accepted) >= lies.sum()
    part = bad.graph.subset(judgement.accepted)
    assert found.solution.cost == pytest.approx(in_l2(part, bad.odometry).cost, rel=1e-3)


def test_what_was_believed_before_it_failed_is_in_the_map(bad, failing):
    failing(5)
    judgement, poses = robust_solve(bad.graph)
    loops = judgement.accepted & ~bad.graph.between.is_odometry
    assert loops.sum() > 20
    assert position_error(poses, bad.truth) < position_error(bad.odometry, bad.truth)


def test_what_is_known_while_the_map_grows_stays(bad, failing):
    known, poses = robust_solve(bad.graph)
    failing(1)
    for found, kept in (judge(bad.graph, poses, known),
                        robust_solve(bad.graph, known=(known, poses))):
        assert_array_equal(found.accepted, known.accepted)
        assert_array_equal(found.suspect, known.suspect)
        assert kept is poses and found.settled and found.doubt.kind == FAILED


def test_where_the_map_cannot_be_solved_for_it_is_the_one_they_were_judged_by(bad):
    expected, poses = robust_solve(bad.graph)

    def failing(graph, poses):
        raise GraphError(WHY)

    found = minimise_robustly(bad.graph, failing)
    assert_array_equal(found.judgement.accepted, expected.accepted)
    assert_array_equal(found.solution.poses, poses)
    doubt, = found.judgement.doubts
    assert (doubt.kind, doubt.detail) == (UNSOLVED, WHY)
    believed = whitened_residual(bad.graph.subset(expected.accepted), poses)
    assert found.solution.cost == pytest.approx(l1_cost(believed))
    assert len(found.solution.dual) == len(believed)


def test_nor_is_the_norm_asked_of_a_map_that_cannot_be_factored(bad, monkeypatch):
    judgement, poses = robust_solve(bad.graph)

    def failing(*_):
        raise GraphError(WHY)

    monkeypatch.setattr(batch, 'l2_map', failing)
    doubt, = doubts_of_norm(bad.graph, judgement, poses, lambda: None)
    assert (doubt.kind, doubt.detail) == (UNSOLVED, WHY)


def test_the_account_is_of_the_map_there_is(bad, monkeypatch):
    def failing(*_):
        raise GraphError(WHY)

    monkeypatch.setattr(batch, 'l2_map', failing)
    outcome = solve(bad.graph, None, SolveOptions(norm='l2'))
    believed = whitened_residual(bad.graph.subset(outcome.judgement.accepted),
                                 outcome.solution.poses)
    assert outcome.solution.cost == pytest.approx(l2_cost(believed))
    assert outcome.solution.status is Status.STALLED and not outcome.unjudged
    assert (outcome.solver, outcome.reason) == (
        'gauss-newton', 'the loops were judged by its map')


def test_a_running_back_end_goes_on_with_what_it_believed(bad, failing):
    backend = Backend(EVERY)
    play(backend, bad)
    known = backend.settle().judgement
    failing(1)
    judgement = backend.settle().judgement
    assert_array_equal(judgement.accepted, known.accepted)
    assert np.count_nonzero(judgement.accepted) > 200
    assert judgement.doubt.kind == FAILED and judgement.settled
    while backend.update(1.0):
        assert backend.snapshot().judgement.doubt.kind == FAILED
