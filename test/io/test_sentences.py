# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What people are told of the loops that were refused, and of the noise."""

import re
from dataclasses import replace

import numpy as np
import pytest
from problems import retold

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.batch import minimise_robustly
from l1slam_ros.core.robust.judgement import (
    OTHER_MAP,
    WEAK,
    Doubt,
    Judgement,
)
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.sentences import doubt_sentence, judgement_sentences

N, LOOPS = 30, 27  # keyframes k with the ids 10 + 3 k; loops (k, k + 2)


@pytest.fixture
def record():
    graph = FactorGraph(se2, N)
    first = np.concatenate((np.arange(N - 1), np.arange(LOOPS)))
    last = first + np.repeat([1, 2], [N - 1, LOOPS])
    m = len(first)
    graph.add_between(first, last, np.zeros((m, 3)), np.tile(np.eye(3), (m, 1, 1)))
    return GraphRecord(graph, None, 10 + 3 * np.arange(N))


def judgement(refused=(), suspect=(), slips=(), variance=(1.0, 1.0)):
    """Return a judgement; refused : sigmas of loops; suspect : loops; slips : steps."""
    m = N - 1 + LOOPS
    sigmas, doubtful = np.ones(m), np.zeros(m, bool)
    accepted = np.ones(m, bool)
    for loop, value in dict(refused).items():
        sigmas[N - 1 + loop], accepted[N - 1 + loop] = value, False
    for loop in suspect:
        doubtful[N - 1 + loop], accepted[N - 1 + loop] = True, False
    for step in slips:
        sigmas[step], accepted[step] = 40.0 + step, False
    return Judgement(accepted, doubtful, sigmas, np.array(variance),
                     np.ones(len(accepted)), np.array(slips, np.int64))


@pytest.mark.parametrize('count, more', [(19, None), (20, None), (21, 1), (27, 7)])
def test_of_many_the_worst_twenty_are_named(record, count, more):
    said = list(judgement_sentences(record, judgement({k: 10.0 + k for k in range(count)})))
    assert said[0] == f'{count} of 27 loops refused'
    named = [line for line in said if ' sigmas off the accepted ones' in line]
    assert len(named) == min(count, 20)
    assert named[0].startswith(f'  {10 + 3 * (count - 1)} - ')
    rest = said[1 + len(named):]
    assert rest == ([] if more is None else [f'  and {more} more; `--json` lists all'])


@pytest.mark.parametrize('suspect, sentence', [
    ([5], '1 loop suspect and left out: nothing confirms it'),
    ([5, 6], '2 loops suspect and left out: nothing confirms them')])
def test_suspects_are_counted_apart_and_what_is_struck_out_is_not(record, suspect, sentence):
    record.graph.say(N - 1 + np.array([8, 9]), trusted=False)
    refused = {3: 8.0, 8: np.nan, 9: np.nan}
    said = list(judgement_sentences(record, judgement(refused, suspect=suspect)))
    assert said == ['1 of 27 loops refused',
                    '  19 - 25: 8.0 sigmas off the accepted ones', sentence]


def test_odometry_that_lies_is_said_first_and_is_no_loop(record):
    said = list(judgement_sentences(record, judgement({0: 8.0}, slips=[2, 9])))
    assert said == ['the odometry slipped from 16 - 19: this step is 42.0 sigmas off what the '
                    'loops say, and is left out',
                    'the odometry slipped from 37 - 40: this step is 49.0 sigmas off what the '
                    'loops say, and is left out',
                    '1 of 27 loops refused', '  10 - 16: 8.0 sigmas off the accepted ones']


NOISY_ODOMETRY = ('the odometry is about {} times as noisy as stated: it says little about loops '
                  'between distant times')
NOISY_LOOPS = ('the loops are about {} times as noisy as stated: a false loop that is off by '
               'little cannot be told from noise')
ACCURATE_LOOPS = ('the loops are about {} times as accurate as stated: weighed as stated, they '
                  'move the map less than they could; expected covariances of what the front end '
                  'measures')


@pytest.mark.parametrize('variance, said', [
    ((3.99, 3.99), []), ((1e-4, 0.0), []), ((4.0, 3.0), [NOISY_ODOMETRY.format('2.0')]),
    ((9.61, 0.01), [NOISY_ODOMETRY.format('3.1'), ACCURATE_LOOPS.format('10')]),
    ((1.0, 1e4), [NOISY_LOOPS.format('100.0')]),
    ((6.25, 20.25), [NOISY_ODOMETRY.format('2.5'), NOISY_LOOPS.format('4.5')])])
def test_what_is_twice_as_noisy_as_it_says_or_more_is_told_last(record, variance, said):
    assert list(judgement_sentences(record, judgement(suspect=[5], variance=variance)))[2:] == said


def test_a_map_of_other_noise_than_is_stated_is_told(record):
    found = judgement(suspect=[5])
    said, more = (list(judgement_sentences(record, one))
                  for one in (found, replace(found, noise=2 * found.noise)))
    assert more == [*said, 'the errors of loops of one place are correlated: each place counts as '
                    'one loop, with the noise that was estimated']


@pytest.mark.parametrize('stamps, when', [
    (None, ''), (10**9 * np.arange(N), ' (2.000000000 s to 7.000000000 s)')])
def test_a_doubt_says_why_and_where(stamps, when):
    ids, where = 10 + 3 * np.arange(N), f'between 16 and 31{when}'
    said = doubt_sentence([Doubt(kind, 1234, 2, 7, '2.5') for kind in (WEAK, OTHER_MAP)],
                          ids, stamps)
    assert said == (
        'doubtful: the map may well be 2.5 m off: with the noise that was estimated, the loops '
        f'that are used allow that much; 1,234 are left out, {where}; 1,234 refused loops agree '
        f'with each other on another map, {where}. Vouch for a true loop, strike out a false one, '
        'or state the right noise')
    assert doubt_sentence((), ids, stamps) == ''


def test_what_a_solve_finds_of_the_noise_is_told():
    world = simulate_world(200, 400, WorldOptions(), np.random.default_rng(2))
    # The odometry boasts of a fifth of its sigmas, the loops tell the truth.
    graph = retold(world.graph, times=np.where(world.graph.between.is_odometry, 0.2, 1.0))
    found = minimise_robustly(graph, lambda part, poses: minimise_l2(
        part, poses, LeastSquaresOptions(), cholesky_of(part)))
    said = '\n'.join(judgement_sentences(GraphRecord(graph, None, np.arange(200)),
                                         found.judgement))
    times = re.search(re.escape(NOISY_ODOMETRY).replace(r'\{\}', r'(\d+\.\d)'), said)
    assert 3 < float(times[1]) < 6


def test_what_states_the_identity_is_told_with_the_noise_that_was_found(record):
    meant = np.array([[4.0, 4.0, 0.25], [1.0, 1.0, 1.0]])
    said = list(judgement_sentences(record, replace(judgement(), meant=meant)))
    # The odometry's variance of 1 is of the geometric mean of its three numbers.
    mean = (4.0 * 4.0 * 0.25) ** (1 / 3)
    metres, degrees = 2 / np.sqrt(mean), np.degrees(0.5 / np.sqrt(mean))
    assert said[0] == ('the information of the odometry is the identity: the map is weighed by '
                       f'the noise that was estimated, {metres:.2g} m and {degrees:.2g} degrees')
    assert not [sentence for sentence in said[1:] if 'identity' in sentence]


def test_noise_that_was_found_of_stated_loops_is_no_identity(record):
    """Where odometry alone states the identity, moves and turns of loops are found apart, too."""
    loops = ~record.graph.between.is_odometry
    stated = record.graph.subset(np.arange(len(loops)), np.where(loops, 0.5, 1.0))
    meant = np.tile([4.0, 4.0, 0.25], (2, 1))
    said = list(judgement_sentences(
        GraphRecord(stated, None, record.ids), replace(judgement(), meant=meant)))
    assert [sentence.split(' is ')[0] for sentence in said if 'identity' in sentence] == [
        'the information of the odometry']
