# SPDX-License-Identifier: Apache-2.0
"""`l1slam`: what it prints, writes and answers to bad input."""

import json

import numpy as np
import pytest

from l1slam_ros.cli import main
from l1slam_ros.core.linearise import whitened_residual
from l1slam_ros.core.optimality import l1_cost
from l1slam_ros.io.graph_file import read_graph_file

VERTICES = ['VERTEX_SE2 0 0 0 0', 'VERTEX_SE2 1 1 0 0', 'VERTEX_SE2 2 2 0 0']
EDGES = ['EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1', 'EDGE_SE2 1 2 1 0 0 1 0 0 1 0 1',
         'EDGE_SE2 0 2 2.1 0 0 1 0 0 1 0 1']


def graph_file(folder, lines):
    path = folder / 'graph.g2o'
    path.write_text('\n'.join(lines) + '\n')
    return path


@pytest.fixture
def world(tmp_path):
    path = tmp_path / 'world.g2o'
    assert main(['simulate', str(path), '--poses', '150', '--edges', '250', '--seed', '7']) == 0
    return path


def run(capsys, *arguments):
    """Run a command that must succeed; return its standard output and error."""
    code = main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    assert code == 0, err
    return out, err


def solve_json(capsys, *arguments):
    return json.loads(run(capsys, 'solve', *arguments, '--json')[0])


def test_solve_reports_what_it_wrote(capsys, world, tmp_path):
    output, picture = tmp_path / 'out.g2o', tmp_path / 'map.png'
    report = solve_json(capsys, world, '--output', output, '--plot', picture,
                        '--reference', f'{world}.truth.txt')
    record = read_graph_file(output)
    recomputed = l1_cost(whitened_residual(record.graph, record.poses))
    assert recomputed == pytest.approx(report['final_cost'], rel=1e-12)
    assert report['final_cost'] < report['seed_cost'] < report['initial_cost']
    assert (report['poses'], report['factors'], report['loops']) == (150, 250, 101)
    assert report['rejected'] == [] and report['solver'] == 'primal-dual'
    assert report['status'] in ('converged', 'iteration_limit', 'stalled')
    assert 0 < report['ate'] < 0.3
    assert picture.read_bytes().startswith(b'\x89PNG')


def test_ate_of_the_odometry_is_that_of_zero_steps(capsys, world):
    truth = f'{world}.truth.txt'
    odometry = solve_json(capsys, world, '--start', 'odometry', '--outer', 0, '--reference', truth)
    assert odometry['outer_iterations'] == 0
    assert odometry['final_cost'] == odometry['initial_cost']
    assert odometry['ate'] > 3 * solve_json(capsys, world, '--reference', truth)['ate']


@pytest.mark.parametrize('start', ['seed', 'file', 'odometry'])
@pytest.mark.parametrize('norm', ['l1', 'l2', 'huber'])
def test_every_start_leads_every_norm_to_one_cost(capsys, world, start, norm):
    report = solve_json(capsys, world, '--start', start, '--norm', norm)
    best = solve_json(capsys, world, '--norm', norm)
    assert report['final_cost'] == pytest.approx(best['final_cost'], rel=1e-3)
    assert (report['seed_cost'] is None) == (start != 'seed')


def test_without_json_there_is_a_summary_and_with_quiet_nothing(capsys, world):
    out, err = run(capsys, 'solve', world)
    assert '150 poses, 250 factors, 101 loops' in out and 'final' in out and err == ''
    assert run(capsys, 'solve', world, '--quiet') == ('', '')


def test_graph_to_bag_to_graph_is_one_graph(capsys, world, tmp_path):
    run(capsys, 'convert', world, tmp_path / 'bag')
    run(capsys, 'convert', tmp_path / 'bag', tmp_path / 'back.g2o')
    costs = [solve_json(capsys, path, '--start', 'odometry', '--outer', 0)['initial_cost']
             for path in (world, tmp_path / 'bag', tmp_path / 'back.g2o')]
    assert np.ptp(costs) <= 1e-9 * costs[0]


def test_intel_as_a_bag_is_the_same_graph(capsys, datasets, tmp_path):
    run(capsys, 'convert', datasets / 'intel.g2o', tmp_path / 'bag')
    costs = [solve_json(capsys, path, '--start', 'odometry', '--outer', 0)['initial_cost']
             for path in (datasets / 'intel.g2o', tmp_path / 'bag')]
    assert costs[0] == pytest.approx(16108.59, abs=0.005)
    assert costs[1] == pytest.approx(costs[0], abs=1e-6)


def test_a_trajectory_goes_out_as_tum_and_in_as_reference(capsys, world, tmp_path):
    output = tmp_path / 'out.tum'
    report = solve_json(capsys, world, '--output', output, '--reference', f'{world}.truth.txt')
    assert len(output.read_text().splitlines()) == 150
    assert report['ate'] > 0
    assert solve_json(capsys, world, '--reference', output)['ate'] == pytest.approx(0, abs=1e-8)


def test_stamps_rounded_to_microseconds_still_match(capsys, world, tmp_path):
    output = tmp_path / 'out.tum'
    run(capsys, 'solve', world, '--output', output, '--quiet')
    lines = [line.split() for line in output.read_text().splitlines()]
    output.write_text('\n'.join(' '.join([f'{float(stamp) + 2e-7:.6f}', *rest])
                                for stamp, *rest in lines))
    assert solve_json(capsys, world, '--reference', output)['ate'] == pytest.approx(0, abs=1e-8)


def test_simulate_writes_truth_and_false_loops(capsys, tmp_path):
    output = tmp_path / 'bag'
    run(capsys, 'simulate', output, '--poses', 200, '--edges', 300, '--false-loops', 5)
    pairs = np.loadtxt(f'{output}.false.txt', dtype=int)
    assert pairs.shape == (5, 2) and (pairs[:, 1] > pairs[:, 0] + 1).all()
    assert len(np.loadtxt(f'{output}.truth.txt')) == 200
    assert 'loops       106' in run(capsys, 'info', output)[0]


def test_info_counts_components(capsys, tmp_path):
    lines = [*VERTICES, 'VERTEX_SE2 7 0 0 0', 'VERTEX_SE2 8 0 0 0', *EDGES,
             'EDGE_SE2 7 8 1 0 0 1 0 0 1 0 1']
    out, _ = run(capsys, 'info', graph_file(tmp_path, lines))
    assert 'poses       5' in out and 'components  2' in out and 'odometry    3' in out


def test_plot_draws_several_maps(capsys, world, tmp_path):
    run(capsys, 'plot', world, world, '--output', tmp_path / 'maps.svg')
    assert (tmp_path / 'maps.svg').read_text().count('odometry') >= 1


def test_a_parameter_file_speaks_to_both_growth_and_solver(capsys, world, tmp_path):
    run(capsys, 'convert', world, tmp_path / 'bag')
    params = tmp_path / 'params.yaml'
    params.write_text('/**: {ros__parameters: {keyframe: {translation: 5.0, rotation: 0.0}, '
                      'solver: {outer_iterations: 2}}}')
    report = solve_json(capsys, tmp_path / 'bag', '--params-file', params)
    assert report['poses'] < 60 and report['outer_iterations'] == 2


@pytest.mark.parametrize('lines, line, words', [
    ([*VERTICES, 'EDGE_SE2 0 1 nan 0 0 1 0 0 1 0 1'], 4, 'nan'),
    ([*VERTICES, *EDGES[:2], 'EDGE_SE2 0 2 2 0 0 1 2 0 1 0 1'], 6, 'positive definite'),
    ([*VERTICES, *EDGES, 'EDGE_SE2 0 9 1 0 0 1 0 0 1 0 1'], 7, '9'),
    ([*VERTICES, *EDGES, 'EDGE_SE2 1 1 1 0 0 1 0 0 1 0 1'], 7, 'itself'),
    ([*VERTICES, 'VERTEX_SE2 1 0 0 0', *EDGES], 4, '1'),
    (VERTICES, None, 'edge'),
    ([*VERTICES, 'EDGE_SE2 0 1 1 0 0 1 0 0 1 0'], 4, 'expected'),
    (['once upon a time'], 1, 'once'),
    (['VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1'], 1, '3D'),
    ([*VERTICES, 'VERTEX_SE2 9 0 0 0', *EDGES], None, 'not connected'),
])
def test_bad_input_is_one_line_exit_code_2_and_no_output(capsys, tmp_path, lines, line, words):
    path, output = graph_file(tmp_path, lines), tmp_path / 'out.g2o'
    assert main(['solve', str(path), '--output', str(output)]) == 2
    out, err = capsys.readouterr()
    assert out == '' and err.count('\n') == 1 and err.startswith('l1slam: ')
    assert words.lower() in err.lower()
    if line is not None:
        assert f'{path}:{line}:' in err
    assert sorted(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize('arguments, words', [
    (['solve', 'missing.g2o'], 'no such file'),
    (['solve', 'graph.txt'], 'unknown kind'),
    (['solve', 'graph.g2o', '--start', 'file'], 'no poses'),
    (['solve', 'graph.g2o', '--inner', '0'], 'iterations'),
    (['solve', 'graph.g2o', '--output', 'out.doc'], 'suffix'),
    (['solve', 'graph.g2o', '--plot', 'out.doc'], '.png'),
    (['solve', 'graph.g2o', '--reference', 'missing.txt'], 'missing.txt'),
    (['solve', 'graph.g2o', '--params-file', 'graph.txt'], 'parameters'),
    (['simulate', 'out.g2o', '--poses', '10', '--edges', '5'], '9 to 45'),
    (['simulate', 'out.g2o', '--poses', '10', '--edges', '20', '--seed', '-1'], 'seed'),
])
def test_bad_arguments_are_one_line_and_exit_code_2(
        capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'graph.g2o').write_text('\n'.join(EDGES))
    (tmp_path / 'graph.txt').write_text('{}')
    assert main([*arguments]) == 2
    _, err = capsys.readouterr()
    assert err.count('\n') == 1 and words in err, err
    assert sorted(p.name for p in tmp_path.iterdir()) == ['graph.g2o', 'graph.txt']
