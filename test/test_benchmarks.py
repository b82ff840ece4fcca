# SPDX-License-Identifier: Apache-2.0
"""What can be told of the benchmarks without the peers: marks, medians, ratios, bounds, tables."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from scipy.optimize import linprog
from scipy.sparse import csr_array, eye_array, hstack

FOLDER = Path(__file__).parents[1] / 'benchmarks'
sys.path.append(str(FOLDER))
cases, measuring, solvers, tables, inner, growth, iteration, linear, ours, whole, environment = (
    importlib.import_module(name) for name in (
        'solvers.cases', 'measuring', 'solvers.__main__', 'solvers.tables', 'solvers.inner',
        'solvers.growth', 'solvers.iteration', 'solvers.linear_solvers', 'solvers.ours',
        'solvers.whole', 'peer_environment'))


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


def rows(seconds, problem='p', group='g', **numbers):
    return [measuring.Row(problem, group, solver, solver == 'mine', value, numbers=numbers)
            for solver, value in seconds.items()]


def test_peers_are_pinned():
    names = {}
    for line in environment.requirements():
        requirement = Requirement(line)
        names.setdefault(requirement.name, []).append(str(requirement.specifier))
    assert names['gtsam'] == ['==4.3.0', '==4.2.2'] and names['g2opy'] == ['==2.3.0']
    assert all(names[name][0].startswith('==') for name in ('clarabel', 'highspy', 'ortools'))


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


def test_a_record_gives_its_rows_back():
    row = measuring.row('p', 'g', 's', True, measuring.Measured((3.0, 1.0, 2.0), np.zeros(1)),
                        excess=0.5)
    assert (row.seconds, row.runs, row.least, row.most) == (2.0, 3, 1.0, 3.0)
    missing = measuring.row('p', 'g', 'none', False, None)
    assert measuring.rows_of({'rows': [vars(row), vars(missing)]}) == [row, missing]


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


def test_iterates_are_stopped_at_the_first_that_reaches_the_mark():
    problem = type('Problem', (), {'cost': staticmethod(lambda x: 1 / x[0])})
    solver = linear.ByIterations('counting', lambda _: (np.array([k]) for k in range(1, 10**6)))
    assert solver.reach(problem, [1 / 30, 1 / 95], 60.0) == [40, 100]
    assert solver.run(problem, 100, 60.0).x == [100]


def test_problems_are_those_of_the_seed(problems):
    assert [problem.name.split(': ')[1] for problem in problems] == [
        'angle', 'translation', 'global']
    assert [problem.A.shape for problem in problems] == [(120, 59), (240, 118), (360, 177)]


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


def test_least_squares_start():
    A = csr_array(np.array([[1.0, 0], [0, 2], [1, 1]]))
    b = np.array([1.0, 2, 5])
    x, y = linear.least_squares_start(A, b)
    assert x == pytest.approx(np.linalg.lstsq(A.toarray(), b, rcond=None)[0])
    assert np.abs(y).max() == 1


def test_ratios_are_within_a_group_and_to_the_reference():
    first = rows({'mine': 1.0, 'peer': 4.0, 'slow': None})
    other = rows({'mine': 3.0, 'peer': None}, group='h')
    found = tables.ratios(first + other, 'peer')
    assert found[('p', 'g', 'mine')] == 0.25 and found[('p', 'g', 'peer')] == 1
    assert found[('p', 'g', 'slow')] is None and found[('p', 'h', 'mine')] is None


def test_the_table_of_inner_problems_has_seconds_and_how_many_times_faster():
    measured = rows({ours.PLAIN: 8.0, 'mine': 0.25, 'slow': None}, group='to 0.001', gap=1e-9)
    lines = tables.inner_tables(measured)
    assert f'| problem | {ours.PLAIN} | mine | slow |' in lines
    assert '| p | 8.00 (1.00) | 0.250 (32.0) | – |' in lines


def test_the_table_of_whole_solves_counts_first_poses_where_there_are_none():
    given = rows({whole.REFERENCE: 2.0, 'mine': 1.0}, group='stored', l1=10.0, chi2=4.0)
    nothing = rows({whole.REFERENCE_FROM_NOTHING: 5.0, 'mine': 1.0}, group=whole.NOTHING,
                   l1=9.0, chi2=5.0)
    text = '\n'.join(tables.whole_tables(whole.with_excess(given + nothing, 8.0)))
    assert '| stored | mine | 1.00 | 0.500 | 10.000 | 2.5e-01 | 4.000 |' in text
    assert f'| {whole.NOTHING} | mine | 1.00 | 0.200 | 9.000 | 1.2e-01 | 5.000 |' in text


def test_starts_are_summed_up():
    measured = [row for k in range(3) for row in rows(
        {whole.REFERENCE: 2.0, 'mine': 1.0 + k}, group=f'perturbed {k}', l1=10.0, excess=k / 100)]
    assert '| p | mine | 3 | 2.00 | 1.00 | 0.0e+00 | 1.0e-02 | 2.0e-02 |' in (
        tables.starts_tables(measured))


def test_an_iteration_is_compared_with_its_bytes():
    measured = rows({iteration.REFERENCE: 300e-6}, bandwidth_large=8e9)
    measured += rows({'mine': 100e-6}, bandwidth_large=8e9, bandwidth=40e9, bytes_per_edge=184.0,
                     needed=50e-6)
    assert '| p | mine | 100 | 3.00 | 184 | 40.0 | 8.00 | 50.0 | 2.00 |' in (
        tables.iteration_tables(measured))


def test_the_exponent_of_growth_is_found():
    edges = np.array([1e3, 1e4, 1e5])
    assert growth.exponent(edges, 3e-6 * edges**1.25) == pytest.approx(1.25)
    measured = [measuring.Row(f'world {n}', 'sparse', 'ours', True, 3.0 * n, numbers={
        'edges': n, 'seed': 1.0 * n, 'solve': 2.0 * n**2}) for n in (10, 100)]
    lines = tables.growth_tables(measured)
    assert 'Time of the seed grows as edges^1.00 (sparse worlds).' in lines
    assert 'Time of the solve grows as edges^2.00 (sparse worlds).' in lines


def test_a_comparison_gives_ratios_and_the_machine_by_the_peers():
    def recorded(factor, peers):
        measured = rows({'mine': 2.0 * factor, 'peer': 3.0 * peers, 'lost': None})
        return {'inner': {'rows': [vars(row) for row in measured]}}

    lines = tables.comparison(recorded(0.5, 1.1), recorded(1.0, 1.0))
    assert 'inner: p, g, mine: 1.00 / 2.00 s, 0.500' in lines
    assert 'inner: p, g, lost: – / – s, –' in lines
    assert lines[-2].startswith('ours: 0.500') and lines[-1].startswith('peers: 1.100')


def test_the_document_has_the_parts_that_there_are():
    measured = rows({ours.PLAIN: 8.0}, group='to 0.001', gap=1e-9)
    machine = {'cpu': 'one', 'cores': 2, 'used': 1}
    record = {'machine': machine, 'versions': {'numpy': '2'}, 'rows': [vars(measured[0])]}
    text = '\n'.join(tables.document({'inner': record}))
    assert 'one, 1 of 2 cores; numpy 2.' in text and 'Whole solves' not in text


def test_a_perturbed_start_is_reproducible_and_holds_the_first_pose():
    case = cases.simulated_case(60, 120)
    assert np.array_equal(case.perturbed(3), case.perturbed(3))
    assert not np.array_equal(case.perturbed(3), case.perturbed(4))
    assert np.array_equal(case.perturbed(3)[0], case.stored[0])


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


def test_the_bandwidth_is_that_of_a_triad():
    measured = iteration.bandwidth(iteration.compiled_triad(), 10_000)
    assert 1e8 < measured < 1e13
