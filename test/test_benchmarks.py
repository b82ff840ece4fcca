# SPDX-License-Identifier: Apache-2.0
"""What can be told of the benchmarks without the peers: marks, medians, ratios, bounds, tables."""

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from scipy.optimize import linprog
from scipy.sparse import eye_array, hstack

FOLDER = Path(__file__).parents[1] / 'benchmarks'
sys.path.append(str(FOLDER))
cases, measuring, solvers, tables, inner, linear, ours, environment, robust, runs = (
    importlib.import_module(name) for name in (
        'solvers.cases', 'measuring', 'solvers.__main__', 'solvers.tables', 'solvers.inner',
        'solvers.linear_solvers', 'solvers.ours', 'peer_environment', 'robust.tables',
        'robust.runs'))


@pytest.fixture(scope='module')
def problems():
    return list(cases.inner_problems(cases.simulated_case(60, 120)))


def optimum(problem):
    """Return min |A x - b|_1 by another solver."""
    m, n = problem.A.shape
    identity = eye_array(m)
    found = linprog(np.concatenate((np.zeros(n), np.ones(2 * m))), method='highs',
                    A_eq=hstack((problem.A, -identity, identity)), b_eq=problem.b,
                    bounds=[(None, None)] * n + [(0, None)] * (2 * m))
    return found.fun


def test_peers_are_pinned():
    names = {}
    for line in environment.requirements():
        requirement = Requirement(line)
        names.setdefault(requirement.name, []).append(str(requirement.specifier))
    assert names['gtsam'] == ['==4.3.0', '==4.2.2'] and names['g2opy'] == ['==2.3.0']
    assert all(names[name][0].startswith('==') for name in ('clarabel', 'highspy', 'ortools'))


def recorded(part):
    return json.loads((FOLDER / 'results' / f'{part}.json').read_text())


def test_what_is_said_was_measured():
    """The documents are what their tables make of the records beside them."""
    of_false_loops = recorded('false_loops')
    for name, lines in (
            ('RESULTS', tables.document({part: recorded(part) for part in solvers.PARTS})),
            ('FALSE_LOOPS', robust.document(
                of_false_loops, [runs.Run(**fields) for fields in of_false_loops['rows']]))):
        assert (FOLDER / f'{name}.md').read_text().splitlines() == lines


def test_runs_take_turns_and_the_first_round_does_not_count():
    order = []

    def run(name, times):
        left = iter(times)

        def once():
            order.append(name)
            return measuring.Answer(np.zeros(1), next(left))

        return once

    measured = measuring.interleaved(
        {'a': run('a', [9.0, 1.0, 3.0, 2.0]), 'b': run('b', [20.0])}, 3, 10.0)
    assert order == ['a', 'b', 'a', 'a', 'a']
    assert measured['a'].seconds == (1.0, 3.0, 2.0) and measured['a'].median == 2.0
    assert measured['b'].seconds == (20.0,)


def test_a_tolerance_is_tightened_until_the_mark_is_reached_and_the_cheapest_run_is_taken():
    problem = type('Problem', (), {'cost': staticmethod(lambda x: float(x[0]))})
    costs = {('a', 1): (1.5, 1.0), ('a', 2): (1.05, 4.0), ('a', 3): (1.0, 5.0),
             ('b', 1): (1.05, 2.0), ('b', 2): (1.005, 50.0)}
    solver = linear.ByTolerance(
        'both', ((('a', 1), ('a', 2), ('a', 3)), (('b', 1), ('b', 2))),
        lambda _, setting, limit: measuring.Answer(np.array([costs[setting][0]]),
                                                   costs[setting][1]))
    assert solver.reach(problem, [1.1, 1.01], 20.0) == [('b', 1), ('a', 3)]
    assert solver.reach(problem, [1.1, 0.9], 20.0) == [('b', 1), None]


@pytest.mark.parametrize('index', range(3))
def test_each_of_ours_reaches_the_optimum_that_another_finds(problems, index):
    problem = problems[index]
    best = optimum(problem)
    for solver in ours.INNER:
        (setting,) = solver.reach(problem, [best * 1.001], 10.0)
        cost = problem.cost(solver.run(problem, setting, 10.0).x)
        assert (1 - 1e-9) * best <= cost <= 1.0011 * best, solver.name


def test_the_lower_bound_is_one_from_any_dual(problems, rng):
    problem = problems[0]
    best = optimum(problem)
    assert inner.lower_bound(problem, rng.uniform(-1, 1, len(problem.b))) <= best
    m, n = problem.A.shape
    exact = linprog(problem.b, A_eq=problem.A.T, b_eq=np.zeros(n), bounds=[(-1, 1)] * m).x
    assert inner.lower_bound(problem, exact) == pytest.approx(best, rel=1e-9)


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
