# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam`: what it answers to bad input, and its help, with `info` and `plot`."""

import re
import shlex

import pytest
from command import help_of, run
from worlds import graph_file

VERTICES = ['VERTEX_SE2 0 0 0 0', 'VERTEX_SE2 1 1 0 0', 'VERTEX_SE2 2 2 0 0']
EDGES = ['EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1', 'EDGE_SE2 1 2 1 0 0 1 0 0 1 0 1',
         'EDGE_SE2 0 2 2.1 0 0 1 0 0 1 0 1']


def test_info_of_a_good_graph_and_of_its_bag(capsys, world, tmp_path):
    run(capsys, 'convert', world, tmp_path / 'bag')
    for path in world, tmp_path / 'bag':
        out, err = run(capsys, 'info', path)
        assert out.endswith('\nnothing looks wrong\n') and err == ''


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


@pytest.mark.parametrize('arguments, words', [
    (['solve', 'missing.g2o'], 'no such file'),
    (['solve', 'graph.g2o', '--start', 'file'], 'no poses'),
    (['solve', 'graph.g2o', '--inner', '0'], 'iterations'),
    (['solve', 'nan.g2o', '--output', 'out.g2o'], "nan.g2o:2: EDGE_SE2: 'nan' is not a finite"),
    (['solve', 'lonely.g2o', '--output', 'out.g2o'], 'lonely.g2o: the graph is not connected'),
    (['solve', 'graph.g2o', '--output', 'out.doc'], 'suffix'),
    (['solve', 'graph.g2o', '--output', 'missing/out.g2o'], 'missing is no folder'),
    (['solve', 'graph.g2o', '--output', 'taken.g2o', '--plot', 'a.png'], 'it is a directory'),
    (['solve', 'gap.g2o', '--start', 'odometry'], 'consecutive vertices 1 and 2'),
    (['corrupt', 'graph.g2o', 'out.tum', '--false-loops', '1'], 'trajectory'),
    (['corrupt', 'graph.g2o', 'out.g2o', '--false-loops', '-1'], '--false-loops is -1'),
    (['plot', 'graph.g2o', '--output', 'map.doc'], '.png'),
    (['plot', 'graph.g2o', 'missing.g2o', '--output', 'map.png'], 'missing.g2o'),
    (['solve', 'graph.g2o', '--params-file', 'graph.txt'], 'parameters'),
    (['solve', 'graph.g2o', '--params-file', 'other'], 'other: cannot be read: Is a directory'),
    (['solve', 'graph.g2o', '--plot', 'taken.png'], 'taken.png: cannot be written: it is a di'),
    (['solve', 'missing.g2o', '--output', '/proc/out.g2o'], '/proc/out.g2o: cannot be written'),
    (['simulate', '/proc/a.g2o', '--poses', '1', '--edges', '5'], '/proc/a.g2o: cannot be wri'),
    (['simulate', 'out.g2o', '--poses', '10', '--edges', '8'],
     '8 edges between 10 poses, expected 9 to 45'),
    (['simulate', 'out.g2o', '--poses', '10', '--edges', '46'], 'expected 9 to 45'),
    (['simulate', 'out.g2o', '--poses', '1', '--edges', '0'], 'expected 2 or more'),
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
    (tmp_path / 'gap.g2o').write_text('\n'.join(EDGES).replace(' 1 2 1 ', ' 2 3 1 '))
    (tmp_path / 'nan.g2o').write_text('\n'.join(EDGES).replace(' 1 2 1 ', ' 1 2 nan '))
    (tmp_path / 'lonely.g2o').write_text('\n'.join([*VERTICES, 'VERTEX_SE2 9 0 0 0', *EDGES]))
    there = sorted(tmp_path.iterdir())
    err = run(capsys, *arguments, code=2)[1]
    assert err.count('\n') == 1 and words in err, err
    assert sorted(tmp_path.iterdir()) == there


COMMANDS = ['simulate', 'convert', 'solve', 'corrupt', 'info', 'plot']


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
