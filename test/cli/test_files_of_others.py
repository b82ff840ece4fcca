# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Files as other programs write them are read, or refused in one line that says what to do."""

import bz2
import gzip
import os

import pytest
from command import run, solve_json

import l1slam_ros as l1

IDENTITY = ' 1 0 0 1 0 1'
# A drive around a square, which ends where it began.
DRIVE = [f'VERTEX_SE2 {k} {x} {y} {k % 4 * 1.5708}' for k, (x, y) in enumerate(
    [(0, 0), (1, 0), (1, 1), (0, 1), (0, 0.1)])]
STEPS = [f'EDGE_SE2 {k} {k + 1} 1 0 1.5708' for k in range(4)]
LOOP = 'EDGE_SE2 0 4 0 0 0'
SQUARE = [*DRIVE, *(f'{edge}{IDENTITY}' for edge in (*STEPS, LOOP))]


def written(folder, lines, name='graph.g2o'):
    path = folder / name
    path.write_text('\n'.join(lines) + '\n')
    return path


def one_line(capsys, *arguments):
    """Return the only line that a refused command prints."""
    out, err = run(capsys, *arguments, code=2)
    assert out == '' and err.count('\n') == 1 and err.startswith('l1slam: '), err
    return err


def drive(count=40):
    """Return the lines of a drive there and back, in the order of its lines, without a tag."""
    ends = [(k, k + 1) for k in range(count - 1)] + [(0, count - 1), (1, count - 2)]
    steps = [1 if j <= count // 2 else -1 for _, j in ends[:-2]]
    return [f'{i} {j} {step if step else 0} 0.0{k % 3} 0' for k, ((i, j), step) in enumerate(zip(
        ends, [*steps, 1, 1], strict=True))]


@pytest.mark.parametrize('suffix', ['.graph', '.toro'])
def test_equivalent_vertices_of_toro_are_a_loop_that_is_vouched_for(capsys, tmp_path, suffix):
    lines = [line.replace('_SE2', '2').replace(IDENTITY, ' 1 0 1 1 0 0') for line in SQUARE]
    graph = written(tmp_path, [*lines, 'EQUIV 4 0'], f'graph{suffix}')
    solved = tmp_path / 'solved.g2o'
    report = solve_json(capsys, graph, '--output', solved)
    assert (report['poses'], report['factors'], report['loops']) == (5, 5, 1)
    assert report['warnings'][0] == (
        '1 EQUIV line: the loops between these vertices are vouched for')
    assert '0 4' in solved.with_name('solved.g2o.trusted.txt').read_text()


def test_equivalent_vertices_without_an_edge_have_one_pose(capsys, tmp_path):
    graph = written(tmp_path, [*SQUARE[:-1], 'EQUIV 4 0', 'EQUIV 4 0'])
    for option in '--robust', '--no-robust':
        solved = tmp_path / 'solved.g2o'
        report = solve_json(capsys, graph, option, '--output', solved)
        assert (report['loops'], report['parts'], report['status']) == (1, 1, 'converged')
        _, poses = l1.read_graph(solved)
        assert abs(poses[4, :2] - poses[0, :2]).max() < 1e-3
    assert report['warnings'][0].endswith('vouched for; 1 pair without an edge tied to each other')
    (tmp_path / 'graph.g2o.struck.txt').write_text('0 4\n')  # a person may say otherwise
    assert solve_json(capsys, written(tmp_path, [*SQUARE, 'EQUIV 0 4']))['rejected'] == [[0, 4]]
    written(tmp_path, [*SQUARE, 'EQUIV 4 7'])
    assert ':11: vertex 7 is unknown' in one_line(capsys, 'info', graph)


@pytest.mark.parametrize('name', ['a.g2o.gz', 'a.toro.gz', 'a.g2o.bz2', 'a.jrl.gz'])
def test_packed_graphs_are_read(capsys, tmp_path, name):
    plain = written(tmp_path, SQUARE)
    content = plain.read_bytes()
    if '.jrl' in name:
        run(capsys, 'convert', plain, tmp_path / 'plain.jrl')
        content = (tmp_path / 'plain.jrl').read_bytes()
    packed = tmp_path / name
    packed.write_bytes((bz2 if name.endswith('.bz2') else gzip).compress(content))
    reports = [solve_json(capsys, path, '--quiet', '--no-robust') for path in (packed, plain)]
    assert reports[0]['final_cost'] == pytest.approx(reports[1]['final_cost'], rel=1e-9)
    run(capsys, 'info', packed)


def test_a_packed_graph_that_is_cut_or_has_no_end_is_one_line(capsys, tmp_path):
    packed = tmp_path / 'a.g2o.gz'
    packed.write_bytes(gzip.compress('\n'.join(SQUARE).encode())[:-20])
    assert 'a.g2o.gz: cannot be unpacked: ' in one_line(capsys, 'info', packed)
    packed.write_bytes(b'EDGE_SE2 0 1')
    assert 'a.g2o.gz: cannot be unpacked: ' in one_line(capsys, 'info', packed)
    packed.write_bytes(gzip.compress(b'\n' * 2**27, 1))
    assert 'bytes that unpack to more than a graph' in one_line(capsys, 'info', packed)


def test_a_text_file_with_a_graph_is_one(capsys, tmp_path):
    out, _ = run(capsys, 'info', written(tmp_path, SQUARE, 'graph.txt'))
    assert 'poses       5 in SE2' in out
    said = one_line(capsys, 'solve', written(tmp_path, ['1.0 0 0 0 0 0 0 1'], 'tum.txt'))
    assert 'tum.txt: unknown kind of file; expected .g2o' in said


def test_edges_without_information_are_said_and_may_get_one(capsys, tmp_path):
    bare = written(tmp_path, [*DRIVE, *STEPS, f'{LOOP} 4 0 0 4 0 4'], 'bare.g2o')
    said = one_line(capsys, 'solve', bare)
    assert ('bare.g2o:6: EDGE_SE2: 5 fields, the information is missing; expected 2 whole and 9 '
            'finite numbers, or the option `--information X`') in said
    full = written(tmp_path, [*DRIVE, *(f'{step} 25 0 0 25 0 25' for step in STEPS),
                              f'{LOOP} 4 0 0 4 0 4'], 'full.g2o')
    given = '--information', '25'
    expected, found = (solve_json(capsys, path, *given, '--no-robust') for path in (full, bare))
    assert found['final_cost'] == expected['final_cost']
    run(capsys, 'info', bare, *given)
    run(capsys, 'convert', bare, tmp_path / 'made.g2o', *given)
    assert 'EDGE_SE2 0 1 1.0 0.0 1.5708 25.0 0.0' in (tmp_path / 'made.g2o').read_text()
    loops = written(tmp_path, ['EDGE_SE2 1:0 2:0 0 0 0'], 'between.txt')
    merge = 'merge', bare, full, '--loops', loops, '--output', tmp_path / 'both.g2o'
    assert 'the information is missing' in one_line(capsys, *merge)
    run(capsys, *merge, *given, '--no-robust')
    with pytest.raises(l1.L1SlamError, match='the information is missing'):
        l1.read_graph(bare)
    graph, _ = l1.read_graph(bare, information=25)
    assert graph.between.sqrt_information[:, 0, 0].tolist() == [5, 5, 5, 5, 2]


@pytest.mark.parametrize('value', ['0', '-1', 'nan', 'inf'])
def test_an_information_that_is_none_is_refused(capsys, tmp_path, value):
    with pytest.raises(SystemExit) as ended:
        run(capsys, 'info', written(tmp_path, SQUARE), f'--information={value}')
    assert ended.value.code == 2
    said = capsys.readouterr()[1]
    assert f"argument --information: '{value}'; expected a number above 0" in said
    with pytest.raises(l1.L1SlamError, match='^information is '):
        l1.read_graph(tmp_path / 'graph.g2o', information=float(value))


@pytest.mark.parametrize(('tag', 'other', 'whose'), [
    ('EDGE2', '50 0 0 40 1 100', 'g2o'), ('EDGE_SE2', '50 0 40 100 0 1', 'TORO')])
def test_information_in_the_order_of_the_other_format_is_recognised(
        capsys, tmp_path, tag, other, whose):
    right = written(
        tmp_path, [f'EDGE_SE2 {line} 50 0 0 40 1 100' for line in drive()], 'right.g2o')
    odd = written(tmp_path, [f'{tag} {line} {other}' for line in drive()], 'odd.g2o')
    expected, found = (solve_json(capsys, path, '--no-robust') for path in (right, odd))
    assert found['final_cost'] == pytest.approx(expected['final_cost'])
    assert found['warnings'] == [
        '41 of 41 information matrices not positive definite in the order of the tags: all are '
        f'read in that of {whose}']


def test_true_poses_of_nan_are_left_out_and_said(capsys, tmp_path):
    rows = '#id x y theta', '0 0 0 0', '1 1 0 1.57', '2 NaN nan nan', '3 0 1 4.71', '4 0 0 0'
    truth = written(tmp_path, rows, 'truth.txt')
    report = solve_json(capsys, written(tmp_path, SQUARE), '--no-robust', '--reference', truth)
    assert '1 true pose of 5 left out: NaN' in report['warnings']
    assert report['ate_poses'] == 4 and report['ate'] < 0.3


def test_without_a_common_id_both_ranges_are_said(capsys, tmp_path):
    truth = written(tmp_path, [f'{k} 0 0 0' for k in range(20, 40)], 'truth.txt')
    assert one_line(capsys, 'solve', written(tmp_path, SQUARE), '--reference', truth).endswith(
        'it has ids from 20 to 39, the graph ids from 0 to 4\n')


@pytest.mark.parametrize('name', ['trusted', 'struck', 'stamps', 'truth', 'false'])
def test_a_fifo_beside_a_graph_is_not_waited_for(capsys, tmp_path, name):
    graph = written(tmp_path, SQUARE)
    side = tmp_path / f'graph.g2o.{name}.txt'
    os.mkfifo(side)
    asked = ('solve', graph, '--reference', side) if name == 'truth' else (
        'plot', graph, '--output', tmp_path / 'map.png')
    assert one_line(capsys, *asked) == (
        f'l1slam: {side}: cannot be read: it is not a regular file\n')


@pytest.mark.parametrize('name', ['graph.g2o', 'graph.txt', 'graph.jrl', 'graph.g2o.gz', 'a.mcap',
                                  'a.db3'])
def test_a_device_or_a_fifo_as_an_input_is_refused(capsys, tmp_path, name):
    path = tmp_path / name
    os.mkfifo(path)
    assert one_line(capsys, 'info', path).endswith('it is not a regular file\n')
    path.unlink()
    path.symlink_to('/dev/zero')
    assert one_line(capsys, 'info', path).endswith('it is not a regular file\n')


def test_yaml_whose_aliases_expand_without_end_is_refused(capsys, tmp_path):
    graph, params = written(tmp_path, SQUARE), tmp_path / 'params.yaml'
    levels = [f'  a{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 10)}]' for k in range(1, 8)]
    merged = [f'  m{k}: &m{k} {{<<: [{", ".join([f"*m{k - 1}"] * 10)}]}}' for k in range(1, 8)]
    for lines in (['  a0: &a0 [x, x, x]', *levels], ['  m0: &m0 {x: 1}', *merged],
                  ['  a: &a [*a]']):
        params.write_text('\n'.join(['/**:', ' ros__parameters:', *lines]))
        assert 'aliases expand to more than' in one_line(
            capsys, 'solve', graph, '--params-file', params)
    params.write_text('/**:\n ros__parameters:\n  keyframe: {translation: &a 0.5, rotation: *a}\n')
    run(capsys, 'info', graph, '--params-file', params)
    params.unlink()
    os.mkfifo(params)
    assert 'not a regular file' in one_line(capsys, 'solve', graph, '--params-file', params)


@pytest.mark.parametrize(('name', 'said'), [
    ('gf_inputGraph_extraction.g2o', "2 lines not used: 2 'LASER_ROBOT_DATA'"),
    ('gtsam_Klaus3.g2o', ''), ('gtsam_noisyToyGraph.txt', ''),
    ('gtsam_w100.graph', '40 EQUIV lines'), ('mrpt_graphslam_SE2_in.graph', ''),
    ('mrpt_graphslam_SE2_in2.graph', ''),
    ('sphere_smallnoise_lines.txt', ':4: EDGE3: 8 fields, the information is missing')])
def test_files_of_public_reports(capsys, shared, name, said):
    refused = name.startswith('sphere')
    out, err = run(capsys, 'info', shared / 'reports' / name, code=2 if refused else 0)
    assert said in (err if refused else out) and err.count('\n') == refused
