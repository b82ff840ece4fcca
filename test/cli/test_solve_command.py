# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam solve`: what it reports, draws and refuses."""

import re
from pathlib import Path

import numpy as np
import pytest
from command import help_of, run, solve_json, texts_of
from worlds import false_of, graph_file, pairs_of, whitened

import l1slam_ros as l1

EDGES = ['EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1', 'EDGE_SE2 1 2 1 0 0 1 0 0 1 0 1',
         'EDGE_SE2 0 2 2.1 0 0 1 0 0 1 0 1']


def test_solve_reports_what_it_wrote(capsys, world, tmp_path):
    output, picture = tmp_path / 'out.g2o', tmp_path / 'map.svg'
    report = solve_json(capsys, world, '--output', output, '--plot', picture,
                        '--reference', f'{world}.truth.txt')
    recomputed = np.abs(whitened(*l1.read_graph(output))).sum()
    assert recomputed == pytest.approx(report['final_cost'], rel=1e-12)
    assert report['final_cost'] < report['seed_cost'] < report['initial_cost']
    assert (report['poses'], report['factors'], report['loops']) == (150, 250, 101)
    assert report['rejected'] == [] and report['solver'] == 'interior-point'
    assert report['status'] in ('converged', 'iteration_limit', 'stalled')
    assert 0 < report['ate'] < 0.3
    still = solve_json(capsys, world, '--no-robust', '--start', 'odometry', '--outer', 0,
                       '--reference', f'{world}.truth.txt')
    assert still['outer_iterations'] == 0 and still['final_cost'] == still['initial_cost']
    assert still['ate'] > 3 * report['ate']
    assert {'world.g2o', 'optimised', 'truth', 'odometry', 'l1 cost', 'iteration',
            f'initial {report["initial_cost"]:.6g}, seed {report["seed_cost"]:.6g}, '
            f'final {report["final_cost"]:.6g}'} <= set(texts_of(picture))


REPORTED = ['poses', 'factors', 'loops', 'initial_cost', 'seed_cost', 'final_cost', 'status',
            'seconds', 'solver', 'outer_iterations', 'inner_iterations', 'rejected', 'suspect',
            'slips', 'parts', 'drift', 'confidence', 'doubts', 'warnings']


@pytest.mark.parametrize('more', [(), ('--no-robust',), ('--robust', '--norm', 'l2')])
def test_the_names_of_a_report_stay(capsys, world, more):
    assert list(solve_json(capsys, world, *more)) == REPORTED
    truth = ('--reference', f'{world}.truth.txt')
    assert list(solve_json(capsys, world, *more, *truth)) == [*REPORTED, 'ate', 'ate_poses']


def test_what_is_rejected_are_the_false_loops_in_the_order_of_the_file(capsys, lies):
    false = false_of(lies)
    report = solve_json(capsys, lies)
    assert report['rejected'] == [pair for pair in pairs_of(lies) if pair in false]
    assert len(report['rejected']) == 100
    assert (report['factors'], report['loops']) == (700, 401)


def clean_copy(path):
    """Write the graph without its false loops; return its path."""
    false = false_of(path)
    clean = path.with_name('clean.g2o')
    clean.write_text('\n'.join(
        line for line in path.read_text().splitlines()
        if not (line.startswith('EDGE') and [int(n) for n in line.split()[1:3]] in false)))
    return clean


@pytest.mark.parametrize('norm', ['l1', 'l2', 'huber'])
@pytest.mark.parametrize('lies', ['grouped'], indirect=True)
def test_costs_count_what_is_accepted(capsys, lies, norm):
    """They are those of a file without the false loops."""
    robust = solve_json(capsys, lies, '--norm', norm)
    honest = solve_json(capsys, clean_copy(lies), '--norm', norm, '--no-robust')
    for name in ('initial_cost', 'final_cost'):
        assert robust[name] == pytest.approx(honest[name], rel=1e-3)
    (params := lies.with_name('params.yaml')).write_text(
        '/**: {ros__parameters: {robust: {enabled: false}}}')
    credulous = solve_json(capsys, lies, '--norm', norm, '--params-file', params)
    assert credulous['rejected'] == credulous['suspect'] == credulous['slips'] == []
    assert credulous['final_cost'] > 2 * robust['final_cost']
    assert robust['final_cost'] <= robust['seed_cost'] < robust['initial_cost']


@pytest.mark.parametrize('lies', ['grouped'], indirect=True)
def test_every_start_is_the_same_to_a_robust_solve(capsys, lies, tmp_path):
    """Its own seed reads no start, so not even a start of garbage can spoil it."""
    spoiled, rng = tmp_path / 'garbage.g2o', np.random.default_rng(1)
    spoiled.write_text('\n'.join(
        ' '.join([*line.split()[:2], *map(str, 1e3 * rng.standard_normal(3))])
        if line.startswith('VERTEX') else line for line in lies.read_text().splitlines()))
    reports, poses = [], []
    for path, start in ((lies, 'seed'), (lies, 'odometry'), (lies, 'file'), (spoiled, 'file')):
        output = tmp_path / f'{len(reports)}.tum'
        reports.append(solve_json(capsys, path, '--start', start, '--output', output))
        poses.append(np.loadtxt(output))
    for name in ('seed_cost', 'final_cost', 'rejected', 'status', 'outer_iterations'):
        assert [report[name] for report in reports[1:]] == [reports[0][name]] * 3
    for other in poses[1:]:
        np.testing.assert_array_equal(other, poses[0])
    assert reports[3]['initial_cost'] > 100 * reports[2]['initial_cost']


@pytest.mark.parametrize('lies', ['random'], indirect=True)
def test_people_are_told_and_shown_which_loops_were_refused_and_why(capsys, lies, tmp_path):
    said = run(capsys, 'solve', lies)[0].splitlines()
    at = said.index('100 of 401 loops refused')
    named = [re.fullmatch(r'  (\d+) - (\d+): (\d+\.\d) sigmas off the accepted ones', line)
             for line in said[at + 1 : at + 21]]
    false = false_of(lies)
    assert all([int(match[1]), int(match[2])] in false for match in named)
    sigmas = [float(match[3]) for match in named]
    assert sigmas == sorted(sigmas, reverse=True) and sigmas[-1] > 4
    assert said[at + 21 :] == ['  and 80 more; `--json` lists all']
    assert run(capsys, 'solve', lies, '--quiet', '--plot', tmp_path / 'map.svg') == ('', '')
    drawn = texts_of(tmp_path / 'map.svg')
    assert 'refused loops' in drawn and 'false loops' not in drawn
    assert any('300 poses, 401 loops (100 refused)' in word for word in drawn)
    assert 'INPUT.trusted.txt' in (told := help_of(capsys, 'solve')) and 'INPUT.struck.txt' in told
    Path(f'{lies}.struck.txt').write_text(f'{named[0][1]} {named[0][2]}\n')
    (first, *_, worst), (believed, *rest) = (
        run(capsys, 'solve', lies, *more)[0].splitlines() for more in ((), ('--no-robust',)))
    assert first == believed and first.endswith(', 401 loops, 1 struck out')
    assert worst == '  and 79 more; `--json` lists all' and 'refused' not in ''.join(rest)


@pytest.mark.parametrize('lies', ['random'], indirect=True)
def test_odometry_that_lies_is_refused_and_named(capsys, lies):
    lines = lies.read_text().splitlines()
    step = next(k for k, line in enumerate(lines) if line.startswith('EDGE_SE2 610 613 '))
    fields = lines[step].split()
    fields[3] = str(float(fields[3]) + 6)
    lies.write_text('\n'.join([*lines[:step], ' '.join(fields), *lines[step + 1:]]))
    report = solve_json(capsys, lies)
    rejected, (slip,) = report['rejected'], report['slips']
    assert [[i, j] for i, j in rejected if j - i == 3] == [slip]
    assert abs(slip[0] - 610) <= 9  # between loops nobody can tell which of the steps it was
    assert len(rejected) == 101 and report['parts'] == 1
    said = run(capsys, 'solve', lies)[0]
    assert re.search(rf'\nthe odometry slipped from {slip[0]} - {slip[1]}: this step is \d+\.\d '
                     'sigmas off what the loops say, and is left out\n100 of 401 loops refused\n',
                     said)


def test_absolute_poses_are_no_loops_but_doubted_too(capsys, world):
    absolute = [f'EDGE_PRIOR_SE2 {k} {999 * (k == 9)} 0 0 1 0 0 1 0 1' for k in (9, 10)]
    world.write_text(world.read_text() + '\n'.join(absolute) + '\n')
    report = solve_json(capsys, world)
    assert (report['factors'], report['loops']) == (252, 101)
    out = run(capsys, 'solve', world)[0]
    assert '252 factors, 101 loops and 2 absolute poses\n' in out
    assert f'{len(report["rejected"])} of 101 loops and 2 absolute poses refused\n' in out


@pytest.mark.parametrize('norm', ['same', 'l2', 'huber', 'group-l1'])
def test_a_graph_without_loops_is_its_odometry(capsys, tmp_path, norm):
    report = solve_json(capsys, graph_file(tmp_path, EDGES[:2]), '--loop-norm', norm)
    assert report['status'] == 'converged' and report['final_cost'] < 1e-6
    assert report['warnings'] == report['rejected'] == report['suspect'] == []
    lines = run(capsys, 'solve', tmp_path / 'graph.g2o')[0].splitlines()
    assert all(lines) and 'refused' not in ''.join(lines)


@pytest.mark.parametrize('norm', ['l1', 'l2', 'huber'])
def test_every_start_leads_every_norm_to_one_cost(capsys, world, norm):
    best = solve_json(capsys, world, '--norm', norm)
    for start in 'seed', 'file', 'odometry':
        report = solve_json(capsys, world, '--no-robust', '--start', start, '--norm', norm)
        assert report['final_cost'] == pytest.approx(best['final_cost'], rel=1e-3)
        assert (report['seed_cost'] is None) == (start != 'seed')


def test_a_graph_with_gaps_and_without_poses_is_solved_from_its_tree(capsys, tmp_path):
    path = graph_file(tmp_path, [EDGES[0], 'EDGE_SE2 1 5 1.1 0 0 1 0 0 1 0 1',
                                 'EDGE_SE2 1 7 2.2 0 0 100 0 0 100 0 100',
                                 'EDGE_SE2 0 7 3 0 0 1 0 0 1 0 1'])
    report = solve_json(capsys, path, '--no-robust')
    assert report['final_cost'] < report['initial_cost']
    run(capsys, 'convert', path, tmp_path / 'out.g2o')
    assert l1.read_graph(tmp_path / 'out.g2o')[1].shape == (4, 3)
