# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What can be told of the benchmarks without the peers: marks, medians, ratios, bounds, tables."""

import importlib
import inspect
import json
import sys
from pathlib import Path

import pytest
from problems import linprog_l1

FOLDER = Path(__file__).parents[1] / 'benchmarks'
sys.path.append(str(FOLDER))
cases, measuring, solvers, tables, inner, linear, ours, environment, robust, runs, ablation = (
    importlib.import_module(name) for name in (
        'solvers.cases', 'measuring', 'solvers.__main__', 'solvers.tables', 'solvers.inner',
        'solvers.linear_solvers', 'solvers.ours', 'peer_environment', 'robust.tables',
        'robust.runs', 'robust.ablation'))


@pytest.fixture(scope='module')
def problems():
    return list(cases.inner_problems(cases.simulated_case(60, 120)))


def recorded(part):
    return json.loads((FOLDER / 'results' / f'{part}.json').read_text())


@pytest.mark.parametrize('rule', ablation.RULES)
def test_what_an_ablation_leaves_out_is_a_function_of_the_judgement(rule):
    function, holders, name = ablation.places_of(rule)
    assert all(vars(holder)[name] is function for holder in holders)
    assert 2 < ablation.lines_of(function) < 40
    # What stands for it takes what it takes.
    inspect.signature(ablation.RULES[rule]).bind(*inspect.signature(function).parameters)
    assert f'{name}`' in (FOLDER / 'robust' / 'SENSITIVITY.md').read_text()


def test_what_is_said_was_measured():
    """The documents are what their tables make of the records beside them."""
    of_false_loops = recorded('false_loops')
    for name, lines in (
            ('RESULTS', tables.document({part: recorded(part) for part in solvers.PARTS})),
            ('FALSE_LOOPS', robust.document(
                of_false_loops, [runs.Run(**fields) for fields in of_false_loops['rows']]))):
        assert (FOLDER / f'{name}.md').read_text().splitlines() == lines


@pytest.mark.parametrize('index', range(3))
def test_each_of_ours_reaches_the_optimum_that_another_finds(problems, index):
    problem = problems[index]
    best, _ = linprog_l1(problem.A, problem.b)
    for solver in ours.INNER:
        (setting,) = solver.reach(problem, [best * 1.001], 10.0)
        cost = problem.cost(solver.run(problem, setting, 10.0).x)
        assert (1 - 1e-9) * best <= cost <= 1.0011 * best, solver.name


@pytest.mark.parametrize('solver', [*ours.WHOLE, *ours.FROM_NOTHING], ids=lambda s: s.name)
def test_ours_solves_a_case(solver):
    case = cases.simulated_case(60, 120)
    answer = solver.prepare(case, case.starts['odometry'])()
    assert answer.seconds > 0 and answer.x.shape == (60, 3)


def test_unknown_parts_and_missing_graphs_are_refused_before_any_work(capsys, tmp_path):
    datasets = ['--datasets', str(tmp_path)]
    assert solvers.parse(['--only', 'inner,growth', *datasets]).only == ('inner', 'growth')
    assert solvers.parse(['--only', 'growth']).datasets is None
    with pytest.raises(SystemExit):
        solvers.parse(['--only', 'inner'])
    assert 'expected --datasets' in capsys.readouterr().err
    with pytest.raises(SystemExit):
        solvers.parse(['--only', 'inner,speed'])
    assert "'speed' is none of inner, whole" in capsys.readouterr().err
