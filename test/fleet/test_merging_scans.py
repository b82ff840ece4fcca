# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam merge --scans`: drives of lidars, joined by what the front end finds."""

import json

import numpy as np
import pytest
from command import run
from rooms import WALLS, box, drive, laps, write_log, write_scan_bag, write_truth
from worlds import compose

# A room that looks like itself from one place alone: one side of it is much wider.
ONE_SIDED = np.vstack((box(0, 0, 16, 8), WALLS[4:]))


def drives(folder, walls):
    """Write two laps as two drives; the second has other wheels, and no begin."""
    true = laps()[2]
    scans, wheels = drive(true, walls=walls)
    half, begin = len(scans) // 2, len(scans) // 2 + 8
    write_log(folder / 'first.clf', scans[:half], wheels[:half])
    elsewhere = compose(np.array([5.0, -3.0, 2.0]), wheels[begin:])
    write_scan_bag(folder / 'second', scans[begin:], elsewhere)
    write_log(folder / 'second.clf', scans[begin:], elsewhere)
    kept = np.r_[:half, begin:len(scans)]
    write_truth(folder / 'truth.csv', [scans[k] for k in kept], true[kept])
    return folder


@pytest.fixture(scope='module')
def two_drives(tmp_path_factory):
    return drives(tmp_path_factory.mktemp('drives'), ONE_SIDED)


def test_what_two_drives_saw_joins_them_a_log_and_a_bag(two_drives, tmp_path, capsys):
    out, said = run(capsys, 'merge', two_drives / 'first.clf', two_drives / 'second', '--scans',
                    '--odom-topic', '/wheels', '--output', tmp_path / 'out.g2o', '--reference',
                    two_drives / 'truth.csv', '--json')
    found = json.loads(out)
    assert found['parts'] == 1 and found['ate'] < 0.1
    assert 'its vertices 0 to' in said


def test_a_room_that_looks_the_same_turned_round_is_doubted(tmp_path, capsys):
    folder = drives(tmp_path, WALLS)
    said = run(capsys, 'merge', folder / 'first.clf', folder / 'second.clf', '--scans', '--output',
               tmp_path / 'out.g2o', code=4)[1]
    assert 'may be right: then the map is another one' in said


def test_an_input_without_scans_is_named(two_drives, tmp_path, capsys):
    graph = tmp_path / 'graph.g2o'
    graph.write_text('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n')
    said = run(capsys, 'merge', two_drives / 'first.clf', graph, '--scans', '--output',
               tmp_path / 'out.g2o', code=2)[1]
    assert f'{graph}: holds no scans' in said
