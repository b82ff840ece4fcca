# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""From scans to a map, a grid and a picture, with one command."""

import bz2
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from rooms import laps, ranges_on_the_way, write_log, write_scan_bag, write_truth
from worlds import between

from l1slam_ros.cli.main import main

DEMO = Path(__file__).parents[2] / 'bags' / 'demo'


@pytest.fixture(scope='module')
def drive():
    return laps()


@pytest.fixture
def truth(drive, tmp_path):
    path = tmp_path / 'truth.csv'
    write_truth(path, drive[0], drive[2])
    return path


def solved(capsys, *arguments):
    """Return the exit code and what `solve --json` says."""
    code = main(['solve', *map(str, arguments), '--json'])
    return code, json.loads(capsys.readouterr().out)


def test_a_log_becomes_a_map_and_a_grid_that_others_read(drive, truth, tmp_path, capsys):
    log, grid = tmp_path / 'room.clf.bz2', tmp_path / 'map.pgm'
    plain = tmp_path / 'plain.clf'
    write_log(plain, drive[0], drive[1])
    log.write_bytes(bz2.compress(plain.read_bytes()))
    code, said = solved(capsys, log, '--reference', truth, '--grid', grid)
    assert code == 0 and said['status'] == 'converged'
    assert said['loops'] - len(said['rejected']) >= 3
    assert said['ate'] < 0.1 and said['ate_poses'] == said['poses']
    assert yaml.safe_load(grid.with_suffix('.yaml').read_text())['image'] == 'map.pgm'
    assert set(np.unique(np.array(Image.open(grid)))) == {0, 205, 254}


def test_the_scans_of_a_bag_make_the_same_map(drive, truth, tmp_path, capsys):
    bag = tmp_path / 'bag'
    write_scan_bag(bag, *drive[:2], mount=((0.0, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0)))
    code, said = solved(capsys, bag, '--scans', '/scan', '--odom-topic', '/wheels',
                        '--reference', truth)
    assert code == 0 and said['ate'] < 0.05 and said['loops'] >= 3
    assert said['warnings'] == []


def test_a_clock_that_is_set_back_within_a_bag_is_one_clock_again(drive, tmp_path, capsys):
    scans, wheels, _ = drive
    k = len(scans) // 2
    bags = tmp_path / 'bag', tmp_path / 'back'
    back = [replace(scan, stamp=scan.stamp - 30 * 10**9) for scan in scans[k:]]
    for bag, recorded in zip(bags, (scans, [*scans[:k], *back]), strict=True):
        write_scan_bag(bag, recorded, wheels, mount=((0.0, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0)))
    (code, said), (again, found) = (
        solved(capsys, bag, '--scans', '/scan', '--odom-topic', '/wheels') for bag in bags)
    assert (code, again) == (0, 0)
    assert found['warnings'] == ['the clock was set back by 30.0 s in all; stamps are shifted to '
                                 'undo that']
    assert {**found, 'seconds': 0, 'warnings': []} == {**said, 'seconds': 0}


def test_the_scans_of_a_bag_bear_the_velocity_of_the_wheels_meanwhile(drive, tmp_path, capsys):
    """Of scans taken while it drives the map is good where they say how long they lasted."""
    scans, wheels, true = (part[:101] for part in drive)
    rng, truth, ate = np.random.default_rng(0), tmp_path / 'truth.csv', []
    slow = [replace(scan, ranges=ranges_on_the_way(pose, velocity, 0.2, rng))
            for scan, pose, velocity in zip(scans, true, between(true[:-1], true[1:]) / 0.2,
                                            strict=False)]
    write_truth(truth, slow, true[:-1])
    for seconds in 0.2, 0.0:
        bag = tmp_path / f'bag_{seconds}'
        write_scan_bag(bag, [replace(scan, time_increment=seconds / len(scan.ranges))
                             for scan in slow], wheels[:-1])
        code, said = solved(capsys, bag, '--scans', '/scan', '--odom-topic', '/wheels',
                            '--reference', truth)
        assert code == 0
        ate.append(said['ate'])
    assert ate[0] < 0.015 < 0.03 < ate[1]


def test_a_laser_that_is_turned_upside_down_and_ahead_is_read_off_the_transforms(
        drive, truth, tmp_path, capsys):
    scans, wheels, _ = drive
    bag, turned = tmp_path / 'bag', []
    for scan in scans:  # a half turn about x: rays go clockwise, from the same first one
        ranges = np.roll(scan.ranges[::-1], 1)
        turned.append(replace(scan, ranges=ranges))
    write_scan_bag(bag, turned, wheels, mount=((0.0, 0.0, 0.3), (1.0, 0.0, 0.0, 0.0)))
    code, said = solved(capsys, bag, '--scans', '/scan', '--odom-topic', '/wheels',
                        '--reference', truth)
    assert code == 0 and said['ate'] < 0.05


def test_of_a_bag_with_scans_and_without_loops_the_option_for_scans_is_named(
        drive, tmp_path, capsys):
    bag = tmp_path / 'bag'
    write_scan_bag(bag, *(part[:60] for part in drive[:2]))
    code, said = solved(capsys, bag, '--odom-topic', '/wheels')
    (sentence,) = (text for text in said['warnings'] if '--scans' in text)
    assert code == 0 and said['loops'] == 0 and '60 scans on /scan' in sentence
    assert 'with --scans /scan' in sentence
    assert main(['info', str(bag), '--odom-topic', '/wheels']) == 0
    assert '--scans /scan' in capsys.readouterr().out
    # Without transforms it says where it takes the laser to be.
    warnings = solved(capsys, bag, '--scans', '/scan', '--odom-topic', '/wheels')[1]['warnings']
    assert any("/tf_static does not lead from 'base_link' to 'laser'" in one for one in warnings)
    # Where there are loops, nothing is missing.
    assert not any('--scans' in text for text in solved(capsys, DEMO)[1]['warnings'])


@pytest.mark.parametrize(('arguments', 'expected'), [
    (['--scans', '/laser', '--odom-topic', '/wheels'],
     'no scans on /laser; expected sensor_msgs/msg/LaserScan, which is on /scan'),
    (['--scans', '/scan'], '0 messages of odometry on /odom; expected 2 or more'),
    (['--grid', 'map.pgm'], '--grid is of scans; expected --scans TOPIC, or a CARMEN log'),
    (['--scans', '/scan', '--odom-topic', '/wheels', '--grid', 'map.png'],
     'map.png: unknown suffix; expected .pgm')])
def test_what_cannot_be_is_said_in_one_line(drive, tmp_path, capsys, arguments, expected):
    bag = tmp_path / 'bag'
    write_scan_bag(bag, *(part[:20] for part in drive[:2]))
    assert main(['solve', str(bag), *arguments]) == 2
    error, = capsys.readouterr().err.splitlines()
    assert error.endswith(expected)
    (graph := tmp_path / 'graph.g2o').write_text('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n')
    assert main(['solve', str(graph), '--scans', '/scan']) == 2
    assert 'holds no scans; expected a bag, or a CARMEN log' in capsys.readouterr().err


def test_a_grid_of_others_is_not_replaced(drive, tmp_path, capsys):
    log, grid = tmp_path / 'room.clf', tmp_path / 'map.pgm'
    write_log(log, *(part[:60] for part in drive[:2]))
    grid.write_bytes(b'P5\n1 1\n255\n\0')
    assert main(['solve', str(log), '--grid', str(grid)]) == 2
    assert grid.read_bytes() == b'P5\n1 1\n255\n\0'
    assert main(['solve', str(log), '--grid', str(grid), '--force']) == 0
    assert main(['solve', str(log), '--grid', str(grid)]) == 0, 'this one is ours'


def test_the_log_of_a_building_is_mapped_from_its_scans_alone(datasets, capsys):
    """Metres to the corrected log; by the wheels it is 14 off."""
    log = datasets / 'lidar' / 'fr079.clf.bz2'
    code, said = solved(capsys, log, '--reference', log.with_name('fr079.truth.csv'))
    assert code == 0 and said['ate'] <= 0.12
