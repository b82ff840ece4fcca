# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam` on worlds in space, and its norms: every command, in both readings of the rotation."""

import numpy as np
import pytest
from command import run, solve_json

NORMS = 'l1', 'group-l1', 'l2', 'huber'


@pytest.fixture
def building(capsys, tmp_path):
    path = tmp_path / 'building.g2o'
    run(capsys, 'simulate', path, '--world', 'building', '--poses', 150, '--edges', 330)
    return path


def test_a_building_is_made_spoiled_recorded_and_mapped(capsys, building, tmp_path):
    truth = ('--reference', f'{building}.truth.txt')
    clean = solve_json(capsys, building, *truth)
    assert clean['rejected'] == [] and clean['ate'] < 0.5 and clean['ate_poses'] == 150
    run(capsys, 'corrupt', building, tmp_path / 'bad.g2o', '--false-loops', 20)
    run(capsys, 'convert', tmp_path / 'bad.g2o', tmp_path / 'bag')
    spoiled = solve_json(capsys, tmp_path / 'bag', *truth, '--output', tmp_path / 'map.tum')
    assert len(spoiled['rejected']) == 20
    assert spoiled['ate'] == pytest.approx(clean['ate'], rel=0.02)
    run(capsys, 'plot', building, '--output', tmp_path / 'maps.png')
    said = run(capsys, 'info', building, '--rotation-information', 'angle')[0]
    assert 'expected --rotation-information quaternion' in said
    assert 'in SE3' in run(capsys, 'info', building)[0]


def test_each_norm_is_named_and_lowest_at_its_own_map(capsys, building, tmp_path):
    costs = {}
    for norm in NORMS:
        out = tmp_path / f'{norm}.g2o'
        report = solve_json(capsys, building, '--no-robust', '--norm', norm, '--output', out)
        assert report['status'] == 'converged'
        costs[norm] = report['final_cost']
    for norm in NORMS:
        for other in NORMS:
            there = solve_json(capsys, tmp_path / f'{other}.g2o', '--no-robust', '--norm', norm,
                           '--start', 'file', '--outer', 0)['final_cost']
            assert there >= costs[norm] * (1 - 1e-4)


def test_the_reading_of_the_rotation_is_kept_and_weighs(capsys, building, tmp_path):
    reading = ('--rotation-information', 'angle')
    run(capsys, 'convert', building, tmp_path / 'same.g2o', *reading)
    edges = [[line for line in path.read_text().splitlines() if line.startswith('EDGE')]
             for path in (building, tmp_path / 'same.g2o')]
    np.testing.assert_allclose(*([[float(v) for v in line.split()[1:]] for line in lines]
                                 for lines in edges), rtol=1e-12)
    costs = [solve_json(capsys, building, '--no-robust', '--norm', 'l2', *more)['final_cost']
             for more in ((), reading)]
    # The file is g2o's; read as of the angle its rotations weigh four times as much.
    assert costs[1] > 1.5 * costs[0]


@pytest.mark.parametrize('reading', ['quaternion', 'angle'])
def test_information_that_is_not_definite_costs_one_line_and_no_map(capsys, building, reading):
    """A third of the edges say of one direction that they know less than nothing of it."""
    truth = ('--reference', f'{building}.truth.txt', '--rotation-information', reading)
    clean = solve_json(capsys, building, *truth)
    lines = building.read_text().splitlines()
    upper = np.triu_indices(6)
    count = 0
    for k, line in enumerate(lines):
        words = line.split()
        if words[0] == 'EDGE_SE3:QUAT' and k % 3 == 0:
            information = np.zeros((6, 6))
            information[upper] = np.array(words[10:], float)
            information = information + np.triu(information, 1).T
            values, vectors = np.linalg.eigh(information)
            values[count % 3] *= -1e-3
            information = vectors @ np.diag(values) @ vectors.T
            lines[k] = ' '.join([*words[:10], *map(repr, information[upper].tolist())])
            count += 1
    building.write_text('\n'.join(lines) + '\n')
    report = solve_json(capsys, building, *truth, code=4)  # of so much noise it is not sure
    warning, _ = report['warnings']
    assert count > 100 and warning.startswith(f'{count} of 330 information matrices not positive ')
    assert [doubt['kind'] for doubt in report['doubts']] == ['a weak map']
    assert report['rejected'] == []
    assert report['ate'] < 2 * clean['ate'] + 0.1
    assert f'- {warning}\n' in run(capsys, 'info', building, *truth[2:])[0]
