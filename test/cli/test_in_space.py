# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam` on worlds in space, and its norms: every command, in both readings of the rotation."""

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
