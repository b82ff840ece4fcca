# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam`: what it prints, writes and answers to bad input."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from command import run, solve_json
from rosbags.rosbag2 import StoragePlugin
from torn import torn_graph

from bags import NOTE, recording_of, rosbag2_directory
from l1slam_ros.cli import solving
from l1slam_ros.cli.main import main
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.solvers import block_cholesky
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.io import progress
from l1slam_ros.io.formats import read_input
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file, write_graph_file

VERTICES = ['VERTEX_SE2 0 0 0 0', 'VERTEX_SE2 1 1 0 0', 'VERTEX_SE2 2 2 0 0']
EDGES = ['EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1', 'EDGE_SE2 1 2 1 0 0 1 0 0 1 0 1',
         'EDGE_SE2 0 2 2.1 0 0 1 0 0 1 0 1']
AFTER_GAP = 'EDGE_SE2 2 3 1 0 0 1 0 0 1 0 1'



@pytest.fixture(autouse=True)
def no_progress(monkeypatch):
    """On a machine that is busy a log would have lines on what takes long."""
    monkeypatch.setattr(progress, '_PATIENCE', float('inf'))


def graph_file(folder, lines):
    path = folder / 'graph.g2o'
    path.write_text('\n'.join(lines) + '\n')
    return path


@pytest.fixture
def world(tmp_path):
    path = tmp_path / 'world.g2o'
    assert main(['simulate', str(path), '--poses', '150', '--edges', '250', '--seed', '7']) == 0
    return path


def test_solve_reports_what_it_wrote(capsys, world, tmp_path):
    output, picture = tmp_path / 'out.g2o', tmp_path / 'map.svg'
    report = solve_json(capsys, world, '--output', output, '--plot', picture,
                        '--reference', f'{world}.truth.txt')
    record = read_graph_file(output)
    recomputed = l1_cost(whitened_residual(record.graph, record.poses))
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
            f'final {report["final_cost"]:.6g}'} <= set(words(picture))


@pytest.mark.parametrize('solver', ['primal-dual', 'interior-point'])
def test_a_chosen_solver_is_the_one_that_solves(capsys, world, solver):
    report = solve_json(capsys, world, '--solver', solver)
    best = solve_json(capsys, world)
    assert report['solver'] == solver
    assert report['final_cost'] == pytest.approx(best['final_cost'], rel=1e-3)
    assert (report['inner_iterations'] > 0) == (solver == 'primal-dual')


REPORTED = ['poses', 'factors', 'loops', 'initial_cost', 'seed_cost', 'final_cost', 'status',
            'seconds', 'solver', 'outer_iterations', 'inner_iterations', 'rejected', 'suspect',
            'slips', 'parts', 'drift', 'confidence', 'doubts', 'warnings']


@pytest.mark.parametrize('more', [(), ('--no-robust',), ('--robust', '--norm', 'l2')])
def test_the_names_of_a_report_stay(capsys, world, more):
    assert list(solve_json(capsys, world, *more)) == REPORTED
    truth = ('--reference', f'{world}.truth.txt')
    assert list(solve_json(capsys, world, *more, *truth)) == [*REPORTED, 'ate', 'ate_poses']


# Robust


def renumbered(path):
    """Return the lines of a graph with the ids 10, 13, 16, ..."""
    lines = [line.split() for line in path.read_text().splitlines()[:-1]]
    for fields in lines:
        for k in (1,) if fields[0] == 'VERTEX_SE2' else (1, 2):
            fields[k] = str(10 + 3 * int(fields[k]))
    return [' '.join(fields) for fields in lines]


@pytest.fixture(params=['random', 'identity', 'grouped'])
def lies(tmp_path, request):
    """A world with 100 false loops, its edges in no order, and its ids 10, 13, 16, ..."""
    path = tmp_path / 'lies.g2o'
    assert main(['simulate', str(path), '--poses', '300', '--edges', '600', '--seed', '4',
                 '--false-loops', '100', '--kind', request.param]) == 0
    lines = renumbered(path)
    np.random.default_rng(0).shuffle(lines)
    path.write_text('\n'.join(lines) + '\n')
    false = Path(f'{path}.false.txt')
    pairs = 10 + 3 * np.loadtxt(false, dtype=int)
    false.write_text('\n'.join(f'{i} {j}' for i, j in pairs))
    return path


def edges_of(path):
    """Return the pairs of ids of the edges of a g2o file, in its order."""
    rows = [line.split() for line in path.read_text().splitlines() if line.startswith('EDGE')]
    return [[int(row[1]), int(row[2])] for row in rows]


def test_what_is_rejected_are_the_false_loops_in_the_order_of_the_file(capsys, lies):
    false = np.loadtxt(f'{lies}.false.txt', dtype=int).tolist()
    report = solve_json(capsys, lies)
    assert report['rejected'] == [pair for pair in edges_of(lies) if pair in false]
    assert len(report['rejected']) == 100
    assert (report['factors'], report['loops']) == (700, 401)


def clean_copy(path):
    """Write the graph without its false loops; return its path."""
    false = np.loadtxt(f'{path}.false.txt', dtype=int).tolist()
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
    credulous = solve_json(capsys, lies, '--norm', norm, '--no-robust')
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
    false = np.loadtxt(f'{lies}.false.txt', dtype=int).tolist()
    assert all([int(match[1]), int(match[2])] in false for match in named)
    sigmas = [float(match[3]) for match in named]
    assert sigmas == sorted(sigmas, reverse=True) and sigmas[-1] > 4
    assert said[at + 21 :] == ['  and 80 more; `--json` lists all']
    assert run(capsys, 'solve', lies, '--quiet', '--plot', tmp_path / 'map.svg') == ('', '')
    drawn = words(tmp_path / 'map.svg')
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


# Doubtful


DOUBT = re.compile(r'doubtful: (\d+) refused loops agree with each other on another map, '
                   r'between (\d+) and (\d+)( \([0-9.]+ s to [0-9.]+ s\))?\. Vouch '
                   'for a true loop, strike out a false one, or state the right noise')


@pytest.fixture
def torn(tmp_path):
    """Return a graph that may be another map, ids from 100 on; and where the loops say so end."""
    path, (graph, ends) = tmp_path / 'torn.g2o', torn_graph()
    write_graph_file(path, GraphRecord(graph, odometry_poses(graph), 100 + np.arange(400)))
    return path, ends + 100


@pytest.mark.parametrize('norm', ['l1', 'l2'])
def test_a_map_that_loops_agree_is_wrong_is_given_as_doubtful(capsys, torn, tmp_path, norm):
    path, ends = torn
    output, picture = tmp_path / 'out.g2o', tmp_path / 'map.png'
    out, err = run(capsys, 'solve', path, '--norm', norm, '--json', '--output', output, '--plot',
                   picture, code=4)
    report = json.loads(out)
    said = DOUBT.fullmatch(err.removeprefix('l1slam: ').rstrip('\n'))
    loops, first, last = map(int, said.groups()[:3])
    assert ends[0] <= first < last <= ends[1] and 10 < loops <= len(report['rejected'])
    assert report['status'] == 'doubtful' and report['warnings'] == [said[0]]
    left = report['rejected'] + report['suspect']
    doubt, = report['doubts']
    assert doubt['kind'] == 'another map' and doubt['text'] in said[0]
    # All of them stand in the file like this, and all are among what was refused.
    named = {tuple(pair) for pair in doubt['loops']}
    assert len(named) == loops and named <= {tuple(pair) for pair in report['rejected']}
    assert {min(map(min, named)), max(map(max, named))} == {first, last}
    assert edges_of(output) == [pair for pair in edges_of(path) if pair not in left]
    record = read_graph_file(output)
    kept = [pair not in left for pair in edges_of(path)]
    residual = whitened_residual(record.graph, record.poses).reshape(-1, 3)[kept]
    cost = l1_cost(residual) if norm == 'l1' else (residual**2).sum()
    assert cost == pytest.approx(report['final_cost'], rel=1e-9)
    assert picture.exists()


def test_a_doubt_is_said_even_quietly_with_the_times_of_a_bag_and_beside_its_damage(
        capsys, torn, tmp_path):
    bag, cut = tmp_path / 'bag', tmp_path / 'cut.mcap'
    run(capsys, 'convert', torn[0], bag)
    cut.write_bytes((bag / 'bag.mcap').read_bytes()[:-20])
    for path, damages in (bag, 0), (cut, 1):
        out, err = run(capsys, 'solve', path, '--quiet', code=4)
        *damage, doubt = err.splitlines()
        said = DOUBT.fullmatch(doubt.removeprefix('l1slam: '))
        first, last = int(said[2]), int(said[3])
        assert out == '' and said[4] == (
            f' ({1000 + first / 10:.9f} s to {1000 + last / 10:.9f} s)')
        assert len(damage) == damages and all('is damaged' in sentence for sentence in damage)


@pytest.mark.parametrize(('poses', 'true', 'lies', 'code'), [
    (150, 101, 150, 0), (150, 101, 1800, 0), (600, 5, 100, 4)])
def test_a_weak_map_is_doubtful_and_one_with_most_loops_refused_is_not(
        capsys, tmp_path, poses, true, lies, code):
    """Of maps that most loops are refused of, those that the others hold were right."""
    world, bad = tmp_path / 'world.g2o', tmp_path / 'bad.g2o'
    run(capsys, 'simulate', world, '--poses', poses, '--edges', poses - 1 + true)
    run(capsys, 'corrupt', world, bad, '--false-loops', lies)
    out, err = run(capsys, 'solve', bad, '--json', code=code)
    report = json.loads(out)
    loops = [pair for pair in report['rejected'] if pair not in report['slips']]
    loops += report['suspect']
    assert len(loops) >= lies and (report['confidence'] >= 0.9) == (code == 0)
    if code == 0:
        assert report['status'] == 'converged' and not report['doubts']
        return
    assert [doubt['kind'] for doubt in report['doubts']] == ['a weak map']
    assert sorted(report['doubts'][0]['loops']) == sorted(loops)
    assert err.startswith('l1slam: doubtful: the map may well be ')
    assert f' {len(loops):,} are left out, ' in err
    assert len(err.splitlines()) == 1


GAP = 'no edge between the consecutive vertices 1 and 2, so no chain of odometry'


@pytest.mark.parametrize('start', ['seed', 'file'])
def test_where_the_odometry_is_full_of_gaps_nothing_is_there_to_judge_by(capsys, tmp_path, start):
    path = graph_file(tmp_path, [*VERTICES, 'VERTEX_SE2 3 3 0 0', EDGES[0], AFTER_GAP, EDGES[2]])
    asked = ['solve', path, '--start', start, '--json', '--output', tmp_path / 'out.g2o']
    out, err = run(capsys, *asked, '--robust', code=4)
    report = json.loads(out)
    assert report['parts'] == 2 and report['status'] == 'doubtful'
    assert 'no accepted loop joins 2 parts of the map, between' in err
    assert report['suspect'] == [[0, 2]] and not report['rejected']
    out, err = run(capsys, *asked)
    warning = f'no loop was doubted: {GAP} to judge loops by'
    assert err == f'l1slam: {warning}\n' and json.loads(out)['warnings'] == [warning]
    assert run(capsys, *asked, '--quiet', '--no-robust')[1] == ''


def test_a_graph_too_dense_to_judge_is_solved_as_far_as_it_was_judged(
        capsys, world, monkeypatch):
    """With memory for few blocks: the odometry alone can be factored, all loops cannot."""
    monkeypatch.setattr(block_cholesky, 'most_blocks', lambda graph: 700)
    for robust in ((), ('--robust',)):
        report = json.loads(run(capsys, 'solve', world, '--json', *robust, code=4)[0])
        assert report['status'] == 'doubtful' and report['suspect'] and not report['rejected']
        (warning,) = report['warnings']
        assert re.match(
            r'doubtful: judging the loops failed \(factorising [0-9]+ keyframes and [0-9]+ '
            r'factors takes [0-9.e-]+ GB of memory or more, and [0-9.]+ GB are free\): the map is '
            rf'made of what was accepted until then, and {len(report["suspect"])} loops between '
            r'[0-9]+ and [0-9]+ are left out\. ', warning)
    report = solve_json(capsys, world, '--no-robust')
    assert report['solver'] == 'primal-dual' and report['warnings'] == []


def test_what_a_long_solve_takes_is_said_before_it(capsys, world, monkeypatch):
    monkeypatch.setattr(solving, '_LONG', 0.0)
    said = run(capsys, 'solve', world, '--no-robust')[1].splitlines()
    assert len(said) == 1 and re.fullmatch(
        r'l1slam: interior-point: predicted to take some [0-9]+ s and [0-9.]+ GB, of which '
        r'[0-9.]+ GB are free', said[0])
    assert run(capsys, 'solve', world, '--no-robust', '--quiet')[1] == ''


def test_absolute_poses_are_no_loops_but_doubted_too(capsys, world):
    absolute = [f'EDGE_PRIOR_SE2 {k} {999 * (k == 9)} 0 0 1 0 0 1 0 1' for k in (9, 10)]
    world.write_text(world.read_text() + '\n'.join(absolute) + '\n')
    report = solve_json(capsys, world)
    assert (report['factors'], report['loops']) == (252, 101)
    out = run(capsys, 'solve', world)[0]
    assert '252 factors, 101 loops and 2 absolute poses\n' in out
    assert f'{len(report["rejected"])} of 101 loops and 2 absolute poses refused\n' in out


def test_a_graph_without_loops_is_its_odometry(capsys, tmp_path):
    report = solve_json(capsys, graph_file(tmp_path, EDGES[:2]))
    assert report['status'] == 'converged' and report['final_cost'] < 1e-6
    assert report['warnings'] == report['rejected'] == report['suspect'] == []
    lines = run(capsys, 'solve', tmp_path / 'graph.g2o')[0].splitlines()
    assert all(lines) and 'refused' not in ''.join(lines)


def test_a_parameter_file_may_say_that_all_loops_are_believed(capsys, tmp_path, lies):
    params = tmp_path / 'params.yaml'
    params.write_text('/**: {ros__parameters: {robust: {enabled: false}}}')
    asked = (lies, '--norm', 'l2', '--params-file', params)
    assert solve_json(capsys, *asked)['rejected'] == []
    assert len(solve_json(capsys, *asked, '--robust')['rejected']) == 100


@pytest.mark.parametrize('start', ['seed', 'file', 'odometry'])
@pytest.mark.parametrize('norm', ['l1', 'l2', 'huber'])
def test_every_start_leads_every_norm_to_one_cost(capsys, world, start, norm):
    report = solve_json(capsys, world, '--no-robust', '--start', start, '--norm', norm)
    best = solve_json(capsys, world, '--norm', norm)
    assert report['final_cost'] == pytest.approx(best['final_cost'], rel=1e-3)
    assert (report['seed_cost'] is None) == (start != 'seed')


def copied_bag(bag, copy, names=None, note=NOTE):
    """Copy a bag into an sqlite one by rosbags' own reader and writer."""
    recording = [((names or {}).get(topic, topic), *rest) for topic, *rest in recording_of(bag)]
    return rosbag2_directory(copy, recording, StoragePlugin.SQLITE3, note=note)


def as_toro(line):
    """Return a line of g2o as TORO has it: it orders the information otherwise."""
    tag, *fields = line.split()
    if tag == 'EDGE_SE2':
        xx, xy, xt, yy, yt, tt = fields[5:]
        fields[5:] = xx, xy, yy, tt, xt, yt
    return ' '.join([tag.replace('_SE2', '2'), *fields])


@pytest.fixture
def doors(capsys, world, tmp_path):
    """One graph in every form that a user may have it in."""
    toro = tmp_path / 'a.graph'
    toro.write_text('\n'.join(map(as_toro, world.read_text().splitlines())))
    run(capsys, 'convert', world, tmp_path / 'bag')
    run(capsys, 'convert', tmp_path / 'bag', tmp_path / 'back.g2o')
    sqlite = copied_bag(tmp_path / 'bag', tmp_path / 'sqlite')
    return [world, toro, tmp_path / 'bag', tmp_path / 'bag' / 'bag.mcap',
            tmp_path / 'back.g2o', sqlite, sqlite / 'sqlite.db3']


@pytest.mark.parametrize('norm', ['l1', 'l2', 'huber'])
def test_every_door_leads_to_the_same_costs_and_poses(capsys, doors, tmp_path, norm):
    costs, poses = [], []
    for door in doors:
        report = solve_json(capsys, door, '--no-robust', '--start', 'odometry', '--norm', norm,
                            '--output', tmp_path / 'out.tum')
        costs.append(report['initial_cost'])
        poses.append(np.loadtxt(tmp_path / 'out.tum'))
    assert np.ptp(costs) <= 1e-9 * costs[0] and costs[0] > 100
    assert np.linalg.norm(poses[0][:, 1:3] - np.loadtxt(f'{doors[0]}.truth.txt')[:, 1:3]) > 0.1
    assert np.ptp(poses, axis=0).max() < 1e-6


def test_a_bag_without_our_note_goes_by_the_parameters(capsys, world, tmp_path):
    run(capsys, 'convert', world, tmp_path / 'bag')
    plain = copied_bag(tmp_path / 'bag', tmp_path / 'plain', note=None)
    params = tmp_path / 'params.yaml'
    params.write_text('/**: {ros__parameters: {odometry: {covariance_source: increment}, '
                      'keyframe: {translation: 0.0, rotation: 0.0, period: 0.0}}}')
    expected = solve_json(capsys, world, '--norm', 'l2')['final_cost']
    by_defaults = solve_json(capsys, plain, '--norm', 'l2')['final_cost']
    told = solve_json(capsys, plain, '--norm', 'l2', '--params-file', params)['final_cost']
    assert told == pytest.approx(expected, rel=1e-6)
    assert by_defaults != pytest.approx(expected, rel=0.01)
    # So do the other commands that read bags.
    run(capsys, 'convert', plain, tmp_path / 'told.g2o', '--params-file', params)
    assert solve_json(capsys, tmp_path / 'told.g2o', '--norm', 'l2')[
        'final_cost'] == pytest.approx(expected, rel=1e-6)


def test_other_topics(capsys, world, tmp_path):
    run(capsys, 'convert', world, tmp_path / 'bag')
    other = copied_bag(tmp_path / 'bag', tmp_path / 'other', {
        '/odom': '/wheels/odom', '/loop_closures': '/places'})
    out, err = run(capsys, 'info', other, code=2)
    assert '/wheels/odom: 150 of nav_msgs/msg/Odometry' in out
    assert err.startswith('l1slam: ') and err.count('\n') == 1 and '/wheels/odom' in err
    topics = ('--odom-topic', '/wheels/odom', '--loop-topic', '/places')
    assert solve_json(capsys, other, *topics)['loops'] == 101
    run(capsys, 'plot', other, *topics, '--output', tmp_path / 'map.png')


def test_a_cut_bag_is_read_in_part_and_exits_with_3(capsys, world, tmp_path):
    run(capsys, 'convert', world, tmp_path / 'bag')
    whole = (tmp_path / 'bag' / 'bag.mcap').read_bytes()
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(whole[:len(whole) // 2])
    for arguments in (['solve', cut, '--quiet', '--output', tmp_path / 'out.g2o'], ['info', cut],
                      ['convert', cut, tmp_path / 'out.g2o'],
                      ['corrupt', cut, tmp_path / 'bad.g2o', '--false-loops', 1],
                      ['plot', cut, world, '--output', tmp_path / 'map.png']):
        out, err = run(capsys, *arguments, code=3)
        assert err.startswith(f'l1slam: {cut}') and err.count('\n') == 1 and 'damaged' in err
        assert 'nothing looks wrong' not in out
    assert read_graph_file(tmp_path / 'out.g2o').graph.n_poses > 20
    cut.write_bytes(whole[:100])
    out, err = run(capsys, 'solve', cut, '--json', code=2)
    assert out == '' and err.startswith(f'l1slam: {cut}') and err.count('\n') == 1


@pytest.mark.parametrize('name', ['A.G2O', 'A.MCAP'])
def test_a_suffix_may_be_in_capitals(capsys, world, tmp_path, name):
    run(capsys, 'convert', world, tmp_path / 'bag')
    if name == 'A.MCAP':
        (tmp_path / 'bag' / 'bag.mcap').rename(tmp_path / name)
    else:
        run(capsys, 'convert', world, tmp_path / name)
    run(capsys, 'convert', tmp_path / name, tmp_path / 'B.TUM')
    found, expected = (np.sort(read_input(path).graph.between.measurement, axis=0)
                       for path in (tmp_path / name, world))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.loadtxt(tmp_path / 'B.TUM').shape == (150, 8)


def test_a_trajectory_goes_out_as_tum_and_in_as_reference_with_stamps_that_others_round(
        capsys, world, tmp_path):
    output = tmp_path / 'out.tum'
    run(capsys, 'solve', world, '--output', output, '--quiet')
    lines = [line.split() for line in output.read_text().splitlines()[1:]]
    assert len(lines) == 150
    for shift in 0, 2e-7:
        output.write_text('\n'.join(' '.join([f'{float(stamp) + shift:.6f}', *rest])
                                    for stamp, *rest in lines))
        ate = solve_json(capsys, world, '--reference', output)['ate']
        assert ate == pytest.approx(0, abs=1e-5 if shift else 1e-8)


def test_simulate_writes_truth_and_false_loops(capsys, tmp_path):
    output = tmp_path / 'bag'
    run(capsys, 'simulate', output, '--poses', 200, '--edges', 300, '--false-loops', 5)
    pairs = np.loadtxt(f'{output}.false.txt', dtype=int)
    assert pairs.shape == (5, 2) and (pairs[:, 1] > pairs[:, 0] + 1).all()
    assert len(np.loadtxt(f'{output}.truth.txt')) == 200
    assert 'loops       106' in run(capsys, 'info', output)[0]


def test_info_of_a_good_graph_and_of_its_bag(capsys, world, tmp_path):
    out, err = run(capsys, 'info', world)
    assert out.endswith('\nnothing looks wrong\n') and err == ''
    run(capsys, 'convert', world, tmp_path / 'bag')
    out, _ = run(capsys, 'info', tmp_path / 'bag')
    for row in ('duration    14.9 s from 1000.000000000',
                'note        covariance increment, keyframes every',
                'topic       /loop_closures: 101 of geometry_msgs/msg/PoseWithCovarianceStamped',
                'topic       /odom: 150 of nav_msgs/msg/Odometry', 'poses       150 in SE2',
                'time        14.9 s', 'nothing looks wrong'):
        assert f'\n{row}' in f'\n{out}', out


def test_info_says_what_was_skipped(capsys, tmp_path):
    out, err = run(capsys, 'info', graph_file(tmp_path, [*VERTICES, *EDGES, 'VERTEX_XY 9 1 2']))
    assert "- 1 line not used: 1 'VERTEX_XY' (landmarks" in out and err == ''


def words(path):
    """The texts of an SVG: matplotlib draws them as outlines and notes them in comments."""
    return re.findall(r'<!-- (.*?) -->', path.read_text())


def test_plot_draws_several_maps_with_false_loops_where_they_are_known(capsys, world, tmp_path):
    run(capsys, 'corrupt', world, tmp_path / 'bad.g2o', '--false-loops', 12)
    run(capsys, 'plot', world, world, tmp_path / 'bad.g2o', '--output', tmp_path / 'maps.svg')
    said = words(tmp_path / 'maps.svg')
    assert said.count('world.g2o') == said.count('truth') == 2 and said.count('odometry') == 3
    assert said.count('false loops') == 1 and said.count('bad.g2o') == 1
    assert '150 poses, 101 loops' in said and '150 poses, 113 loops (12 false)' in said


@pytest.mark.parametrize('command, output', [('plot', '--output'), ('solve', '--plot')])
@pytest.mark.parametrize('line, words', [
    ('3 5', 'no edge between 3 and 5'), ('3 999', 'no edge between 3 and 999'),
    ('3', '1 field; expected 2 whole numbers'), ('3 x', "'x' is not a whole number")])
def test_a_file_of_other_false_loops_is_refused(capsys, tmp_path, line, words, command, output):
    """Before the work, at whose end it would be too late: this graph cannot be solved."""
    path = graph_file(tmp_path, [*VERTICES, 'VERTEX_SE2 9 0 0 0', *EDGES])
    (tmp_path / 'graph.g2o.false.txt').write_text(f'0 2\n{line}\n')
    err = run(capsys, command, path, output, tmp_path / 'map.png', code=2)[1]
    assert err.startswith(f'l1slam: {path}.false.txt') and words in err and err.count('\n') == 1


@pytest.fixture
def odd(world, tmp_path):
    """The world with stamps and with ids 10, 13, 16, ..."""
    path = tmp_path / 'odd.g2o'
    path.write_text('\n'.join(renumbered(world)) + '\n')
    Path(f'{path}.stamps.txt').write_text(
        ''.join(f'{10 + 3 * k} {5 + k}.25\n' for k in range(150)))
    return path


def corrupted(capsys, path, output, *options):
    """Corrupt; return the record, which of its factors are false, and the pairs of the file."""
    run(capsys, 'corrupt', path, output, *options)
    pairs = np.loadtxt(f'{output}.false.txt', dtype=int, ndmin=2)
    record = read_graph_file(output)
    factors = record.graph.between
    ids = np.stack((record.ids[factors.i], record.ids[factors.j]), axis=1)
    false = (ids[:, None] == pairs).all(axis=2).any(axis=1)
    assert false.sum() == len(pairs)
    return record, false, pairs


@pytest.mark.parametrize('kind', ['random', 'identity', 'grouped'])
def test_corrupt_adds_loops_and_keeps_the_rest(capsys, odd, tmp_path, kind):
    before = read_graph_file(odd)
    after, false, pairs = corrupted(capsys, odd, tmp_path / 'bad.g2o', '--false-loops', 40,
                                    '--kind', kind, '--seed', 3)
    assert len(pairs) == 40 and set(pairs.ravel() % 3) == {1}
    np.testing.assert_array_equal(after.poses, before.poses)
    np.testing.assert_array_equal(after.ids, before.ids)
    np.testing.assert_array_equal(after.stamps, before.stamps)
    np.testing.assert_array_equal(after.graph.between.measurement[~false],
                                  before.graph.between.measurement)
    claimed = np.linalg.norm(after.graph.between.measurement[false][:, :2], axis=1)
    assert claimed.max() < {'random': 2, 'identity': 1e-9, 'grouped': 40}[kind]
    assert solve_json(capsys, tmp_path / 'bad.g2o')['loops'] == 141


def test_another_seed_draws_other_loops_and_the_same_one_the_same(capsys, world, tmp_path):
    drawn = [corrupted(capsys, world, tmp_path / f'{k}.g2o', '--false-loops', 10, '--seed', seed)
             [2].tolist() for k, seed in enumerate((1, 1, 2))]
    assert drawn[0] == drawn[1] != drawn[2]


def test_false_loops_are_told_by_the_solved_map_not_by_a_drifted_start(capsys, world, tmp_path):
    """The stored start is wound up like a spring: by it, the same place is far from itself."""
    path = tmp_path / 'drift.g2o'
    record = read_graph_file(world)
    steps = record.graph.between.measurement[record.graph.between.is_odometry]
    poses = [np.zeros(3)]
    for step in steps + [0, 0, 0.2]:
        poses.append(se2.compose(poses[-1], step))
    lines = [f'VERTEX_SE2 {k} {x} {y} {theta}' for k, (x, y, theta) in enumerate(poses)]
    edges = [line for line in world.read_text().splitlines() if line.startswith('EDGE')]
    path.write_text('\n'.join(lines + edges))
    _, _, pairs = corrupted(capsys, path, tmp_path / 'bad.g2o', '--false-loops', 200)
    truth = np.loadtxt(f'{world}.truth.txt')[:, 1:3]
    distance = np.linalg.norm(truth[pairs[:, 0]] - truth[pairs[:, 1]], axis=1)
    assert distance.min() > 0.1 * np.linalg.norm(np.ptp(truth, axis=0)) - 0.3


def test_corrupting_twice_names_the_false_loops_of_both(capsys, world, tmp_path):
    _, _, first = corrupted(capsys, world, tmp_path / 'a.g2o', '--false-loops', 10)
    _, _, both = corrupted(capsys, tmp_path / 'a.g2o', tmp_path / 'b.g2o', '--false-loops', 20,
                           '--kind', 'grouped')
    assert len(both) == 30 and both[:10].tolist() == first.tolist()


def test_corrupting_to_a_bag_counts_as_the_bag_does(capsys, odd, tmp_path):
    run(capsys, 'corrupt', odd, tmp_path / 'bad', '--false-loops', 7)
    pairs = np.loadtxt(tmp_path / 'bad.false.txt', dtype=int)
    assert pairs.shape == (7, 2) and pairs.max() < 150
    run(capsys, 'plot', tmp_path / 'bad', '--output', tmp_path / 'map.svg')
    assert '150 poses, 108 loops (7 false)' in words(tmp_path / 'map.svg')


def test_a_graph_that_cannot_be_written_leaves_no_file_of_false_loops(capsys, world, tmp_path):
    # Its odometry has a gap, for which there is no place in a bag.
    path = tmp_path / 'gap.g2o'
    path.write_text(world.read_text().replace('EDGE_SE2 0 1 ', 'EDGE_SE2 0 2 ', 1))
    there = sorted(tmp_path.iterdir())
    err = run(capsys, 'corrupt', path, tmp_path / 'bad', '--false-loops', 3, code=2)[1]
    assert sorted(tmp_path.iterdir()) == there and err.count('\n') == 1


def test_a_parameter_file_speaks_to_both_growth_and_solver(capsys, world, tmp_path):
    run(capsys, 'convert', world, tmp_path / 'bag')
    params = tmp_path / 'params.yaml'
    params.write_text('/**: {ros__parameters: {keyframe: {translation: 5.0, rotation: 0.0}, '
                      'solver: {outer_iterations: 2}}}')
    report = solve_json(capsys, tmp_path / 'bag', '--params-file', params)
    assert report['poses'] < 60 and report['outer_iterations'] == 2
    # What it leaves as it is, the bag says of itself.
    params.write_text('/**: {ros__parameters: {keyframe: {translation: 0.5}, solver: {norm: l2}}}')
    said = solve_json(capsys, tmp_path / 'bag', '--params-file', params)['final_cost']
    assert said == pytest.approx(solve_json(capsys, world, '--norm', 'l2')['final_cost'], rel=1e-6)


@pytest.mark.parametrize('arguments, words', [
    (['solve', 'missing.g2o'], 'no such file'),
    (['solve', 'graph.txt'], 'unknown kind'),
    (['solve', 'graph.g2o', '--start', 'file'], 'no poses'),
    (['solve', 'graph.g2o', '--inner', '0'], 'iterations'),
    (['solve', 'nan.g2o', '--output', 'out.g2o'], "nan.g2o:2: EDGE_SE2: 'nan' is not a finite"),
    (['solve', 'lonely.g2o', '--output', 'out.g2o'], 'lonely.g2o: the graph is not connected'),
    (['solve', 'graph.g2o', '--output', 'out.doc'], 'suffix'),
    (['solve', 'graph.g2o', '--output', 'missing/out.g2o'], 'missing is no folder'),
    (['solve', 'graph.g2o', '--output', 'taken.g2o', '--plot', 'a.png'], 'it is a directory'),
    (['solve', 'graph.g2o', '--plot', 'missing/out.png'], 'missing is no folder'),
    (['solve', 'gap.g2o', '--start', 'odometry'], 'consecutive vertices 1 and 2'),
    (['solve', 'graph.g2o', '--output', 'other'], 'other: was not written by l1slam'),
    (['simulate', 'other', '--poses', '10', '--edges', '12'],
     'other: was not written by l1slam'),
    (['convert', 'graph.g2o', 'out.doc'], 'suffix'),
    (['corrupt', 'graph.g2o', 'out.tum', '--false-loops', '1'], 'trajectory'),
    (['corrupt', 'graph.g2o', 'out.g2o', '--false-loops', '-1'], '--false-loops is -1'),
    (['corrupt', 'graph.g2o', 'out.g2o', '--false-loops', '1000000000'], '3 pairs among 3'),
    (['corrupt', 'missing.g2o', 'out.g2o', '--false-loops', '1'], 'no such file'),
    (['plot', 'graph.g2o', '--output', 'map.doc'], '.png'),
    (['plot', 'graph.g2o', 'missing.g2o', '--output', 'map.png'], 'missing.g2o'),
    (['info', 'missing.g2o'], 'no such file'),
    (['simulate', 'out.tum', '--poses', '10', '--edges', '12'], 'trajectory'),
    (['solve', 'graph.g2o', '--plot', 'out.doc'], '.png'),
    (['solve', 'graph.g2o', '--reference', 'missing.txt'], 'missing.txt'),
    (['solve', 'graph.g2o', '--params-file', 'graph.txt'], 'parameters'),
    (['solve', 'graph.g2o', '--params-file', 'other'], 'other: cannot be read: Is a directory'),
    (['solve', 'graph.g2o', '--plot', 'taken.png'], 'taken.png: cannot be written: it is a di'),
    (['solve', 'missing.g2o', '--output', '/proc/out.g2o'], '/proc/out.g2o: cannot be written'),
    (['solve', 'missing.g2o', '--plot', '/proc/out.png'], '/proc/out.png: cannot be written'),
    (['simulate', '/proc/a.g2o', '--poses', '1', '--edges', '5'], '/proc/a.g2o: cannot be wri'),
    (['simulate', 'out.g2o', '--poses', '10', '--edges', '5'], '9 to 45'),
    (['simulate', 'out.g2o', '--poses', '10', '--edges', '12', '--scans'], 'holds no scans'),
    (['simulate', 'out', '--poses', '10', '--edges', '12', '--scans', '--world', 'torus'],
     '--scans in the world torus'),
    (['simulate', 'out.g2o', '--poses', '10', '--edges', '20', '--seed', '-1'], 'seed'),
])
def test_bad_arguments_are_one_line_and_exit_code_2(
        capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'graph.g2o').write_text('\n'.join(EDGES))
    (tmp_path / 'graph.txt').write_text('{}')
    for name in ('other', 'taken.g2o', 'taken.png'):
        (tmp_path / name).mkdir()
    (tmp_path / 'gap.g2o').write_text('\n'.join([EDGES[0], AFTER_GAP, EDGES[2]]))
    (tmp_path / 'nan.g2o').write_text('\n'.join(EDGES).replace(' 1 2 1 ', ' 1 2 nan '))
    (tmp_path / 'lonely.g2o').write_text('\n'.join([*VERTICES, 'VERTEX_SE2 9 0 0 0', *EDGES]))
    there = sorted(tmp_path.iterdir())
    err = run(capsys, *arguments, code=2)[1]
    assert err.count('\n') == 1 and words in err, err
    assert sorted(tmp_path.iterdir()) == there


def test_a_graph_with_gaps_and_without_poses_is_solved_from_its_tree(capsys, tmp_path):
    path = graph_file(tmp_path, [EDGES[0], 'EDGE_SE2 1 5 1.1 0 0 1 0 0 1 0 1',
                                 'EDGE_SE2 1 7 2.2 0 0 100 0 0 100 0 100',
                                 'EDGE_SE2 0 7 3 0 0 1 0 0 1 0 1'])
    report = solve_json(capsys, path, '--no-robust')
    assert report['final_cost'] < report['initial_cost']
    run(capsys, 'convert', path, tmp_path / 'out.g2o')
    assert read_graph_file(tmp_path / 'out.g2o').poses.shape == (4, 3)


def test_a_graph_in_parts_without_poses_is_converted_all_the_same(capsys, tmp_path):
    path = graph_file(tmp_path, [*EDGES, EDGES[0].replace(' 0 1 ', ' 7 9 ', 1)])
    run(capsys, 'convert', path, tmp_path / 'out.g2o')
    record = read_graph_file(tmp_path / 'out.g2o')
    assert record.poses is None and record.ids.tolist() == [0, 1, 2, 7, 9]


COMMANDS = ['simulate', 'convert', 'solve', 'corrupt', 'info', 'plot']


def help_of(capsys, *arguments):
    with pytest.raises(SystemExit) as ended:
        main([*arguments, '--help'])
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_the_examples_of_the_help_work(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(capsys, 'simulate', 'graph.g2o', '--poses', 100, '--edges', 180)
    for command in COMMANDS:
        example = re.search(r'example:\n  l1slam (.*)', help_of(capsys, command))[1]
        assert example.startswith(f'{command} ')
        run(capsys, *shlex.split(example))
    for example in re.findall(r'\n  l1slam (.*)', help_of(capsys)):
        run(capsys, *shlex.split(example))
    written = {p.name for p in tmp_path.iterdir()}
    assert {'world.g2o', 'bag', 'solved.g2o', 'map.png', 'spoiled.g2o', 'maps.png'} <= written


def test_without_a_command_there_is_help(capsys):
    out, err = run(capsys, code=2)
    assert out == '' and all(f'    {command} ' in err for command in COMMANDS)
