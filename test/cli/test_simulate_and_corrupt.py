# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam simulate` and `corrupt`: worlds, and loops that are false."""

import numpy as np
import pytest
from command import run, solve_json, texts_of
from worlds import compose, false_of, lines_of, pairs_of, truth_of

import l1slam_ros as l1


def corrupted(capsys, path, output, *options):
    """Corrupt; return the graph, its poses, which of its factors are false, and their pairs."""
    run(capsys, 'corrupt', path, output, *options)
    pairs, (graph, poses) = false_of(output), l1.read_graph(output)
    false = np.array([pair in pairs for pair in pairs_of(output)])
    assert false.sum() == len(pairs)
    return graph, poses, false, pairs


@pytest.mark.parametrize('kind', ['random', 'identity', 'grouped'])
def test_corrupt_adds_loops_and_keeps_the_rest(capsys, odd, tmp_path, kind):
    output, (before, stored) = tmp_path / 'bad.g2o', l1.read_graph(odd)
    after, poses, false, pairs = corrupted(capsys, odd, output, '--false-loops', 40, '--kind',
                                           kind, '--seed', 3)
    assert len(pairs) == 40 and {k % 3 for pair in pairs for k in pair} == {1}
    np.testing.assert_array_equal(poses, stored)
    assert [row[0] for row in lines_of(output, 'VERTEX')] == [
        row[0] for row in lines_of(odd, 'VERTEX')]
    np.testing.assert_array_equal(np.loadtxt(f'{output}.stamps.txt'),
                                  np.loadtxt(f'{odd}.stamps.txt'))
    np.testing.assert_array_equal(after.between.measurement[~false], before.between.measurement)
    claimed = np.linalg.norm(after.between.measurement[false][:, :2], axis=1)
    assert claimed.max() < {'random': 2, 'identity': 1e-9, 'grouped': 40}[kind]
    assert solve_json(capsys, output)['loops'] == 141


def test_another_seed_draws_other_loops_and_the_same_one_the_same(capsys, world, tmp_path):
    drawn = [corrupted(capsys, world, tmp_path / f'{k}.g2o', '--false-loops', 10, '--seed',
                       seed)[-1] for k, seed in enumerate((1, 1, 2))]
    assert drawn[0] == drawn[1] != drawn[2]
    # Corrupting twice names the false loops of both.
    both = corrupted(capsys, tmp_path / '0.g2o', tmp_path / 'b.g2o', '--false-loops', 20, '--kind',
                     'grouped')[-1]
    assert len(both) == 30 and both[:10] == drawn[0]


def test_false_loops_are_told_by_the_solved_map_not_by_a_drifted_start(capsys, world, tmp_path):
    """The stored start is wound up like a spring: by it, the same place is far from itself."""
    path = tmp_path / 'drift.g2o'
    factors = l1.read_graph(world)[0].between
    steps = factors.measurement[factors.is_odometry]
    poses = [np.zeros(3)]
    for step in steps + [0, 0, 0.2]:
        poses.append(compose(poses[-1], step))
    lines = [f'VERTEX_SE2 {k} {x} {y} {theta}' for k, (x, y, theta) in enumerate(poses)]
    edges = [line for line in world.read_text().splitlines() if line.startswith('EDGE')]
    path.write_text('\n'.join(lines + edges))
    *_, pairs = corrupted(capsys, path, tmp_path / 'bad.g2o', '--false-loops', 200)
    truth = truth_of(world)[:, :2]
    distance = np.linalg.norm(np.diff(truth[np.array(pairs)], axis=1)[:, 0], axis=1)
    assert distance.min() > 0.1 * np.linalg.norm(np.ptp(truth, axis=0)) - 0.3


def test_corrupting_to_a_bag_counts_as_the_bag_does(capsys, odd, tmp_path):
    run(capsys, 'corrupt', odd, tmp_path / 'bad', '--false-loops', 7)
    pairs = np.loadtxt(tmp_path / 'bad.false.txt', dtype=int)
    assert pairs.shape == (7, 2) and pairs.max() < 150
    run(capsys, 'plot', tmp_path / 'bad', '--output', tmp_path / 'map.svg')
    assert '150 poses, 108 loops (7 false)' in texts_of(tmp_path / 'map.svg')
