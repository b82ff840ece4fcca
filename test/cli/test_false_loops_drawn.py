# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""False loops of `simulate` and `corrupt`: far, new, each kind as it is meant, at their time."""

import numpy as np
import pytest
from command import run
from worlds import between, compose, edge, edges_of, false_of, graph_file, made, pairs_of, truth_of

KINDS = ['random', 'identity', 'grouped']


def spoiled(folder, poses, edges, count, kind):
    """Return the path of a world, and pairs -> measurements of its false loops."""
    path = made(folder / 'a.g2o', poses, edges, '--false-loops', count, '--kind', kind)
    false = set(map(tuple, false_of(path)))
    return path, {(i, j): Z for i, j, Z, _ in edges_of(path) if (i, j) in false}


def chain(folder, n, *loops):
    """Write a drive straight on and loops, as `edge` has them; return the path."""
    information = np.diag([4.0, 4.0, 9.0])
    return graph_file(folder, [edge(k, k + 1, (1, 0, 0), information) for k in range(n - 1)]
                      + [edge(*loop) for loop in loops])


def corrupted(capsys, path, count, kind='random'):
    """Corrupt a graph; return the path."""
    output = path.with_name('bad.g2o')
    run(capsys, 'corrupt', path, output, '--false-loops', count, '--kind', kind)
    return output


@pytest.mark.parametrize('kind', KINDS)
def test_they_are_far_new_and_in_order_of_time(kind, tmp_path):
    path, loops = spoiled(tmp_path, 1000, 2500, 300, kind)
    pairs, all_pairs, positions = np.array(list(loops)), pairs_of(path), truth_of(path)[:, :2]
    assert len(loops) == 300 and (pairs[:, 1] - pairs[:, 0] >= 100).all()
    distance = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    assert distance.min() >= np.linalg.norm(np.ptp(positions, axis=0)) / 10
    assert len(set(map(tuple, all_pairs))) == len(all_pairs) == 2800
    assert [j for _, j in all_pairs] == sorted(j for _, j in all_pairs)
    assert false_of(path) == sorted(false_of(path), key=lambda pair: pair[::-1])


def test_random_ones_claim_to_be_near(tmp_path):
    _, loops = spoiled(tmp_path, 1000, 2500, 2000, 'random')
    offset = np.array(list(loops.values()))
    np.testing.assert_allclose(offset.mean(axis=0), 0, atol=0.04)
    np.testing.assert_allclose(offset.std(axis=0), [0.3, 0.3, np.radians(10)], rtol=0.1)


@pytest.mark.parametrize('count', [1, 9, 10, 200])
def test_grouped_ones_agree_through_the_odometry(count, tmp_path):
    path, found = spoiled(tmp_path, 1000, 2500, count, 'grouped')
    odometry = {i: Z for i, j, Z, _ in edges_of(path) if j == i + 1}
    sizes = []
    for i, j in found:
        if (i - 1, j - 1) not in found:
            assert np.linalg.norm(found[i, j][:2]) < 2
            sizes.append(0)
            while (i, j) in found:
                sizes[-1] += 1
                if (i + 1, j + 1) in found:
                    # i -> i + 1 -> j + 1 and i -> j -> j + 1 are the same way.
                    one = compose(odometry[i], found[i + 1, j + 1])
                    other = compose(found[i, j], odometry[j])
                    np.testing.assert_allclose(between(one, other), 0, atol=1e-8)
                i, j = i + 1, j + 1
    assert sum(sizes) == count
    # Two runs may touch by chance; the last one may be short.
    assert sum(10 <= size <= 20 for size in sizes) >= len(sizes) - 2


def test_they_are_as_sure_as_the_loops_in_the_median_or_else_as_odometry(capsys, tmp_path):
    correlated = np.array([[3.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 2.0]])
    true = [(0, k, (k, 0, 0), times * correlated) for k, times in ((5, 100), (6, 1), (7, 0.01))]
    for loops, expected in ((), np.diag([4.0, 4.0, 9.0])), (true, correlated):
        path = corrupted(capsys, chain(tmp_path, 100, *loops), 3)
        false = false_of(path)
        for i, j, _, information in edges_of(path):
            if [i, j] in false:
                np.testing.assert_allclose(information, expected, rtol=1e-9)


def test_what_was_there_keeps_its_order_and_each_comes_when_it_was_met(capsys, tmp_path):
    """Also behind loops in no order of time, parallel ones and those that go backwards."""
    loops = [(5, 20, (15, 0, 0), np.eye(3)), (5, 20, (15, 0, 0), 2 * np.eye(3)),
             (30, 2, (-28, 0, 0), np.eye(3))]
    path = chain(tmp_path, 60, *loops)
    lines = path.read_text().splitlines()
    path.write_text('\n'.join([*lines[:25], *lines[59:], *lines[25:59]]) + '\n')
    before, bad = pairs_of(path), corrupted(capsys, path, 40)
    after, false = pairs_of(bad), false_of(bad)
    assert [pair for pair in after if pair not in false] == before
    for k, (_, j) in enumerate(after):
        if after[k] in false:
            assert max((max(pair) for pair in after[:k]), default=0) <= j
            rest = [pair for pair in after[k:] if pair not in false]
            assert not rest or max(rest[0]) > j


@pytest.mark.parametrize('kind', KINDS)
def test_too_many_are_refused_before_memory_is_taken(capsys, kind, tmp_path):
    path = chain(tmp_path, 12)
    for count, said in (67, '67 false loops asked for, found 66 pairs among 12 keyframes'), (
            60, '60 false loops asked for, found room for '), (
            10**15, 'found 66 pairs among 12 keyframes'):
        _, err = run(capsys, 'corrupt', path, tmp_path / 'bad.g2o', '--false-loops', count,
                     '--kind', kind, code=2)
        assert said in err and [one.name for one in tmp_path.iterdir()] == ['graph.g2o']
