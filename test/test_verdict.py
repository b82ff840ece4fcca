# SPDX-License-Identifier: Apache-2.0
"""What people are told of the loops that were refused."""

import numpy as np
import pytest

from l1slam_ros.core import se2
from l1slam_ros.core.graph import FactorGraph
from l1slam_ros.core.optimality import Status
from l1slam_ros.core.optimiser import Solution
from l1slam_ros.core.robust_map import RobustMap
from l1slam_ros.io.graph_file import GraphRecord
from l1slam_ros.verdict import verdict

N, LOOPS = 30, 27  # keyframes k with the ids 10 + 3 k; loops (k, k + 2)


@pytest.fixture
def record():
    graph = FactorGraph(se2)
    graph.add_poses(N)
    first = np.concatenate((np.arange(N - 1), np.arange(LOOPS)))
    last = first + np.repeat([1, 2], [N - 1, LOOPS])
    m = len(first)
    graph.add_between(first, last, np.zeros((m, 3)), np.tile(np.eye(3), (m, 1, 1)))
    return GraphRecord(graph, None, 10 + 3 * np.arange(N))


def judgement(refused=(), suspect=(), slips=()):
    """Return a judgement; refused : sigmas of loops; suspect : loops; slips : steps."""
    poses, m = np.zeros((N, 3)), N - 1 + LOOPS
    sigmas, doubtful = np.ones(m), np.zeros(m, bool)
    accepted = np.ones(m, bool)
    for loop, value in dict(refused).items():
        sigmas[N - 1 + loop], accepted[N - 1 + loop] = value, False
    for loop in suspect:
        doubtful[N - 1 + loop], accepted[N - 1 + loop] = True, False
    for step in slips:
        sigmas[step], accepted[step] = 40.0 + step, False
    solution = Solution(poses, 0.0, Status.CONVERGED, 0, 0, np.zeros(1), np.zeros(3 * m))
    return RobustMap(solution, poses, accepted, doubtful, sigmas, np.array(slips, np.int64),
                     np.ones(2))


def test_nothing_refused_is_one_sentence(record):
    assert list(verdict(record, judgement())) == ['0 of 27 loops refused']


def test_refused_loops_are_named_by_their_vertices_the_worst_first(record):
    assert list(verdict(record, judgement({1: 5.04, 20: 123.45, 7: 9.0}))) == [
        '3 of 27 loops refused',
        '  70 - 76: 123.5 sigmas off the accepted ones',
        '  31 - 37: 9.0 sigmas off the accepted ones',
        '  13 - 19: 5.0 sigmas off the accepted ones']


@pytest.mark.parametrize('count, more', [(19, None), (20, None), (21, 1), (27, 7)])
def test_of_many_the_worst_twenty_are_named(record, count, more):
    said = list(verdict(record, judgement({k: 10.0 + k for k in range(count)})))
    assert said[0] == f'{count} of 27 loops refused'
    named = [line for line in said if ' sigmas off the accepted ones' in line]
    assert len(named) == min(count, 20)
    assert named[0].startswith(f'  {10 + 3 * (count - 1)} - ')
    rest = said[1 + len(named):]
    assert rest == ([] if more is None else [f'  and {more} more; `--json` lists all'])


def test_suspects_are_counted_apart(record):
    said = list(verdict(record, judgement({3: 8.0}, suspect=[5, 6])))
    assert said[:2] == ['1 of 27 loops refused', '  19 - 25: 8.0 sigmas off the accepted ones']
    assert said[2:] == ['suspect and left out, because nothing vouches for them: 2 that fit where '
                        'they stand, but could as well do so by chance']


def test_odometry_that_lies_is_said_first_and_is_no_loop(record):
    said = list(verdict(record, judgement({0: 8.0}, slips=[2, 9])))
    assert said == [
        'odometry 16 - 19 lies: 42.0 sigmas off what the loops say; left out',
        'odometry 37 - 40 lies: 49.0 sigmas off what the loops say; left out',
        '1 of 27 loops refused', '  10 - 16: 8.0 sigmas off the accepted ones']
