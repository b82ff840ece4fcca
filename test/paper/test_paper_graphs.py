# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The solvers on public graphs: each ends at the lowest L1 cost that is known."""

import numpy as np
import pytest
from command import solve_json
from worlds import whitened

import l1slam_ros as l1

# The lowest costs known, and those of the seeds.
BEST = {'intel': 961.77375, 'manhattan3500': 971.66316, 'city10000': 3772.00977,
        'sphere2500': 2931.7309, 'parking-garage': 87.760043}
SEED = {'sphere2500': 3754.27, 'parking-garage': 99.4214}
IN_THE_PLANE = 'intel', 'manhattan3500', 'city10000'


@pytest.mark.parametrize('name', IN_THE_PLANE)
@pytest.mark.parametrize('start', ['file', 'odometry', 'seed'])
def test_from_every_start_it_ends_at_the_lowest_cost_known(
        capsys, datasets, tmp_path, name, start):
    best, output = BEST[name], tmp_path / 'out.g2o'
    report = solve_json(capsys, datasets / f'{name}.g2o', '--no-robust', '--start', start,
                        '--output', output)
    assert (report['solver'], report['status']) == ('interior-point', 'converged')
    assert (1 - 1e-7) * best <= report['final_cost'] <= (1 + 1e-5) * best
    cost = np.abs(whitened(*l1.read_graph(output))).sum()
    assert cost == pytest.approx(report['final_cost'], rel=1e-6)


@pytest.mark.parametrize('name', SEED)
@pytest.mark.parametrize('start', ['odometry', 'seed'])
def test_in_space_it_ends_there_too(capsys, datasets, name, start):
    report = solve_json(capsys, datasets / f'{name}.g2o', '--no-robust', '--start', start)
    assert report['status'] == 'converged'
    assert (1 - 1e-6) * BEST[name] <= report['final_cost'] <= (1 + 1e-5) * BEST[name]
    assert start != 'seed' or report['seed_cost'] == pytest.approx(SEED[name], rel=1e-4)


@pytest.mark.parametrize(('name', 'start'), [
    *((name, start) for name in IN_THE_PLANE[:2] for start in ('file', 'odometry', 'seed')),
    ('city10000', 'seed')])
def test_algorithm_4_ends_there_too(capsys, datasets, name, start):
    """Within .1%, after so many of its steps."""
    best = BEST[name]
    report = solve_json(capsys, datasets / f'{name}.g2o', '--no-robust', '--start', start,
                        '--solver', 'primal-dual', '--outer', 8 if name == 'city10000' else 15)
    assert (1 - 1e-6) * best <= report['final_cost'] <= (1 + 1e-3) * best
    assert start != 'seed' or report['seed_cost'] < 1.25 * best
