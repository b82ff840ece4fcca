# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The false-loop suite without its peers: cases, judgement, record, tables."""

import importlib
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph, component_labels
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

FOLDER = Path(__file__).parents[1] / 'benchmarks'
sys.path.append(str(FOLDER))
kinds, places, cases, aliasing, runs, solvers, suite = (importlib.import_module(name) for name in (
    'robust.kinds', 'robust.places', 'robust.cases', 'robust.aliasing', 'robust.runs',
    'robust.solvers', 'false_loops'))


def place_of(n):
    world = simulate_world(n, 2 * n, WorldOptions(), np.random.default_rng(1))
    return places.place_of('world', world.graph, world.odometry,
                           places.error_by_time(world.truth[:, :2]))


@pytest.fixture(scope='module')
def place():
    return place_of(400)


def kind(name):
    return next(each for each in kinds.KINDS if each.name == name)


def loops_of(graph):
    return int((~graph.between.is_odometry).sum())


def test_the_kinds_are_of_the_package_and_each_has_a_name_of_its_own():
    assert set(kinds.LIES) == set(FALSE_LOOPS)
    names = [(each.suite, each.name, graph) for each in kinds.KINDS for graph in each.graphs]
    assert len(names) == len(set(names))


@pytest.mark.parametrize('lies', kinds.LIES)
def test_the_share_is_of_all_loops(place, lies):
    case = cases.false_case(place, kind(lies), 0.5, 0)
    assert case.is_false.sum() == loops_of(place.graph) == case.is_true.sum()
    kept = ~case.is_false
    assert np.array_equal(case.graph.between.measurement[kept], place.graph.between.measurement)
    again = cases.false_case(place, kind(lies), 0.5, 0)
    assert np.array_equal(again.graph.between.pairs, case.graph.between.pairs)


@pytest.mark.parametrize('count', [1, 2])
@pytest.mark.parametrize(('what', 'metres', 'radians'),
                         [('translation', 5.0, 0.0), ('rotation', 0.0, np.pi / 2)])
def test_odometry_factors_slip(place, what, metres, radians, count):
    case = cases.false_case(place, kind(f'slip-{what}-{count}'), 0.3, 0)
    before, after = place.graph.between, case.graph.between
    moved = se2.local(before.measurement[before.is_odometry],
                      after.measurement[after.is_odometry])
    changed = np.abs(moved).max(axis=1) > 1e-9
    assert np.array_equal(np.flatnonzero(after.is_odometry)[changed], case.slips)
    assert len(case.slips) == count == len(after) - case.is_false.sum() - len(case.clean.between)
    assert not component_labels(case.clean).any()
    assert np.hypot(*moved[changed, :2].T) == pytest.approx(metres, abs=1e-9)
    assert np.abs(moved[changed, 2]) == pytest.approx(radians, abs=1e-9)


@pytest.mark.parametrize(('part', 'is_odometry'), [('odometry', True), ('loops', False)])
def test_information_is_stated_wrong_of_one_part_alone(place, part, is_odometry):
    case = cases.false_case(place, kind(f'{part}-1e4'), 0.0, 0)
    before, after = (one.graph.between.sqrt_information[:, 0, 0] for one in (place, case))
    of_part = case.graph.between.is_odometry == is_odometry
    assert after / before == pytest.approx(np.where(of_part, 100, 1))


@pytest.mark.parametrize(('streets', 'same'), [(3, False), (2, True)])
def test_an_aliased_street_is_moved_by_one_transform(place, streets, same):
    lies = aliasing.aliased_loops(place.graph, place.best, streets, same,
                                  np.random.default_rng(3), length=10)
    # Z = Xi^-1 W Xj, and where the street is the earlier end, Z = Xi^-1 W^-1 Xj.
    wrong = se2.compose(se2.compose(place.best[lies.i], lies.measurement),
                        se2.inverse(place.best[lies.j]))
    found = np.where(wrong[:, 2:] < 0, se2.inverse(wrong), wrong)
    assert len(found) == 10 * streets
    assert len(np.unique(found.round(6), axis=0)) == (1 if same else streets)


@pytest.mark.parametrize(('name', 'parts'), [('sessions', 1), ('apart', 2)])
def test_a_session_begins_anywhere(place, name, parts):
    case, half = cases.false_case(place, kind(name), 0.3, 0), place.graph.n_poses // 2
    assert component_labels(case.graph).max() + 1 == parts == case.session.max() + 1
    assert np.hypot(*se2.between(case.start[half - 1], case.start[half])[:2]) > 2


@pytest.mark.parametrize('name', dict.fromkeys(each.name for each in kinds.KINDS
                         if each.suite == 'variants' and not each.lies))
def test_what_is_told_otherwise_is_as_true(place, name):
    truth, factors = place.best, place.graph.between
    exact = FactorGraph(se2, len(truth))
    exact.append_between(factors.i, factors.j, se2.between(truth[factors.i], truth[factors.j]),
                         factors.sqrt_information)
    told = places.place_of('world', exact, None, places.error_by_time(truth[:, :2]))
    case = cases.false_case(told, kind(name), 0.0, 0)
    assert case.place.truth_error(case.start[:, :2]) == pytest.approx(0, abs=1e-6)
    # Else the error of what was told wrong would be none, too.
    assert case.place.truth_error(case.start[:, :2] * [1.0, 0.5]) > 1
    # Whatever comes of the noise, what was measured without is met, and what lies is not.
    off = np.abs(se2.residual(case.graph.between.measurement, *(
        case.start[ends] for ends in case.graph.between.pairs.T))).max(axis=1)
    assert (off[~case.is_false] < 1e-9).all() and (off[case.is_false] > 0.9).all()
    assert np.isfinite(case.graph.between.sqrt_information).all()
    assert case.is_true.sum() >= 0.3 * loops_of(case.place.graph) > 0


def test_noise_is_carried_over_to_the_keyframes_that_are_kept(place):
    told = cases.false_case(place, kind('every-3'), 0.0, 0).place
    chains = [np.zeros((3, 3)), np.zeros((3, 3))]
    for which, graph in enumerate((place.graph, told.graph)):
        odometry = graph.subset(graph.between.is_odometry).between
        for Z, root in zip(odometry.measurement, odometry.sqrt_information, strict=True):
            back = se2.adjoint(se2.inverse(Z[None]))[0]
            chains[which] = back @ chains[which] @ back.T + np.linalg.inv(root.T @ root)
    assert chains[1] == pytest.approx(chains[0], rel=1e-6)


def run_of(place, name, share, found):
    case = cases.false_case(place, kind(name), share, 0)
    return runs.run_of(case, solvers.RobustSolver('x', 'l2', 'odometry',
                                                  lambda graph, poses: found(case)), 5.0)


@pytest.mark.parametrize('solver', solvers.OURS[:3], ids=lambda solver: solver.name)
def test_ours_tells_false_loops_from_true_ones(solver):
    case = cases.false_case(place_of(120), kind('random'), 0.3, 0)
    run = runs.run_of(case, solver, 60.0)
    assert run.kept == 0 and run.false == case.is_false.sum() and run.lost <= 0.05 * run.true
    assert run.truth < 1 and run.seconds > 0
    assert (run.way is not None) == solver.online


def told(case, status='converged', **values):
    accepted = ~case.is_false
    return solvers.Found(case.place.best, 1.0, accepted, status=status, **values)


def test_a_bar_is_passed_by_the_right_map_and_by_doubt_where_doubt_is_an_answer(place):
    assert run_of(place, 'random', 0.5, told).passed
    assert not run_of(place, 'random', 0.5, lambda case: told(case, solvers.DOUBTFUL)).passed
    assert run_of(place, 'random', 0.7, lambda case: told(case, solvers.DOUBTFUL)).passed
    assert not run_of(place, 'ring-random', 0.5, told).passed
    assert run_of(place, 'ring-random', 0.5, lambda case: told(case, solvers.DOUBTFUL)).passed
    named = run_of(place, 'clean', 0.0, lambda case: told(case, slips=(7,)))
    assert named.wrongly == 1 and not named.passed


def test_doubt_excuses_lost_loops_and_no_kept_ones(place):
    def nothing(case):
        return solvers.Found(case.start, 1.0, case.graph.between.is_odometry, status=doubt)

    def everything(case):
        return solvers.Found(case.start, 1.0, np.ones(len(case.is_false), bool), status=doubt)

    doubt = solvers.DOUBTFUL
    assert run_of(place, 'loops-1e4-random', 0.5, nothing).passed
    assert not run_of(place, 'loops-1e4-random', 0.5, everything).passed
    doubt = 'converged'
    assert not run_of(place, 'loops-1e4-random', 0.5, nothing).passed


def test_a_solver_that_does_not_say_is_asked_by_its_map(place):
    run = run_of(place, 'identity', 0.3, lambda case: solvers.Found(place.best, 1.0))
    assert run.error == pytest.approx(0, abs=1e-6) and run.right
    assert run.kept == 0 and run.lost <= 0.01 * run.true


def test_who_needs_too_long_is_stopped_and_not_asked_again(place):
    def endless(graph, poses):
        while True:
            time.process_time()

    solver = solvers.RobustSolver('endless', 'l2', 'odometry', endless)
    found = runs.measure(place, kind('random'), 0.3, range(3), [solver], 0.2)
    assert [run.seconds for run in found] == [None]
    assert not found[0].passed


def test_an_error_in_a_run_is_not_taken_for_a_time_out(place):
    def broken(case):
        raise ValueError('no such kernel')

    with pytest.raises(ValueError, match='no such kernel'):
        run_of(place, 'random', 0.3, broken)


def test_nonsense_is_refused_before_any_work(tmp_path, capsys):
    folder = ['--datasets', str(tmp_path)]
    parsed = suite.parse([*folder, '--graphs', 'intel', '--kinds', 'random', '--shares', '0.1,0.9',
                          '--seeds', '2-4'])
    assert [share for _, _, share in suite.selected(parsed)] == [0.1, 0.9]
    assert list(parsed.seeds) == [2, 3, 4]
    for words, expected in (([*folder, '--suite', 'evil'], "'evil' is none of synthetic"),
                            ([*folder, '--shares', '1'], 'between 0 and 1'),
                            ([*folder, '--kinds', 'evil'], 'there is no such kind')):
        with pytest.raises(SystemExit):
            suite.parse(words)
        assert expected in capsys.readouterr().err
