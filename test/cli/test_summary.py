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
from command import solve_json
from problems import retold

from l1slam_ros.cli.summary import complaints, numbers
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file, write_graph_file

# Vertices 10, 11, 12, 13, 14 in a row, and a loop.
LINES = [f'EDGE_SE2 {k} {k + 1} 1 0 0 1 0 0 1 0 1' for k in range(10, 14)]
LOOP = 'EDGE_SE2 10 14 4 0 0 1 0 0 1 0 1'


@pytest.fixture
def record_of(tmp_path):
    def read(*lines):
        path = tmp_path / 'a.g2o'
        path.write_text('\n'.join(lines) + '\n')
        return read_graph_file(path)
    return read


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
def test_each_thing_that_looks_wrong_is_one_sentence(record_of, more, sentence):
    assert sentence in complaints(record_of(*LINES, *more))


def test_ids_of_all_64_bits_are_not_consecutive(record_of):
    least, most = -2**63, 2**63 - 1
    assert complaints(record_of(f'EDGE_SE2 {least} {most} 1 0 0 1 0 0 1 0 1')) == [
        f'vertex ids are not consecutive: 1 jump ({least} to {most})']


def test_a_ratio_that_is_none_is_not_named(record_of):
    """Of as few loops as these nothing is known but that the odometry suffers from them."""
    world = simulate_world(600, 630, WorldOptions(), np.random.default_rng(0))
    factors = world.graph.between
    noisy = factors.measurement + np.where(factors.is_odometry, 0.0, 1.0)[:, None]
    said, = complaints(GraphRecord(retold(world.graph, noisy), None, np.arange(600)))
    assert re.search(r' are [0-9.]+ \(odometry\) times what the information says; ', said)


def test_vertices_without_an_edge(record_of):
    lonely = [f'VERTEX_SE2 {k} 0 0 0' for k in range(10, 20)]
    assert complaints(record_of(*lonely, *LINES, LOOP)) == [
        'no edge leads to 5 vertices (15, 16, 17, ...): place unknown',
        'the odometry has 5 gaps (14 and 15, 15 and 16, 16 and 17, ...), consecutive vertices '
        'without an edge']


@pytest.mark.parametrize('odometry, loops, reason', [
    (8, 1, 'too small'), (1, 8, 'too small'), (0.1, 1, 'too large, or some loops are false'),
    (1, 0.1, 'too large, or some loops are false'), (1, 1, None)])
def test_information_off_by_scale(rng, odometry, loops, reason):
    """Of a world whose noise is known, told sigmas that many times as large."""
    world = simulate_world(600, 1800, WorldOptions(), rng)
    times = np.where(world.graph.between.is_odometry, odometry, loops)
    found = complaints(GraphRecord(retold(world.graph, times=times), None, 5 + np.arange(600)))
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


def test_an_offset_that_loops_share_is_one_sentence(rng, tmp_path, capsys):
    """The same of `info` and `solve`; noise makes none."""
    graph = simulate_world(400, 1000, WorldOptions(), rng).graph
    off = np.where(graph.between.is_odometry[:, None], 0.0, [-0.3, 0.4, 0.05])
    shifted = retold(graph, se2.retract(graph.between.measurement, off))
    write_graph_file(tmp_path / 'a.g2o', GraphRecord(graph, None, np.arange(400)))
    assert solve_json(capsys, tmp_path / 'a.g2o')['warnings'] == []
    write_graph_file(tmp_path / 'b.g2o', GraphRecord(shifted, None, np.arange(400)))
    sentence, = solve_json(capsys, tmp_path / 'b.g2o')['warnings']
    assert solve_json(capsys, tmp_path / 'b.g2o', '--no-robust')['warnings'] == []
    for said in sentence, complaints(GraphRecord(shifted, None, np.arange(400)))[0]:
        found = re.match(r'loops share an offset of (.*) m and (.*) degrees, more than', said)
        assert float(found[1]) == pytest.approx(0.5, abs=0.05)
        assert float(found[2]) == pytest.approx(2.9, abs=0.3)


def test_the_repeated_edges_of_intel(datasets):
    record = read_graph_file(datasets / 'intel.g2o')
    assert complaints(record)[0].startswith('2 edges (60 to 863, 179 to 864): given before')
    assert dict(numbers(record)) == {
        'poses': '943 in SE2, ids 0 to 942', 'odometry': '942, 492.9 m',
        'loops': '895, 4 of them beside another edge', 'components': '1',
        'l1 cost': '1513.17 at the stored poses'}


def test_the_numbers_of_a_graph_with_everything(record_of, tmp_path):
    (tmp_path / 'a.g2o.stamps.txt').write_text(''.join(f'{k} {k}.5\n' for k in range(10, 15)))
    record = record_of(*LINES, LOOP, 'EDGE_PRIOR_SE2 10 0 0 0 1 0 0 1 0 1')
    assert dict(numbers(record)) == {
        'poses': '5 in SE2, ids 10 to 14', 'odometry': '4, 4.0 m', 'loops': '1',
        'absolute': '1', 'components': '1', 'time': '4.0 s'}


def test_what_a_person_struck_out_is_counted_and_asked_no_more(rng):
    world = simulate_world(200, 500, WorldOptions(), rng)
    record = GraphRecord(world.graph, world.truth, np.arange(200))
    cost, lies = dict(numbers(record))['l1 cost'], 10
    world.graph.append_between(*(np.repeat(column[-1:], lies, axis=0) for column in (
        np.array([3]), np.array([180]), np.array([[9.0, 9.0, 1.0]]), 100 * np.eye(3)[None])))
    assert complaints(record) and dict(numbers(record))['l1 cost'] != cost
    world.graph.say(len(world.graph.between) - 1 - np.arange(lies), trusted=False)
    assert complaints(record) == []
    found = dict(numbers(record))
    assert found['loops'].endswith(', 10 of them struck out') and found['l1 cost'] == cost


def test_the_cost_is_that_which_is_minimised(record_of, rng):
    vertices = [f'VERTEX_SE2 {k} {rng.normal()} {rng.normal()} {rng.normal()}'
                for k in range(10, 15)]
    record = record_of(*vertices, *LINES, LOOP, 'EDGE_PRIOR_SE2 12 1 2 .5 4 1 1 5 1 6')
    expected = l1_cost(whitened_residual(record.graph, record.poses))
    assert dict(numbers(record))['l1 cost'] == f'{expected:.6g} at the stored poses'
