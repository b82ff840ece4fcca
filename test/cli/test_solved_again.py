# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A map that was solved and written: drawn, listed and solved again as what was believed."""

import json
import re

import numpy as np
import pytest
from command import run, solve_json, texts_of
from worlds import drifting, edited, made

import l1slam_ros as l1


def costs_of(texts):
    """All costs that some texts name."""
    return {float(cost) for text in texts
            for cost in re.findall(r'(?:l1 cost:?|final) ([0-9.e+]+)', text.replace(',', ''))}


def of_the_identity(line, is_odometry):
    """State what nobody measured."""
    line[6:] = ['1', '0', '0', '1', '0', '1']


@pytest.fixture(params=['false loops', 'drift', 'identity'])
def world(request, tmp_path):
    """Return a graph with ten false loops, by the kind of its odometry and information."""
    path = made(tmp_path / 'world.g2o', 300, 480, '--false-loops', 10)
    if request.param == 'drift':
        edited(path, drifting)
    elif request.param == 'identity':
        edited(path, of_the_identity)
    return path


def info_of(capsys, path):
    out, _ = run(capsys, 'info', path)
    return dict(re.split(r'  +', line, maxsplit=1) for line in out.splitlines()
                if not line.startswith('- ') and '  ' in line), out


def test_a_solved_file_is_listed_drawn_and_solved_again_as_it_was_believed(
        capsys, world, tmp_path):
    solved, again = tmp_path / 'solved.g2o', tmp_path / 'again.g2o'
    report = solve_json(capsys, world, '--output', solved)
    assert len(report['rejected']) >= 10
    said, out = info_of(capsys, solved)
    assert said['l1 cost'] == (
        f'{report["final_cost"]:.6g} at the stored poses, without what is left out')
    assert said['loops'] == f'191, {len(report["rejected"])} of them left out by the map'
    assert 'loops are false' not in out
    run(capsys, 'plot', solved, '--output', tmp_path / 'solved.svg')
    assert (f'300 poses, 191 loops ({len(report["rejected"])} refused)'
            in texts_of(tmp_path / 'solved.svg'))
    after = solve_json(capsys, solved, '--output', again)
    assert [after[name] for name in ('rejected', 'suspect', 'slips', 'drift', 'doubts')] == [
        report[name] for name in ('rejected', 'suspect', 'slips', 'drift', 'doubts')]
    for cost in 'initial_cost', 'final_cost':
        assert after[cost] == pytest.approx(report['final_cost'], rel=1e-9)
    np.testing.assert_allclose(
        l1.read_graph(again)[1], l1.read_graph(solved)[1], rtol=0, atol=1e-6)


@pytest.mark.parametrize('suffix', ['.g2o', '.jrl'])
def test_a_solved_file_that_is_converted_stays_what_was_believed(
        capsys, world, tmp_path, suffix):
    """Corrected odometry, too, and in Python: other programs get the same map from the copy."""
    solved = tmp_path / f'solved{suffix}'
    report = solve_json(capsys, world, '--output', solved)
    run(capsys, 'convert', solved, tmp_path / f'copy{suffix}')
    l1.write_graph(tmp_path / f'python{suffix}', *l1.read_graph(solved))
    for path in tmp_path / f'copy{suffix}', tmp_path / f'python{suffix}':
        assert info_of(capsys, path) == info_of(capsys, solved)
        said, _ = info_of(capsys, path)
        assert said['l1 cost'].startswith(f'{report["final_cost"]:.6g} at')
        assert solve_json(capsys, path)['rejected'] == report['rejected']


def test_there_is_one_cost_in_text_json_picture_and_page(capsys, world, tmp_path):
    """Whatever noise a map was weighed by, costs are of the noise that is stated."""
    picture = tmp_path / 'map.svg'
    out, _ = run(capsys, 'solve', world, '--plot', picture)
    final = float(re.search(r'final ([0-9.e+]+), without what is left out\n', out)[1])
    report = solve_json(capsys, world)
    assert float(f'{report["final_cost"]:.6g}') == final
    assert costs_of(texts_of(picture)) == {final}
    pytest.importorskip('plotly')
    page = tmp_path / 'map.html'
    run(capsys, 'solve', world, '--quiet', '--report', page)
    shown = json.loads(page.read_text(encoding='utf-8').split(
        'type="application/json">')[1].split('</script>')[0])
    assert costs_of([shown['maps'][0]['note']]) == {final}
