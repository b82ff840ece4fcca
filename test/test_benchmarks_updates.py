# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The suite of growing maps without its peer: cells, what is counted, bars, what is left out."""

import importlib
import json
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.paper.updates import Drive, Kept

FOLDER = Path(__file__).parents[1] / 'benchmarks'
sys.path.append(str(FOLDER))
cells, tables, suite, kinds, cases, in_space, waits = (importlib.import_module(name) for name in (
    'updates.cells', 'updates.tables', 'incremental', 'robust.kinds', 'robust.cases',
    'updates.in_space', 'waits'))
TINY = cells.Cell('world10k', 'random', 0.3, 100, 1e4)


@pytest.fixture
def tiny(monkeypatch):
    """Make the world of the suite a little one."""
    monkeypatch.setitem(cells.WORLDS, 'world10k', (120, 260))


def spread(**values):
    return dict.fromkeys(('median', 'p95', 'p99', 'max', 'second', 'last', 'total'), 1.0) | values


def row_of(cell, **values):
    """What a cell would have given that reaches every bar."""
    peer = spread(p99=5.0, max=5.0, total=5.0)
    return replace(cells.Row(
        cell, 'abc', 2000, 4000, 200.0, spread(), 3.0, 300.0, [1000, 2000], peer, 2000, spread(),
        [9.0, 0.4, 0.05], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [9.0, 9.0, 9.0], [0, 0, 0], [3, 2, 1],
        10, 20, 1.0), **values)


CITY, BICOCCA = cells.Cell('city10000', 'random', 0.3), cells.Cell('bicocca25b', 'recorded', 0.0)
LARGE = cells.Cell('world50k', 'clean', 0.0)


def test_what_is_said_was_measured():
    record = json.loads((FOLDER / 'results' / 'incremental.json').read_text())
    lines = tables.document(record, [cells.Row.of(fields) for fields in record['rows']])
    assert (FOLDER / 'INCREMENTAL.md').read_text().splitlines() == lines


def test_each_keyframe_of_a_drive_is_waited_for(rng):
    world = simulate_world(120, 200, WorldOptions(), rng)
    taken = waits.measure(Drive.of(world.graph), 80, 2000.0)
    assert [len(seconds) for seconds in taken] == 4 * [80]
    assert (np.array(taken) > 0).all()
    # The longest call is one of those that are summed, and there are at least two.
    assert (taken.call_clock < taken.clock).all()
    assert (taken.call_processor < taken.processor).all()


def test_a_cell_is_measured_from_the_graph_to_the_row(tiny):
    row = cells.measure(Path(), TINY, 0.0)
    assert (row.cell, row.n, row.peer) == (TINY, 100, None)
    assert row.keyframes == list(range(5, 105, 5)) and row.true > 90
    assert row.false == pytest.approx(row.true * 3 / 7, abs=1) and row.edges > row.true + row.false
    assert len(row.excess) == len(row.error) == len(row.clean) == len(row.odometry) == 21
    assert min(row.excess) > -0.1 and max(row.clean) < 1 and row.memory > 50
    assert [cells.Row.of(json.loads(json.dumps(asdict(row))))] == [row]
    assert '| world10k | random | 30% | 100 |' in '\n'.join(tables.document(
        {'machine': {'cpu': 'one', 'cores': 2, 'used': 2}, 'versions': {}}, [row]))


def test_false_loops_that_are_held_and_true_ones_that_are_not_are_counted(tiny):
    kind = next(kind for kind in kinds.KINDS if kind.name == 'random')
    case = cases.false_case(cells._place(Path(), TINY), kind, 0.3, 0)
    half, odometry = cells.prefix(case.graph, 50), case.graph.between.is_odometry
    for graph, accepted, expected in (
            (case.graph, odometry | True, (case.is_false.sum(), 0)),
            (case.graph, odometry, (0, case.is_true.sum())),
            (half, half.between.is_odometry,
             (0, (case.is_true & (case.graph.between.pairs < 50).all(axis=1)).sum()))):
        now = Kept(graph, accepted, None)
        assert cells.held(now, case) == expected
    assert (case.graph.between.pairs[np.flatnonzero(case.is_false)] < 100).all()


@pytest.mark.parametrize(('cell', 'values', 'missed'), [
    (CITY, {}, []), (BICOCCA, {}, []), (LARGE, {}, []),
    (CITY, {'excess': [0.0, 2.5, 0.2]}, ['excess at rest', 'excess', 'most excess']),
    (CITY, {'error': [1.0, 1.1, 1.0]}, ['error']),
    (CITY, {'error': [3.6, 1.0, 1.0]}, ['running error']),
    (CITY, {'kept': [0, 1, 0], 'differs': 1}, ['lies', 'final set']),
    (CITY, {'peer': spread(p99=3.9, max=3.9, total=2.9)},
     ['p99 / ISAM2', 'longest / ISAM2', 'sum / ISAM2', 'all / ISAM2']),
    (CITY, {'peer': spread(p99=3.9), 'peer_poses': 1500}, []),
    (CITY, {'ours': spread(last=5.1)}, ['last quarter', 'growth']),
    (BICOCCA, {'error': [10.1, 2.0, 1.2]}, ['final error', 'odometry']),
    (LARGE, {'ours': spread(p99=21.0), 'memory': 1025.0}, ['p99', 'memory']),
    (replace(LARGE, graph='intel'), {'ours': spread(p99=21.0)}, [])])
def test_bars_that_are_missed_are_named(cell, values, missed):
    row = row_of(cell, **values)
    assert tables.missed(row) == missed
    assert f'| {", ".join(missed) or "none"} | abc |' in '\n'.join(tables.document(
        {'machine': {'cpu': 'one', 'cores': 2, 'used': 2}, 'versions': {}}, [row]))


def test_what_was_measured_of_a_commit_with_all_that_is_asked_for_is_done():
    row = row_of(CITY)
    assert cells.is_done(row, CITY, True, 'abc')
    assert not cells.is_done(row, CITY, True, 'def')
    assert not cells.is_done(row, replace(CITY, poses=100), True, 'abc')
    assert not cells.is_done(replace(row, commit='abc+'), CITY, True, 'abc+')
    alone = replace(row, peer=None)
    assert cells.is_done(alone, CITY, False, 'abc') and not cells.is_done(alone, CITY, True, 'abc')


def test_cells_are_chosen_by_graph_kind_and_share(tmp_path, capsys):
    (tmp_path / 'manhattan3500.g2o').touch()
    folder = ['--datasets', str(tmp_path), '--graphs']
    parsed = suite.parse([*folder, 'world50k,manhattan3500', '--kinds', 'clean,grouped'])
    assert [(cell.graph, cell.kind, cell.share) for cell in parsed.cells] == [
        ('world50k', 'clean', 0.0), ('world50k', 'grouped', 0.3), ('manhattan3500', 'clean', 0.0),
        ('manhattan3500', 'grouped', 0.3), ('manhattan3500', 'grouped', 0.5)]
    for words, expected in (([*folder, 'world10k', '--kinds', 'evil'], "'evil' is none of clean"),
                            ([*folder, 'intel'], 'has no intel'),
                            ([*folder, 'building,hills'], 'has no hills'),
                            ([*folder, 'bicocca25b', '--kinds', 'clean'], 'no such kind'),
                            ([*folder, 'world10k', '--shares', '1'], 'between 0 and 1')):
        with pytest.raises(SystemExit):
            suite.parse(words)
        assert expected in capsys.readouterr().err


def test_who_drives_over_hills_goes_where_he_looks_and_up_and_down():
    way = np.column_stack((0.1 * np.arange(5000), np.zeros(5000), np.zeros(5000)))
    way = se2.compose(np.tile([[0.0, 0.0, 0.7]], (5000, 1)), way)
    truth = in_space._over_ground(way, np.random.default_rng(0))
    steps = se3.between(truth[:-1], truth[1:])
    assert np.abs(steps[:, 1:3]).max() < 1e-3 and steps[:, 0].min() >= 0.1 - 1e-6
    assert np.ptp(truth[:, 2]) > 5 and np.abs(np.diff(truth[:, 2])).max() < 0.03
