# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Which solver a graph gets: by what a factorisation costs, by name, and where one fails."""

import numpy as np
import pytest
from command import run, solve_json
from worlds import edge, graph_file, made

BELIEVING = '--no-robust', '--start', 'odometry'


@pytest.fixture
def dense(tmp_path):
    """Return a graph whose far places are joined at random: half of it ends in one block."""
    rng = np.random.default_rng(0)
    first = rng.integers(998, size=3000)
    pairs = np.column_stack((first, rng.integers(first + 2, 1000))).tolist()
    pairs += [(k, k + 1) for k in range(999)]
    return graph_file(tmp_path, [edge(i, j, rng.normal((j - i, 0, 0), 0.1), np.diag((100,) * 3))
                                 for i, j in pairs])


def test_sparse_graphs_get_the_interior_point_and_dense_ones_algorithm_4(capsys, world, dense):
    for path, said in ((world, 'interior-point, because the graph is sparse'),
                       (dense, 'primal-dual, because the graph is dense')):
        assert f'solver: {said}\n' in run(capsys, 'solve', path, *BELIEVING, '--outer', 0)[0]


@pytest.mark.parametrize('solver', ['auto', 'primal-dual', 'interior-point'])
def test_a_graph_that_fills_in_gets_algorithm_4_or_is_refused(capsys, world, machine, solver):
    """With memory for a few blocks only: nothing is factored, and it is solved all the same."""
    best = solve_json(capsys, world, '--no-robust')['final_cost']
    machine({'/proc/meminfo': 'MemAvailable: 500 kB'})
    if solver == 'interior-point':
        err = run(capsys, 'solve', world, '--no-robust', '--solver', solver, code=2)[1]
        assert err.count('\n') == 1 and (
            'world.g2o: factorising 150 keyframes and 250 factors takes 0.000585 GB of memory, '
            'and 0.000461 GB are free') in err
        return
    report = solve_json(capsys, world, '--no-robust', '--solver', solver)
    assert (report['solver'], report['inner_iterations'] > 0) == ('primal-dual', True)
    assert report['final_cost'] == pytest.approx(best, rel=1e-3)


def test_algorithm_4_goes_on_where_the_interior_point_failed_unless_it_was_asked_for(
        capsys, tmp_path):
    """From raw odometry, a third of the loops false, five steps are not enough."""
    path = made(tmp_path / 'a.g2o', 150, 220, '--false-loops', 30)
    auto, asked = (solve_json(capsys, path, *BELIEVING, '--outer', 5, '--solver', solver)
                   for solver in ('auto', 'interior-point'))
    assert asked['solver'] == 'interior-point' and asked['status'] == 'iteration_limit'
    assert auto['solver'] == 'primal-dual' and auto['final_cost'] < asked['final_cost']


@pytest.mark.parametrize('norm', ['l1', 'group-l1', 'l2', 'huber'])
@pytest.mark.parametrize('steps', [0, 1, 2])
def test_it_says_how_far_it_came_and_never_ends_worse(capsys, world, norm, steps):
    report = solve_json(capsys, world, *BELIEVING, '--norm', norm, '--outer', steps, '--solver',
                        'interior-point')
    assert (report['status'], report['outer_iterations']) == ('iteration_limit', steps)
    assert (report['final_cost'] < report['initial_cost']) == (steps > 0)
