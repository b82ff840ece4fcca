# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The report of the paper's experiments, from little worlds: what it says, and what it leaves."""

import re
from dataclasses import replace

import pytest
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


def table(text, name):
    """Return the rows of the table whose first column has this name, by the names of columns."""
    lines = text[text.index(f'| {name} |'):].split('\n\n')[0].splitlines()
    header, _, *rows = [[cell.strip() for cell in line.strip('|').split('|')] for line in lines]
    return [dict(zip(header, row, strict=True)) for row in rows]


def is_picture(path, size):
    with Image.open(path) as image:
        return image.format == 'PNG' and min(image.size) > size


def test_a_report_is_whole_and_replaces_its_former_self_and_nothing_else(tmp_path):
    (tmp_path / 'report.md').write_text(
        '<!-- l1slam_ros wrote this file and may replace it -->\nformer')
    (tmp_path / 'notes.txt').write_text('mine')
    reproduce.reproduce(None, [TINY_10K, TINY_50K], tmp_path,
                        replace(LITTLE, keyframes=120, rate=1000.0))
    text = (tmp_path / 'report.md').read_text()
    linked = re.findall(r'!\[.*?\]\((.*?)\)', text)
    assert sorted([*linked, 'report.md', 'notes.txt']) == sorted(
        path.name for path in tmp_path.iterdir())
    assert all(is_picture(tmp_path / name, 300) for name in linked)
    assert re.findall('^## (.*)', text, re.MULTILINE) == list(reproduce.SECTIONS)
    for said in ('It is of Intel, which was not run.', 'Not run: Manhattan3500, Intel, City10k',
                 'Not run: it is of Intel.', 'Not run: it is of Intel and Manhattan3500.',
                 *paper.FILES, '--datasets'):
        assert said in text
    assert re.search(r'proportions of City10k \(seed 0\), 120 keyframes, .* at [0-9]+ keyframes '
                     'per second', text)
    large = table(text, 'L1 cost')[-1]
    assert (large['L1 cost'], large['poses, edges']) == ('Manhattan50k (*)', '60, 150')
    assert large['start: paper'] == '7.14591e8' and float(large['of the true poses']) > 0
    assert table(text, 'ms per iteration')[-1]['L2: paper (g2o)'] == 'did not finish'
    # Readable by whom other files are: not by their owner alone.
    assert (tmp_path / 'notes.txt').read_text() == 'mine'
    assert (tmp_path / 'report.md').stat().st_mode == (tmp_path / 'notes.txt').stat().st_mode


def test_tables_and_figures_are_of_the_files_that_are_there(tmp_path):
    made(tmp_path / 'intel.g2o', 80, 160, '--seed', 3)
    made(tmp_path / 'manhattan3500.g2o', 70, 150, '--seed', 3)
    output = tmp_path / 'out'
    reproduce.reproduce(tmp_path, [], output, LITTLE)
    figures = ['figure_4.png', 'figure_6_intel.png', 'figure_6_manhattan3500.png']
    assert sorted(path.name for path in output.iterdir()) == [
        'figure_3.png', *figures, 'report.md']
    assert all(is_picture(output / name, 600) for name in figures)
    text = (output / 'report.md').read_text()
    assert re.search(r'The seed, then Algorithm 4 as printed: L1 cost [0-9.]+\.\n', text)
    assert 'it is of Intel' not in text
    intel = next(row for row in table(text, 'L1 cost') if row['L1 cost'] == 'Intel')
    assert (intel['start: paper'], intel['final: paper']) == ('1513.17', '982.051')
    best = l1.solve(l1.read_graph(tmp_path / 'intel.g2o')[0], robust=False).cost
    assert float(intel['final: ours'].strip('*')) == pytest.approx(best, rel=1e-4)
    costs = [float(intel[name]) for name in ('start: ours', 'seed: ours', 'final: as printed')]
    assert costs[0] > 2 * max(costs[1:]) and min(costs) > best
    times = next(row for row in table(text, 'ms per iteration') if 'Intel' in row.values())
    assert (times['angle: paper'], times['L2: paper (g2o)']) == ('0.3', '6.7')
    assert all(float(times[f'{part}: {how}']) > 0 for part in ('angle', 'translation', 'global')
               for how in ('plain', 'fused'))
