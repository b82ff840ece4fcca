# SPDX-License-Identifier: Apache-2.0
"""The false-loop suite without its peers: cases, runs of ours, judgement, record, tables."""

import importlib
import json
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

FOLDER = Path(__file__).parents[1] / 'benchmarks'
sys.path.append(str(FOLDER))
kinds, robust, runs, robust_solvers, tables, suite = (importlib.import_module(name) for name in (
    'robust_kinds', 'robust_cases', 'robust_runs', 'robust_solvers', 'robust_tables',
    'false_loops'))


@pytest.fixture(scope='module')
def place():
    world = simulate_world(150, 300, WorldOptions(), np.random.default_rng(1))
    return robust.place_of('world', world.graph, world.odometry, world.truth[:, :2])


def loops_of(graph):
    return int((~graph.between.is_odometry).sum())


def test_the_kinds_are_those_of_the_package():
    assert set(kinds.LIES) == set(FALSE_LOOPS)
    assert kinds.shares_of('random', (0.5,)) == (0.5,)
    assert kinds.shares_of('heading', (0.5,)) == (0.3,)
    assert kinds.shares_of('clean', (0.5,)) == (0.0,)


@pytest.mark.parametrize('kind', kinds.LIES)
def test_the_share_is_of_all_loops(place, kind):
    case = robust.false_case(place, kind, 0.5, 0)
    assert case.is_false.sum() == loops_of(place.graph)
    assert loops_of(case.graph) == 2 * loops_of(place.graph)
    true = ~case.is_false
    assert np.array_equal(case.graph.between.measurement[true], place.graph.between.measurement)
    assert np.array_equal(robust.false_case(place, kind, 0.5, 0).graph.between.i,
                          case.graph.between.i)
    assert case.clean is place.graph


def test_a_tenth_of_the_true_loops_is_kept_and_as_many_are_false(place):
    case = robust.false_case(place, 'tenth-random', 0.5, 0)
    assert loops_of(case.clean) == round(loops_of(place.graph) / 10) == case.is_false.sum()


@pytest.mark.parametrize(('kind', 'metres', 'radians'),
                         [('slip-translation', 5.0, 0.0), ('slip-rotation', 0.0, np.pi / 2)])
def test_one_odometry_factor_slips(place, kind, metres, radians):
    case = robust.false_case(place, kind, 0.3, 0)
    before, after = place.graph.between, case.graph.between
    was = before.measurement[before.is_odometry]
    moved = place.graph.manifold.local(was, after.measurement[after.is_odometry])
    changed = np.flatnonzero(np.abs(moved).max(axis=1) > 1e-9)
    assert len(changed) == 1
    assert after.i[case.slip] == before.i[before.is_odometry][changed[0]]
    assert np.hypot(*moved[changed[0], :2]) == pytest.approx(metres, abs=1e-9)
    assert abs(moved[changed[0], 2]) == pytest.approx(radians, abs=1e-9)


def test_heading_noise_says_that_it_is_there(place):
    case = robust.false_case(place, 'heading', 0.3, 0)
    before, after = place.graph.between, case.clean.between
    odometry = before.is_odometry
    turned = after.measurement[odometry, 2] - before.measurement[odometry, 2]
    assert 0.8 < turned.std() / np.radians(1) < 1.2
    information = after.sqrt_information.transpose(0, 2, 1) @ after.sqrt_information
    was = before.sqrt_information.transpose(0, 2, 1) @ before.sqrt_information
    more = np.linalg.inv(information[odometry]) - np.linalg.inv(was[odometry])
    assert np.allclose(more, np.diag([0, 0, np.radians(1) ** 2]), atol=1e-12)
    assert np.array_equal(information[~odometry], was[~odometry])


@pytest.mark.parametrize('solver', robust_solvers.OURS, ids=lambda solver: solver.name)
def test_ours_tells_false_loops_from_true_ones(place, solver):
    case = robust.false_case(place, 'random', 0.3, 0)
    run = runs.batch_run(case, solver, 20.0)
    assert run.holds and run.told and run.seconds > 0
    assert (run.kept, run.false) == (0, case.is_false.sum())
    assert run.true == loops_of(place.graph) and run.lost <= 0.01 * run.true
    assert run.truth < 1


def test_a_solver_that_does_not_say_is_asked_by_its_map(place):
    case = robust.false_case(place, 'identity', 0.3, 0)

    def honest(graph, poses):
        return robust_solvers.Found(place.best, 1.0)

    run = runs.batch_run(case, robust_solvers.RobustSolver('x', False, 'stored', honest), 5.0)
    assert run.error == pytest.approx(0, abs=1e-9) and run.holds
    assert run.kept == 0 and run.lost <= 0.01 * run.true


def test_who_needs_too_long_is_stopped_and_not_asked_again(place):
    def endless(graph, poses):
        began = time.process_time()
        while graph is not place.graph:
            began = max(began, time.process_time())
        return robust_solvers.Found(poses, began)

    solver = robust_solvers.RobustSolver('endless', False, 'stored', endless)
    found = runs.measure(place, 'random', 0.3, 3, [solver], 0.2)
    assert [run.seconds for run in found] == [None]
    assert not found[0].holds and not found[0].told


def test_an_error_in_a_run_is_not_taken_for_a_time_out(place):
    def broken(graph, poses):
        raise ValueError('no such kernel')

    solver = robust_solvers.RobustSolver('broken', False, 'stored', broken)
    with pytest.raises(ValueError, match='no such kernel'):
        runs.batch_run(robust.false_case(place, 'random', 0.3, 0), solver, 5.0)


def test_online_is_judged_all_the_way(place):
    case = robust.false_case(place, 'online-random', 0.3, 0)
    run = runs.online_run(case, robust_solvers.ONLINE_OURS[0], 20.0)
    assert run.holds and run.numbers['largest'] >= run.error > 0
    assert (run.true, run.false) == (loops_of(place.graph), case.is_false.sum())
    assert run.kept == 0 and run.lost <= 0.1 * run.true


def test_partial_runs_are_merged_and_tabled(tmp_path):
    head = {'machine': {'cpu': 'one', 'cores': 2, 'used': 1},
            'versions': {'python': '3', 'numpy': '2', 'gtsam': '4'}}

    def run(seed, seconds, **values):
        return runs.Run('intel', 'random', 0.5, seed, 'mine', False, seconds, **values)

    right = {'error': 0.01, 'false': 10, 'true': 10, 'holds': True, 'told': True}
    suite.write(tmp_path, head, [run(0, 1.0, **right), run(1, 1.0, **right)])
    suite.write(tmp_path, head, [run(1, None), run(2, 3.0, **right | {'kept': 5})])
    rows = json.loads((tmp_path / 'results' / 'false_loops.json').read_text())['rows']
    assert [(row['seed'], row['seconds']) for row in rows] == [(0, 1.0), (1, None), (2, 3.0)]
    text = (tmp_path / 'FALSE_LOOPS.md').read_text()
    assert '| 50% | mine | 3 | 2/3 | 2/3 | 0.0100 |' in text
    assert '| 2.5/10 | 0/10 | 2 |' in text
    assert '| mine | 2/3 |' in text


def test_nonsense_is_refused_before_any_work(tmp_path, capsys):
    (tmp_path / 'intel.g2o').touch()
    folder = ['--datasets', str(tmp_path), '--graphs', 'intel']
    parsed = suite.parse([*folder, '--shares', '0.1,0.9', '--kinds', 'online-random'])
    assert parsed.shares == (0.1, 0.9) and parsed.kinds == ('online-random',)
    for words, expected in (([*folder, '--kinds', 'evil'], "'evil' is none of clean, random"),
                            ([*folder, '--shares', '1'], 'between 0 and 1'),
                            (folder[:2], 'has no manhattan3500.g2o')):
        with pytest.raises(SystemExit):
            suite.parse(words)
        assert expected in capsys.readouterr().err
