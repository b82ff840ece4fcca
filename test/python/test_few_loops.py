# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Laps that one to five true loops close: the map is right, or it is said that it may not be."""

import numpy as np
import pytest
from command import run, solve_json
from scipy.spatial.transform import Rotation
from worlds import position_error

import l1slam_ros as l1

RUNS = 5


def lap(path, rng, space=False, identity=False, loops=None):
    """
    Write a lap as g2o, with odometry noise of .5 to 5% and true loops at its end.

    Returns the true positions (n, 3) [m]. The information is that of the noise, or the identity.
    """
    n, k = int(rng.integers(50, 501)), loops or int(rng.integers(1, 6))
    steps, step = n - k, rng.choice([0.2, 0.5, 1.0, 2.0])
    angle = 2 * np.pi * np.arange(n) / steps
    radius = steps * step / (2 * np.pi)
    at = np.column_stack((rng.uniform(0.7, 1.3) * radius * np.cos(angle), radius * np.sin(angle),
                          space * 0.05 * radius * np.sin(angle)))
    along = np.gradient(at, axis=0)
    turned = Rotation.from_rotvec(
        np.column_stack((space * 0.05 * np.sin(angle), 0 * angle,
                         np.unwrap(np.arctan2(along[:, 1], along[:, 0])))))
    odometry = step * rng.uniform(0.005, 0.05), np.radians(rng.uniform(0.1, 1.0))
    closing = rng.uniform(0.02, 0.2), np.radians(rng.uniform(0.2, 2.0))
    lines = []
    for i, j, (metres, radians) in [*((i, i + 1, odometry) for i in range(n - 1)),
                                    *((i, i + steps, closing) for i in range(k))]:
        move = turned[i].inv().apply(at[j] - at[i]) + rng.normal(0, metres, 3)
        turn = turned[i].inv() * turned[j] * Rotation.from_rotvec(rng.normal(0, radians, 3))
        if space:
            # The rotation part is of the quaternion's vector, half of the angle.
            root = np.ones(6) if identity else np.repeat((1 / metres, 2 / radians), 3)
            numbers = *move, *turn.as_quat(), *np.diag(root**2)[np.triu_indices(6)]
        else:
            root = np.ones(3) if identity else np.array((1 / metres, 1 / metres, 1 / radians))
            numbers = *move[:2], turn.as_rotvec()[2], *np.diag(root**2)[np.triu_indices(3)]
        lines.append(f'{"EDGE_SE3:QUAT" if space else "EDGE_SE2"} {i} {j} '
                     + ' '.join(map(repr, map(float, numbers))))
    path.write_text('\n'.join(lines) + '\n')
    return at


@pytest.mark.parametrize('space', [False, True], ids=['plane', 'space'])
@pytest.mark.parametrize('identity', [False, True], ids=['honest', 'identity'])
@pytest.mark.parametrize('seed', range(RUNS))
def test_a_lap_of_few_true_loops_has_them_in_and_is_right_or_doubtful(
        tmp_path, seed, identity, space):
    truth = lap(tmp_path / 'lap.g2o', np.random.default_rng((seed, identity, space)), space,
                identity)
    graph, _ = l1.read_graph(tmp_path / 'lap.g2o')
    solution = l1.solve(graph)
    assert solution.inliers.all()
    k = 2 + space
    best = position_error(l1.solve(graph, robust=False).poses[:, :k], truth[:, :k])
    error = position_error(solution.poses[:, :k], truth[:, :k])
    assert solution.status == 'doubtful' or error < 1.5 * best + 0.1


SQUARE = ('1.0 0.0 1.57079632679', '1 0 0 1 0 1')


def test_a_square_of_four_poses_is_closed(tmp_path, capsys):
    """The first example of a tutorial: four steps of 1 m, the last one back to the first pose."""
    path = tmp_path / 'square.g2o'
    path.write_text(''.join(f'EDGE_SE2 {i} {(i + 1) % 4} {" ".join(SQUARE)}\n' for i in range(4)))
    found = solve_json(capsys, path, code=4)
    assert not found['rejected'] and not found['suspect'] and found['final_cost'] < 1e-9
    text = run(capsys, 'solve', path, code=4)[1]
    assert 'doubtful: all else hardly confirms 1 loop in use' in text


@pytest.mark.parametrize('name', ['mrpt_graphslam_SE2_in.graph', 'mrpt_graphslam_SE2_in2.graph',
                                  'gtsam_Klaus3.g2o'])
def test_first_examples_of_others_have_all_their_loops_in(capsys, shared, name):
    graph, _ = l1.read_graph(shared / 'reports' / name)
    assert l1.solve(graph).inliers.all()


@pytest.mark.parametrize('name, best', [('one_lap_400', 0.75), ('one_lap_100_identity', 0.4)])
def test_reported_laps_are_right(capsys, shared, name, best):
    path = shared / 'reports' / f'{name}.g2o'
    found = solve_json(capsys, path, '--reference', path.with_suffix('.truth.txt'), code=4)
    assert not found['suspect'] and found['ate'] < best


def test_a_map_of_low_confidence_is_never_converged(tmp_path, shared):
    """A place that looks alike 37 times over, which odometry 90 times as noisy would explain."""
    import lzma
    path = tmp_path / 'outdoor.g2o'
    path.write_bytes(lzma.decompress((shared / 'worlds' / 'outdoor_3.g2o.xz').read_bytes()))
    assert l1.solve(l1.read_graph(path)[0]).status == 'doubtful'
