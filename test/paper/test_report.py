# SPDX-License-Identifier: Apache-2.0
"""The tables of the report hold the numbers that were measured, whatever they are."""

from dataclasses import replace

import numpy as np
import pytest
from problems import graph_of

from l1slam_ros.core.solvers.nonlinear import Solution
from l1slam_ros.core.solvers.optimality import Status
from l1slam_ros.paper import figures, report
from l1slam_ros.paper import printed as paper
from l1slam_ros.paper.experiments import Costs, Effort, Seconds
from l1slam_ros.paper.runs import (
    HUBERS,
    JOINT,
    L1,
    L2,
    NOISES,
    ROBUST,
    SEED,
    START,
    LoopRun,
    LoopRuns,
    Map,
    StartRuns,
)
from l1slam_ros.paper.updates import Updates

BENT = 1.0
NO_PAIRS = np.zeros((0, 2), np.int64)
NARROWEST, NARROW, USUAL, WIDE = HUBERS


def shown(error, cost=100.0):
    return Map(np.zeros((3, 2)), cost, error)


def starts(l2_errors, l1_errors):
    """Two draws for each noise, with one error for both draws of a noise or a pair."""
    noisy = {noise: [{START: shown(9.0, 5000 * noise), L2: shown(np.ravel([l2, l2])[k], 400.0),
                      L1: shown(np.ravel([l1, l1])[k], 300.0)} for k in range(2)]
             for noise, l2, l1 in zip(NOISES, l2_errors, l1_errors, strict=True)}
    from_seed = {START: shown(0.2, 110.0), L2: shown(0.1, 150.0), L1: shown(0.0, 100.0)}
    return StartRuns(from_seed, noisy, np.array([110.0, 105.0]), BENT)


def liars(kept=0, lost=0, **errors):
    """Two draws of four false loops; errors : of both draws, by the name of a constant above."""
    names = {'seed': SEED, 'joint': JOINT, 'robust': ROBUST, 'narrowest': NARROWEST,
             'narrow': NARROW, 'usual': USUAL, 'wide': WIDE}
    of = {name: errors.get(word, (0.0, 0.0)) for word, name in names.items()}
    pairs = np.arange(8).reshape(4, 2)
    found = [LoopRun({name: shown(error[k]) for name, error in of.items()}, pairs[kept:],
                       pairs[:kept], pairs[:lost]) for k in range(2)]
    return LoopRuns({JOINT: shown(0.0)}, NO_PAIRS, found, BENT)


def table(lines):
    """Return the rows of a Markdown table, each by the names of the columns."""
    header, _, *rows = [[cell.strip() for cell in line.strip('|').split('|')]
                        for line in lines if line.startswith('|')]
    return [dict(zip(header, row, strict=True)) for row in rows]


def study(*results):
    return report.Study({str(k): result for k, result in enumerate(results)}, Effort())


def result(graph, initial, seed, printed, final, l2, truth=None, plain=2e-3):
    """What a graph of three poses would have given, had these been its numbers."""
    poses = np.zeros((3, 3))
    solution = Solution(poses, final, Status.CONVERGED, 1, 0, np.array([seed, final]), np.zeros(0))
    costs = Costs(initial, seed, l2, np.array([seed, printed]), False, solution, 'interior-point')
    seconds = Seconds({'plain': [plain] * 3, 'fused': [plain / 8] * 3}, 10 * plain)
    return report.GraphResult(graph, graph_of(poses, [(0, 1), (1, 2)]), poses, poses, costs,
                              seconds, truth)


def test_table_1_sets_the_costs_beside_those_of_the_paper():
    large = result(paper.MANHATTAN_50K, 9e8, 110.0, 120.0, 100.0, 105.0, truth=125.0)
    cut = replace(large, costs=replace(large.costs, cut_short=True))
    intel, world, ended = table(report.table_1(study(
        result(paper.INTEL, 1513.17, 970.0, 1000.0, 960.0, 980.0), large, cut), None))
    assert intel == {'L1 cost': 'Intel', 'poses, edges': '3, 2', 'start: paper': '1513.17',
                     'start: ours': '1513.17', 'seed: ours': '970', 'final: paper': '982.051',
                     'final: as printed': '1000', 'final: ours': '**960**',
                     'solver': 'interior-point', 'of the L2 map': '980', 'of the true poses': ''}
    assert world['L1 cost'] == 'Manhattan50k (*)' and world['of the true poses'] == '125'
    assert world['start: paper'] == '7.14591e8'
    assert world['final: as printed'] == '120' and ended['final: as printed'] == '120 (+)'


def test_table_2_sets_times_beside_those_of_the_paper():
    intel, large = table(report.table_2(study(
        result(paper.INTEL, 1513.17, 970.0, 1000.0, 960.0, 980.0),
        result(paper.MANHATTAN_50K, 9e8, 110.0, 120.0, 100.0, 105.0, plain=0.28)), None))
    assert intel == {
        'ms per iteration': 'Intel', 'angle: paper': '0.3', 'angle: plain': '2',
        'angle: fused': '0.25', 'translation: paper': '0.6', 'translation: plain': '2',
        'translation: fused': '0.25', 'global: paper': '1', 'global: plain': '2',
        'global: fused': '0.25', 'L2: paper (g2o)': '6.7', 'L2: ours': '20'}
    assert [large['L2: paper (g2o)'], large['L2: ours']] == ['did not finish', '2800']


def test_a_curve_has_arrived_where_it_stays():
    out_again = np.array([[0, 100.0], [40, 100.1], [80, 150.0], [120, 100.05]])
    never = np.array([[0, 300.0], [40, 250.0], [80, 200.0]])
    one, other = table(figures.table_of_curves({
        'angle': {'one': out_again, 'other': never}}))
    assert [*one.values()] == ['angle', 'one', '120', '100', '100.05', '0.05%', '120']
    assert [*other.values()][-2:] == ['100.00%', 'not reached']


def test_figure_4_has_every_noise_and_the_seed():
    runs = starts([0.1, 0.1, (0.1, 3.0), 4.0], [0.0, 0.0, 0.0, 2.0])
    rows = table(figures.table_of_starts(runs))
    by_start = {row['start']: [*row.values()][1:] for row in rows}
    assert len(rows) == len(NOISES) + 2
    assert by_start['noise of 1 m, 1 rad'] == [
        '5000', '400', '1.55 m', '1 of 2', '300', '0.00 m', '2 of 2']
    assert by_start['noise of 2 m, 2 rad'][2:4] == ['4.00 m', '0 of 2']
    assert by_start['the seed (Algorithm 3)'] == [
        '110', '150', '0.10 m', '1 of 1', '100', '0.00 m', '1 of 1']
    assert by_start['the seed, then as printed'] == ['110', '', '', '', '105', '', '']


@pytest.mark.parametrize(('errors', 'noise'), [
    ([0.1, 2.0, 0.1, 3.0], 0.5), ([0.1, 0.1, (0.1, 3.0), 3.0], 2), ([0.1] * 4, 2)])
def test_the_start_that_is_drawn_is_the_first_that_l2_does_not_survive(errors, noise):
    assert figures.drawn_noise(starts(errors, [0.0] * 4)) == noise


def test_figure_5_has_every_method_that_ran():
    ms = [*[1.0] * 96, *[4.0] * 4]
    updates, batch = Updates([each / 1e3 for each in ms], [], 2.5), np.array([.01, .02, .02, .03])
    ours, l2 = table(figures.table_of_updates(updates, batch))
    assert [*ours.values()] == ['ours', '1.00', '1.00', '4.00', '4.00', '1.00', '4.00', '0.1',
                                '2.5']
    assert [*l2.values()][:2] == ['batch L2', '20.00'] and l2['behind [s]'] == ''
    beside = replace(updates, peer=[0.002] * 60)
    assert table(figures.table_of_updates(beside, batch))[1]['most'] == '2.00'


def test_figure_6_has_every_method_and_what_was_refused():
    good = liars(seed=(0.2, 0.4), narrow=(0.5, 0.5), narrowest=(0.6, 0.6), usual=(2, 2),
                 wide=(3, 3))
    bad = liars(seed=(20, 30), robust=(0.0, 1.5), kept=1, lost=2)
    runs = {'Good': good, 'Bad': bad}
    methods, refused = table(figures.table_of_methods(runs)), table(figures.table_of_refused(runs))
    assert [row['off its own clean map'] for row in methods] == [
        SEED, JOINT, NARROWEST, NARROW, USUAL, WIDE, ROBUST]
    assert [*methods[0].values()] == [SEED, '0.30 m', '0.20 to 0.40 m', '2 of 2',
                                      '25.00 m', '20.00 to 30.00 m', '0 of 2']
    assert methods[-1]['Bad: lowest to highest'] == '0.00 to 1.50 m'
    assert methods[-1]['Bad: keeps the shape'] == '1 of 2'
    assert [[*row.values()] for row in refused] == [
        ['Good', '0', '4', '2', '1.00 m', '8 of 8', '0'],
        ['Bad', '0', '4', '2', '1.00 m', '6 of 8', '4']]
    assert figures.best_huber(good) == NARROW
