# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam reproduce`: what the report says, and what it leaves."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from command import run
from PIL import Image
from worlds import made

import l1slam_ros as l1
from l1slam_ros.paper import printed as paper
from l1slam_ros.paper import reproduce
from l1slam_ros.paper.experiments import Effort

# The command does more: half a minute of it.
LITTLE = Effort(outer=4, inner=60, iterations=400, timed=3, keyframes=0)
TINY_10K = replace(paper.MANHATTAN_10K, poses=80, edges=160)
TINY_50K = replace(paper.MANHATTAN_50K, poses=60, edges=150)


def test_a_report_is_whole_and_its_pictures_are_there(tmp_path):
    output = tmp_path / 'out'
    reproduce.reproduce(None, [TINY_10K, TINY_50K], output,
                        replace(LITTLE, keyframes=120, rate=1000.0))
    text = (output / 'report.md').read_text()
    linked = re.findall(r'!\[.*?\]\((.*?)\)', text)
    assert sorted([*linked, 'report.md']) == sorted(p.name for p in output.iterdir())
    for name in linked:
        with Image.open(output / name) as image:
            assert image.format == 'PNG' and min(image.size) > 300
    assert re.findall('^## (.*)', text, re.MULTILINE) == list(reproduce.SECTIONS)
    assert 'It is of Intel, which was not run.' in text
    assert 'Not run: Manhattan3500, Intel, City10k' in text
    assert all(name in text for name in (*paper.FILES, '--datasets'))
    assert 'Not run: it is of Intel.' in text
    assert re.search(r'proportions of City10k \(seed 0\), 120 keyframes, .* at [0-9]+ keyframes '
                     'per second', text)
    assert 'Not run: it is of Intel and Manhattan3500.' in text
    assert list(tmp_path.iterdir()) == [output]


def test_figures_4_and_6_are_of_the_files_that_are_there(tmp_path):
    made(tmp_path / 'intel.g2o', 80, 160, '--seed', 3)
    made(tmp_path / 'manhattan3500.g2o', 70, 150, '--seed', 3)
    output = tmp_path / 'out'
    reproduce.reproduce(tmp_path, [], output, LITTLE)
    assert sorted(path.name for path in output.iterdir()) == [
        'figure_3.png', 'figure_4.png', 'figure_6_intel.png', 'figure_6_manhattan3500.png',
        'report.md']
    for name in ('figure_4.png', 'figure_6_intel.png', 'figure_6_manhattan3500.png'):
        with Image.open(output / name) as image:
            assert image.format == 'PNG' and min(image.size) > 600
    text = (output / 'report.md').read_text()
    assert re.search(r'The seed, then Algorithm 4 as printed: L1 cost [0-9.]+\.\n', text)
    assert 'it is of Intel' not in text


def test_a_graph_without_room_for_false_loops_is_named(tmp_path):
    (tmp_path / 'intel.g2o').write_text(''.join(
        f'EDGE_SE2 {i} {j} {j - i} 0 0 100 0 0 100 0 100\n'
        for i, j in ((0, 1), (1, 2), (2, 3), (0, 3))))
    with pytest.raises(l1.L1SlamError, match=r'intel\.g2o: 10 false loops asked for, found'):
        reproduce.reproduce(tmp_path, [], tmp_path / 'out', LITTLE)
    assert [path.name for path in tmp_path.iterdir()] == ['intel.g2o']


def test_a_report_replaces_its_former_self_and_nothing_else(tmp_path):
    (tmp_path / 'report.md').write_text(
        '<!-- l1slam_ros wrote this file and may replace it -->\nformer')
    (tmp_path / 'notes.txt').write_text('mine')
    reproduce.reproduce(None, [TINY_50K], tmp_path, LITTLE)
    assert (tmp_path / 'notes.txt').read_text() == 'mine'
    text = (tmp_path / 'report.md').read_text()
    assert 'Manhattan50k (*)' in text
    assert 'it is of Manhattan10k, which `--worlds 10k` makes' in text
    assert sorted(p.name for p in tmp_path.iterdir()) == ['figure_3.png', 'notes.txt', 'report.md']
    # Readable by whom other files are: not by their owner alone.
    mode = (tmp_path / 'notes.txt').stat().st_mode
    assert (tmp_path / 'report.md').stat().st_mode == mode


def arguments(folder, **changes):
    options = {'datasets': folder, 'worlds': 'none', 'output': folder / 'out', **changes}
    return [word for name, value in options.items() if value is not None
            for word in (f'--{name}', value)]


@pytest.mark.parametrize(('changes', 'says'), [
    ({'datasets': None}, 'expected --datasets DIR, or --worlds other than none'),
    ({}, "none of the paper's graphs is there; expected manhattan3500.g2o, intel.g2o"),
    ({'datasets': Path('/no/such/folder')}, "none of the paper's graphs is there"),
    ({'worlds': '10k', 'datasets': None, 'output': Path('/no/such/folder')}, 'is no folder'),
    ({'worlds': '10k', 'datasets': None, 'output': Path(__file__)}, 'is no folder; expected one'),
    ({'output': Path('/proc')}, '/proc/report.md: cannot be written'),
    ({'output': Path('/proc/out')}, '/proc/out: cannot be written'),
])
def test_what_cannot_be_is_refused_at_once_in_one_line(capsys, tmp_path, changes, says):
    out, err = run(capsys, 'reproduce', *arguments(tmp_path, **changes), code=2)
    assert out == '' and says in err and err.count('\n') == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(('text', 'says'), [
    ('EDGE_SE2 0 1 1 0 nonsense 1 0 0 1 0 1\n', 'intel.g2o:1: '),
    ('VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_SE2 2 1 0 0\n'
     'EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n', 'intel.g2o: the graph is not connected: vertex 2')])
def test_a_graph_that_cannot_be_used_is_named(capsys, tmp_path, text, says):
    (tmp_path / 'intel.g2o').write_text(text)
    out, err = run(capsys, 'reproduce', *arguments(tmp_path), code=2)
    assert out == '' and says in err and err.count('\n') == 1
    assert [p.name for p in tmp_path.iterdir()] == ['intel.g2o']
