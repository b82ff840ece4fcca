# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What is never replaced, and what another program makes of what was written."""

import os
import re

import numpy as np
import pytest
from command import run
from rosbags.rosbag2 import StoragePlugin
from worlds import pairs_of

import l1slam_ros as l1
from bags import recording_of, rosbag2_directory

GRAPH = """# a survey of 2011
VERTEX_SE2 10 0 0 0
VERTEX_SE2 13 1 0 0
VERTEX_SE2 16 2 0 0
EDGE_SE2 10 13 1 0 0 1 0 0 1 0 1
# the lift
EDGE_SE2 13 16 1 0 0 1 0 0 1 0 1
EDGE_SE2 10 16 2.1 0 0 1 0 0 1 0 1
# the end
"""
MARK = '# l1slam_ros wrote this file and may replace it'
REFUSED = 'was not written by l1slam_ros, so it is not overwritten'


def contents(path):
    files = [path] if path.is_file() else sorted(path.iterdir())
    return {file.name: file.read_bytes() for file in files}


@pytest.fixture(params=[StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def recording(capsys, tmp_path, request):
    """Return a recording written by rosbags."""
    run(capsys, 'simulate', tmp_path / 'ours', '--poses', 20, '--edges', 25)
    rosbag2_directory(tmp_path / 'run', recording_of(tmp_path / 'ours'), request.param)
    return tmp_path / 'run'


@pytest.fixture
def users(tmp_path):
    path = tmp_path / 'users.g2o'
    path.write_text(GRAPH)
    return path


def test_a_recording_stays_as_it_is(capsys, recording, users):
    before, link = contents(recording), recording.with_name('link')
    link.symlink_to(recording)
    for output in recording, link:
        for command in (('convert', users, output), ('solve', users, '--output', output),
                        ('simulate', output, '--poses', 9, '--edges', 9),
                        ('corrupt', users, output, '--false-loops', 1)):
            out, err = run(capsys, *command, code=2)
            assert out == '' and err.count('\n') == 1 and REFUSED in err
        for force in (), ('--force',):
            for command in (('convert', recording), ('solve', recording, '--output')):
                _, err = run(capsys, *command, output, *force, code=2)
                assert err.count('\n') == 1 and 'is an input' in err
    file = next(p for p in recording.iterdir() if p.suffix != '.yaml')
    assert 'is an input' in run(capsys, 'convert', file, recording, '--force', code=2)[1]
    assert contents(recording) == before
    run(capsys, 'convert', users, recording, '--force')
    assert contents(recording) != before
    run(capsys, 'convert', users, recording)


def test_a_graph_of_a_user_stays_as_it_is_by_any_name(capsys, users, tmp_path):
    hard = tmp_path / 'hard.g2o'
    before = users.read_bytes()
    os.link(users, hard)
    for output in users, hard:
        for command in (('convert', users), ('solve', users, '--output')):
            assert 'is an input' in run(capsys, *command, output, '--force', code=2)[1]
    assert users.read_bytes() == before


def test_the_folder_one_stands_in_stays_where_it_is(capsys, users, tmp_path, monkeypatch):
    # As `--output "$OUT" --force` names it where OUT is not set.
    here = tmp_path / 'here' / 'work'
    here.mkdir(parents=True)
    (here / 'notes.txt').write_text('mine')
    monkeypatch.chdir(here)
    for output in '', '.', '..', here.parent:
        for command in (('convert', users), ('solve', users, '--output')):
            err = run(capsys, *command, output, '--force', code=2)[1]
            assert 'is the folder in which this runs' in err and err.count('\n') == 1
    assert os.listdir(here) == ['notes.txt'] and os.listdir(tmp_path / 'here') == ['work']
    os.mkfifo('pipe')
    err = run(capsys, 'convert', users, 'pipe', '--force', code=2)[1]
    assert 'cannot be written: it is not a regular file' in err
    assert sorted(os.listdir(here)) == ['notes.txt', 'pipe']


def test_a_hyphen_is_not_taken_for_a_name(capsys, users, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for command in ('convert', users, '-'), ('solve', users, '--output', '-'):
        out, err = run(capsys, *command, code=2)
        assert out == '' and 'nothing is written to standard output' in err
    assert [path.name for path in tmp_path.iterdir()] == ['users.g2o']


@pytest.mark.parametrize('what', ['stamps', 'trusted', 'struck', 'truth', 'false'])
def test_what_lies_beside_a_graph_is_a_users_too(capsys, tmp_path, what):
    output = tmp_path / 'a.g2o'
    world = ('simulate', output, '--poses', 9, '--edges', 9)
    run(capsys, *world)
    run(capsys, *world)
    side, before = tmp_path / f'a.g2o.{what}.txt', output.read_bytes()
    side.write_text('0 1\n')
    assert REFUSED in run(capsys, *world, '--seed', 1, code=2)[1]
    assert (side.read_text(), output.read_bytes()) == ('0 1\n', before)
    run(capsys, *world, '--seed', 1, '--force')
    run(capsys, *world)


@pytest.mark.parametrize('suffix', ['.png', '.svg', '.pdf', '.html', '.g2o', '.tum'])
def test_an_output_is_replaced_only_where_it_is_ours(capsys, users, tmp_path, suffix):
    from matplotlib.figure import Figure

    output = tmp_path / f'map{suffix}'
    is_picture = suffix in ('.png', '.svg', '.pdf')
    option = '--plot' if is_picture else '--report' if suffix == '.html' else '--output'
    solve = 'solve', users, option, output, '--no-robust'
    if suffix == '.html':
        pytest.importorskip('plotly')
    write = ('plot', users, '--output', output) if is_picture else (
        solve if suffix == '.html' else ('convert', users, output))
    run(capsys, *write)
    run(capsys, *write)
    if is_picture:
        Figure().savefig(output)
    else:  # without our mark
        output.write_text(output.read_text().replace(MARK.strip('# '), ''))
    theirs = output.read_bytes()
    for content in theirs, b'':  # an empty file is somebody's, too
        output.write_bytes(content)
        assert REFUSED in run(capsys, *write, code=2)[1]
        assert REFUSED in run(capsys, *solve, code=2)[1]
        assert output.read_bytes() == content
        run(capsys, *write, '--force')
        run(capsys, *write)
    if suffix == '.tum':
        assert 'is an input' in run(capsys, 'solve', users, '--reference', output, '--output',
                                    output, '--force', code=2)[1]


def test_in_a_bag_refused_loops_have_a_topic_of_their_own(capsys, spoiled, tmp_path):
    solved, bag, back = (tmp_path / name for name in ('solved.g2o', 'bag', 'back.g2o'))
    run(capsys, 'solve', spoiled['random'], '--output', solved)
    run(capsys, 'convert', solved, bag)
    assert '/rejected_loop_closures: 100 of' in run(capsys, 'info', bag)[0]
    assert len(l1.read_graph(bag)[0].between) == 700
    run(capsys, 'convert', bag, back)
    assert len(re.findall('^# rejected EDGE', back.read_text(), re.MULTILINE)) == 100
    assert len(pairs_of(back)) == 600


def test_python_keeps_ids_stamps_and_comments(users, tmp_path):
    output = tmp_path / 'out.g2o'
    (tmp_path / 'users.g2o.stamps.txt').write_text('10 1.5\n13 2.5\n16 3.5\n')
    graph, poses = l1.read_graph(users)
    l1.write_graph(output, graph, poses)
    *lines, mark = output.read_text().splitlines()
    assert mark == MARK
    assert [line.split()[:3] for line in lines] == [
        line.split()[:3] if line.startswith(('#', 'EDGE')) else [*line.split()[:2],
                                                               f'{float(line.split()[2])}']
        for line in GRAPH.splitlines()]
    np.testing.assert_array_equal(np.loadtxt(f'{output}.stamps.txt'),
                                  [(10, 1.5), (13, 2.5), (16, 3.5)])
    l1.write_graph(output, graph, poses, inliers=np.array([True, True, False]))
    assert '# rejected EDGE_SE2 10 16 ' in output.read_text()
    assert len(l1.read_graph(output)[0].between) == 3
    with pytest.raises(l1.L1SlamError, match=REFUSED):
        l1.write_graph(users, graph, poses)
    l1.write_graph(users, graph, poses, force=True)
    # Comments of others are comments.
    users.write_text(GRAPH.replace('EDGE_SE2 10 16', '# rejected EDGE_SE2 10 16'))
    assert len(l1.read_graph(users)[0].between) == 2
