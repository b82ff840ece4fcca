# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The command on public graphs in space: known costs, and lies on a sphere."""

import pytest
from command import run, solve_json
from worlds import false_of

QUATERNION, ANGLE = 'quaternion', 'angle'
SPHERE = 'sphere2500'
GARAGE = 'parking-garage'
GRID = 'real/smallGrid3D'


@pytest.mark.parametrize(('name', 'reading', 'chi2'), [
    (SPHERE, QUATERNION, 727.149667), (SPHERE, ANGLE, 1351.2157), (GARAGE, QUATERNION, 1.238691),
    (GRID, QUATERNION, 458.1538), (GRID, ANGLE, 1025.3981)])
def test_chi2_at_the_l2_optimum(capsys, datasets, name, reading, chi2):
    for start in 'seed', 'file':
        report = solve_json(capsys, datasets / f'{name}.g2o', '--no-robust', '--norm', 'l2',
                            '--start', start, '--rotation-information', reading)
        assert report['final_cost'] == pytest.approx(chi2, rel=1e-6)


@pytest.mark.parametrize(('kind', 'count', 'seed'), [
    ('random', 2450, 0), ('grouped', 272, 1 + (56 << 32) + (10 << 64))])
def test_a_sphere_is_alike_everywhere_and_lies_do_not_agree_by_it(
        capsys, datasets, tmp_path, kind, count, seed):
    """Half of all loops, or runs that agree: none is kept, no true one lost, nothing doubted."""
    bad = tmp_path / 'bad.g2o'
    run(capsys, 'corrupt', datasets / f'{SPHERE}.g2o', bad, '--false-loops', count, '--kind',
        kind, '--seed', seed)
    report = solve_json(capsys, bad)
    left = report['rejected'] + report['suspect']
    assert sorted(left) == sorted(false_of(bad)) and len(left) == count
    assert report['doubts'] == report['slips'] == []
