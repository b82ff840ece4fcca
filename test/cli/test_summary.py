# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam info` in words: one plain sentence on each thing that looks wrong, by vertex ids."""

import re

import numpy as np
import pytest
from command import run, solve_json
from worlds import compose, edge, edges_of, made, whitened

import l1slam_ros as l1

# Vertices 10, 11, 12, 13, 14 in a row, and a loop.
LINES = [f'EDGE_SE2 {k} {k + 1} 1 0 0 1 0 0 1 0 1' for k in range(10, 14)]
LOOP = 'EDGE_SE2 10 14 4 0 0 1 0 0 1 0 1'


@pytest.fixture
def info(capsys, tmp_path):
    """Return what writes lines as a graph, and returns its numbers and what looks wrong of it."""
    def written(*lines):
        (tmp_path / 'a.g2o').write_text('\n'.join(lines) + '\n')
        return info_of(capsys, tmp_path / 'a.g2o')
    return written


def info_of(capsys, path):
    """Return the numbers of a graph, and the sentences on it."""
    said = run(capsys, 'info', path)[0].splitlines()
    complaints = [line[2:] for line in said if line.startswith('- ')]
    assert ('nothing looks wrong' in said) == (not complaints)
    return {line[:12].rstrip(): line[12:] for line in said
            if not line.startswith('- ') and line != 'nothing looks wrong'}, complaints


def other(path, loops=(0.0, 0.0, 0.0), times=(1.0, 1.0), first=0):
    """
    Return the lines of a world, other than it was.

    loops : the steps that its loops are off by; times : how large sigmas of the odometry and of
    loops are stated; first : the id of the first vertex
    """
    return [edge(first + i, first + j, measurement if j == i + 1 else compose(
        measurement, np.array(loops)), information / times[j != i + 1]**2)
        for i, j, measurement, information in edges_of(path)]


@pytest.mark.parametrize('more, sentence', [
    ([LOOP, 'EDGE_SE2 10 14 4 0 0 2 0 0 2 0 2'],
     '1 edge (10 to 14): given before with the same measurement, so counted twice'),
    ([LOOP] * 6, '5 edges (10 to 14, 10 to 14, 10 to 14, ...): given before with the same '
     'measurement, so counted twice'),
    (['EDGE_SE2 14 20 1 0 0 1 0 0 1 0 1', 'EDGE_SE2 20 30 1 0 0 1 0 0 1 0 1'],
     'vertex ids are not consecutive: 2 jumps (14 to 20, 20 to 30)'),
    (['EDGE_SE2 12 16 3 0 0 1 0 0 1 0 1', 'EDGE_SE2 10 15 3 0 0 1 0 0 1 0 1'],
     'the odometry has 2 gaps (14 and 15, 15 and 16), consecutive vertices without an edge'),
    (['EDGE_SE2 15 16 3 0 0 1 0 0 1 0 1'],
     'the graph is not connected: 2 parts (5 vertices between ids 10 and 14, 2 vertices between '
     'ids 15 and 16); nothing says where one lies from another'),
    (['EDGE_SE2 14 15 50 0 0 1 0 0 1 0 1', *(f'EDGE_SE2 {k} {k + 1} 1 0 0 1 0 0 1 0 1'
                                              for k in range(15, 30))],
     'odometry that jumps: 1 step (50 m from 14 to 15); nine in ten are no longer than 1 m'),
])
def test_each_thing_that_looks_wrong_is_one_sentence(info, more, sentence):
    assert sentence in info(*LINES, *more)[1]


def test_ids_of_all_64_bits_are_not_consecutive(info):
    least, most = -2**63, 2**63 - 1
    assert info(f'EDGE_SE2 {least} {most} 1 0 0 1 0 0 1 0 1')[1] == [
        f'vertex ids are not consecutive: 1 jump ({least} to {most})']


def test_vertices_without_an_edge(info):
    lonely = [f'VERTEX_SE2 {k} 0 0 0' for k in range(10, 20)]
    assert info(*lonely, *LINES, LOOP)[1] == [
        'no edge leads to 5 vertices (15, 16, 17, ...): place unknown',
        'the odometry has 5 gaps (14 and 15, 15 and 16, 16 and 17, ...), consecutive vertices '
        'without an edge']


@pytest.fixture(scope='module')
def noisy(tmp_path_factory):
    """Return a world whose noise is known."""
    return made(tmp_path_factory.mktemp('noisy') / 'world.g2o', 600, 1800)


@pytest.mark.parametrize('odometry, loops, reason', [
    (8, 1, 'too small'), (1, 8, 'too small'), (0.1, 1, 'too large, or some loops are false'),
    (1, 0.1, 'too large, or some loops are false'), (1, 1, None)])
def test_information_off_by_scale(info, noisy, odometry, loops, reason):
    """Told sigmas that many times as large."""
    found = info(*other(noisy, times=(odometry, loops), first=5))[1]
    if reason is None:
        assert found == []
        return
    sentence, = found
    ratios = re.fullmatch(
        r'errors at the L2 map of vertices 5 to 604 are (.*) \(odometry\) and (.*) \(loops\) '
        r'times what the information says; expected about 1: the information is (.*)', sentence)
    assert ratios[3] == reason
    assert float(ratios[1]) * odometry == pytest.approx(1, rel=0.1)
    assert float(ratios[2]) * loops == pytest.approx(1, rel=0.1)


def test_an_offset_that_loops_share_is_one_sentence(info, tmp_path, capsys):
    """The same of `info` and `solve`; noise makes none."""
    path = made(tmp_path / 'world.g2o', 400, 1000)
    assert solve_json(capsys, path)['warnings'] == []
    complaint, *_ = info(*other(path, loops=(-0.3, 0.4, 0.05)))[1]
    sentence, = solve_json(capsys, tmp_path / 'a.g2o')['warnings']
    assert solve_json(capsys, tmp_path / 'a.g2o', '--no-robust')['warnings'] == []
    for said in sentence, complaint:
        found = re.match(r'loops share an offset of (.*) m and (.*) degrees, more than', said)
        assert float(found[1]) == pytest.approx(0.5, abs=0.05)
        assert float(found[2]) == pytest.approx(2.9, abs=0.3)


def test_the_numbers_of_a_graph_with_everything(info, tmp_path):
    (tmp_path / 'a.g2o.stamps.txt').write_text(''.join(f'{k} {k}.5\n' for k in range(10, 15)))
    assert info(*LINES, LOOP, 'EDGE_PRIOR_SE2 10 0 0 0 1 0 0 1 0 1')[0] == {
        'poses': '5 in SE2, ids 10 to 14', 'odometry': '4, 4.0 m', 'loops': '1',
        'absolute': '1', 'components': '1', 'time': '4.0 s'}


def test_what_a_person_struck_out_is_counted_and_asked_no_more(info, tmp_path):
    lines = made(tmp_path / 'world.g2o', 200, 500).read_text().splitlines()
    cost, lies = info(*lines)[0]['l1 cost'], 10
    lines += [edge(3, 180, (9.0, 9.0, 1.0), 100 * np.eye(3))] * lies
    numbers, complaints = info(*lines)
    assert complaints and numbers['l1 cost'] != cost
    (tmp_path / 'a.g2o.struck.txt').write_text('3 180\n')
    numbers, complaints = info(*lines)
    assert complaints == []
    assert numbers['loops'].endswith(', 10 of them struck out') and numbers['l1 cost'] == cost


def test_the_cost_is_that_which_is_minimised(info, rng, tmp_path):
    vertices = [f'VERTEX_SE2 {k} {rng.normal()} {rng.normal()} {rng.normal()}'
                for k in range(10, 15)]
    numbers, _ = info(*vertices, *LINES, LOOP, 'EDGE_PRIOR_SE2 12 1 2 .5 4 1 1 5 1 6')
    expected = np.abs(whitened(*l1.read_graph(tmp_path / 'a.g2o'))).sum()
    assert numbers['l1 cost'] == f'{expected:.6g} at the stored poses'
